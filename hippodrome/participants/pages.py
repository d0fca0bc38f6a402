"""What participants see: step pages, the game page, and pages that say one sentence.

The frame around them lies in `web/`. Its templates are plain (`string.Template`), so that Jinja, whose import costs
cold starts, is loaded only for step pages that use it. A page holds its style and scripts and loads nothing from
elsewhere; its Content-Security-Policy lets only those scripts run that carry the page's nonce.
"""

from __future__ import annotations

import html
import json
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from hippodrome.model.project import Project, Step
from hippodrome.participants import fragments, scripts
from hippodrome.participants.fragments import Fragment, FragmentError, records_mentioned

__all__ = [
    "FragmentError",
    "GameView",
    "Page",
    "StepView",
    "fragment",
    "game_page",
    "message_page",
    "records_mentioned",
    "step_page",
    "style",
]

WEB = Path(__file__).resolve().parents[2] / "web"
STAGES = ("queued", "starting", "naming", "ready")  # of waiting, in this order

_SOURCE = re.compile(r"(?:https?|wss?)://[A-Za-z0-9.*\[\]:_-]+")  # what may stand in a policy


class Page(NamedTuple):
    """A page and the headers it needs."""

    html: str
    headers: dict[str, str]


@dataclass(frozen=True)
class StepView:
    """A step page for one participant."""

    project: Project
    step: Step
    user_id: str
    source: str  # the researcher's file
    values: Mapping[str, Any]  # that the file may use
    ticket: str
    action: str  # where the form goes: the page's own address
    final: bool
    answered: bool = False  # a final step whose form was sent before
    problem: str | None = None  # a sentence at the top


@dataclass(frozen=True)
class GameView:
    """The game page for one participant, who waits on it and then plays."""

    project: Project
    step: Step
    user_id: str
    state: Mapping[str, Any]  # as the poll address answers, see docs/pages.md
    poll: str
    page: str
    action: str
    ticket: str
    sources: str  # what the game may connect to, as in a Content-Security-Policy


class Html(str):
    """Text that is HTML already. Everything else is escaped when it is filled in."""

    __slots__ = ()


# Pages


def step_page(view: StepView) -> Page:
    """A step page in its frame. Raises FragmentError."""
    nonce = secrets.token_urlsafe(16)
    prepared = _prepared(view)
    content = Html(prepared.render(view.values, nonce))
    problem = _fill("problem", text=view.problem) if view.problem else Html()
    if not view.final or (prepared.has_fields and not view.answered):
        main = _fill(
            "form",
            action=view.action,
            named=_step_fields(view),
            content=content,
            button=Html() if prepared.has_submit else _fill("button", text="Send" if view.final else "Continue"),
        )
    elif view.answered and prepared.has_fields:
        main = _fill("answered", content=content)
    else:
        main = Html(f'<div class="page">\n{content}\n</div>')
    text = _frame(
        view.project,
        view.step,
        view.user_id,
        nonce,
        main=Html(problem + main),
        script=_script("step.js", nonce),
        title=prepared.title,
        lang=prepared.lang,
        heading=not prepared.has_heading,
        data=Html(' data-done=""') if view.final and (view.answered or not prepared.has_fields) else Html(),
    )
    return Page(text, _headers(view.project, nonce))


def fragment(view: StepView) -> str:
    """The researcher's part, for clients with a frame and a form of their own. Raises FragmentError.

    The hidden fields that name the step come first; such a client sends them along. (HIPPO's front end
    posts all named elements of its form, IRLL/HIPPO_Gym_FrontEnd_React, `src/main.js`.)
    """
    return _step_fields(view) + _prepared(view).render(view.values)


def game_page(view: GameView) -> Page:
    """The page of a game step: waiting and playing."""
    nonce = secrets.token_urlsafe(16)
    state = str(view.state.get("state", "queued"))
    over = state in ("ended", "failed")
    data = {
        "state": dict(view.state),
        "poll": view.poll,
        "page": view.page,
        "project": view.project.id,
        "step": view.step.key,
    }
    over_title, over_text = _over_texts(view.state) if over else ("", "")
    moved = bool(view.state.get("replaces"))
    main = _fill(
        "game.html",
        stages=_stages(state),
        waiting=Html(" hidden") if over else Html(),
        first=Html(" hidden") if moved else Html(),
        moved=Html() if moved else Html(" hidden"),
        over=Html() if over else Html(" hidden"),
        over_title=over_title,
        over_text=over_text,
        button=_button(state),
        again=Html() if view.state.get("again") else Html(" hidden"),
        gone=Html(" hidden") if view.state.get("again") else Html(),
        action=view.action,
        step=view.step.key,
        ticket=view.ticket,
        data=_json(data),
    )
    text = _frame(
        view.project,
        view.step,
        view.user_id,
        nonce,
        main=main,
        script=_script("game/main.js", nonce, module=True),
        head=Html() if over else Html('<noscript><meta http-equiv="refresh" content="5"></noscript>\n'),
        body="game",
    )
    return Page(text, _headers(view.project, nonce, connect=view.sources))


def message_page(
    title: str, text: str, *, link: str | None = None, link_text: str | None = None, lang: str = "en"
) -> Page:
    """A page with one sentence, such as an error."""
    nonce = secrets.token_urlsafe(16)
    go = _fill("link", link=link, text=link_text or "Go on") if link else Html()
    page = _fill(
        "frame.html",
        lang=lang,
        title=title,
        head=Html(),
        style=Html(style("message")),
        body="message",
        data=Html(),
        header=Html(),
        main=_fill("message", title=title, text=text, link=go),
        footer=Html(),
        script=Html(),
    )
    return Page(page, _headers(None, nonce))


def style(kind: str | None = None) -> str:
    """The style sheet of all pages, or only what pages of one kind use ("step", "game" or "message")."""
    return _style(kind)


# Parts


def _step_fields(view: StepView) -> Html:
    """The hidden fields that say and prove which step a form answers."""
    return _fill("named", step=view.step.key, ticket=view.ticket)


_OVER = {"ended": "The game has ended", "failed": "The game could not be started"}
_TITLES = {"lost": "The game could not go on", "full": "The study is full just now"}
_TRANSIENT = ("no capacity", "full")  # waiting may help
_TO_REPORT = ("lost", "refused")  # the researcher or the administrator has to act, if it stays so
_REASONS = {  # the values of `hippodrome.model.server.Reason`
    "stopped": "The computer for your game was switched off by those who hold the study.",
    "deadline": "The time for it was over.",
    "ended": "Nobody had played for a while, or the time for it was over, so its computer switched itself off.",
    "lost": "The computers that we tried for your game failed, or it could not begin on them. This is not your fault.",
    "refused": "No computer for your game can be started as the study is set up. This is not your fault.",
    "no capacity": "There is no free computer for your game at the moment. This is not your fault.",
    "full": "All places for this game are taken at the moment. This is not your fault.",
}


def _over_texts(state: Mapping[str, Any]) -> tuple[str, str]:
    """The title and the text for a server that has ended: what happened, what is kept, what to do."""
    reason = str(state.get("reason"))
    title = _TITLES.get(reason) or _OVER[str(state["state"])]
    sentences = [_REASONS.get(reason, "Its computer is not there any more.")]
    sentences.append("What you have answered and played before is kept.")
    if state.get("again"):
        sentences.append(
            "Please try again in a few minutes, here or by opening your link later."
            if reason in _TRANSIENT
            else f"With “{_button(str(state['state']))}” you go on."
        )
        if reason in _TO_REPORT:
            sentences.append("If this happens again, please tell whoever invited you to this study.")
    return title, " ".join(sentences)


def _button(state: str) -> str:
    """The text of the button that requests another server."""
    return "Try again" if state == "failed" else "Start again"


def _frame(
    project: Project,
    step: Step,
    user_id: str,
    nonce: str,
    *,
    main: Html,
    script: Html,
    title: str = "",
    lang: str = "",
    heading: bool = False,
    head: Html = Html(),  # noqa: B008 - immutable
    body: str = "step",
    data: Html = Html(),  # noqa: B008
) -> Html:
    name = project.name or project.id
    at, steps = project.index(step.key) or 0, len(project.steps)
    progress = _fill("progress", step=at + 1, steps=steps, done=at, all=steps - 1) if steps > 1 else Html()
    return _fill(
        "frame.html",
        lang=lang or "en",
        title=f"{title or name} · step {at + 1} of {steps}" if steps > 1 else title or name,
        head=head,
        style=Html(style(body)),
        body=body,
        data=Html(_fill("data", project=project.id, user=user_id, step=step.key) + data),
        header=_fill("header", tag="h1" if heading else "p", name=name, progress=progress),
        main=main,
        footer=_fill("footer", researcher=project.researcher) if project.researcher else Html(),
        script=script,
    )


def _script(name: str, nonce: str, *, module: bool = False) -> Html:
    kind = ' type="module"' if module else ""
    return Html(f'<script{kind} nonce="{nonce}">\n{_code(name)}</script>\n')


def _stages(state: str) -> Html:
    """The stages of waiting; the present one is marked."""
    now = STAGES.index(state) if state in STAGES else 0
    marks = {
        f"{name}_now": Html(' aria-current="step"') if at == now else Html(' class="past"') if at < now else Html()
        for at, name in enumerate(STAGES)
    }
    return _fill("stages", **marks)


def _json(data: Any) -> Html:
    """JSON that can stand in a script element."""
    return Html(json.dumps(data).replace("<", "\\u003c"))


def _prepared(view: StepView) -> Fragment:
    return fragments.prepare(view.source, f"/steps/{view.project.id}/", tuple(_sources(view.project.allowed_hosts)))


# Headers


def _headers(project: Project | None, nonce: str, connect: str = "") -> dict[str, str]:
    hosts = " ".join(_sources(project.allowed_hosts)) if project else ""
    policy = {
        "default-src": "'none'",
        "script-src": f"'nonce-{nonce}'",
        "style-src": "'self' 'unsafe-inline'",
        "img-src": f"'self' data: {hosts}",
        "media-src": f"'self' {hosts}",
        "font-src": "'self'",
        "frame-src": hosts or "'none'",
        "connect-src": f"'self' {' '.join(_sources(connect.split()))}",
        "form-action": "'self'",
        "base-uri": "'none'",
        "frame-ancestors": "'none'",
    }
    return {
        "Content-Security-Policy": "; ".join(f"{name} {value.strip()}" for name, value in policy.items()),
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "private, no-cache",  # not no-store: going back must find the form as it was
        "Permissions-Policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=(), browsing-topics=()",
    }


def _sources(given: list[str]) -> list[str]:
    """Those that are valid sources: no value may add a directive to the policy."""
    return [source for source in given if _SOURCE.fullmatch(source)]


# Templates

_PARTS = {
    "header": '<header>\n<div><$tag class="study">$name</$tag>$progress</div>\n</header>',
    "progress": '<label class="progress">Step $step of $steps <progress max="$all" value="$done"></progress></label>',
    "footer": "<footer><p>A study by $researcher</p></footer>",
    "data": ' data-project="$project" data-user="$user" data-step="$step"',
    "problem": '<p class="problem" role="alert">$text</p>\n',
    "named": """<input type="hidden" name="hippodrome-step" value="$step">
<input type="hidden" name="hippodrome-ticket" value="$ticket">
""",
    "form": """<form class="page" method="post" action="$action" accept-charset="utf-8">
$named$content
<div class="send">$button<p class="status" role="status" aria-live="polite"></p></div>
</form>""",
    "button": '<button type="submit">$text</button>',
    "answered": """<p class="saved" role="status">Your answers are saved.</p>
<fieldset class="page answered" disabled>
$content
</fieldset>""",
    "message": '<div class="page">\n<h1>$title</h1>\n<p>$text</p>\n$link</div>',
    "link": '<p><a class="button" href="$link">$text</a></p>\n',
    "stages": """<ol class="stages">
<li id="stage-queued"$queued_now>Your request has been received</li>
<li id="stage-starting"$starting_now>A computer is starting for you</li>
<li id="stage-naming"$naming_now>The connection is being set up</li>
<li id="stage-ready"$ready_now>Ready to play</li>
</ol>""",
}


def _fill(name: str, /, **values: Any) -> Html:
    """Fill in a template; values that are not `Html` are escaped."""
    safe = {key: value if isinstance(value, Html) else html.escape(str(value)) for key, value in values.items()}
    return Html(_template(name).substitute(safe))


_SECTION = re.compile(r"^/\* (step|game) pages: \*/$(.*?)^/\* all pages: \*/$", re.DOTALL | re.MULTILINE)


@cache
def _style(kind: str | None) -> str:
    """`style.css` without the sections of other kinds of pages; all of it for None."""
    text = (WEB / "style.css").read_text(encoding="utf-8")
    if kind:
        text = _SECTION.sub(lambda section: section[2] if section[1] == kind else "", text)
    return _plain("style.css", text)


@cache
def _code(name: str) -> str:
    """A script of `web/` with the modules that it imports."""
    return _plain(name, scripts.join(WEB / name))


@cache
def _template(name: str) -> Template:
    return Template(_PARTS[name] if name in _PARTS else (WEB / name).read_text(encoding="utf-8"))


def _plain(name: str, text: str) -> str:
    """A style or script without comments and indentation. A comment behind code begins with space, `//`, space."""
    if name.endswith(".css"):
        text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    if name.endswith(".js"):
        text = re.sub(r"[ \t]// .*$", "", text, flags=re.MULTILINE)
    if name.endswith((".css", ".js")):
        lines = (line.strip() for line in text.splitlines())
        text = "".join(f"{line}\n" for line in lines if line and not line.startswith("//"))
    return text
