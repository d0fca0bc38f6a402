"""Makes the frame around every page, and the page's headers. A page holds its style and scripts itself.

The templates lie in `hippodrome/web/`. They use `string.Template`, because Jinja's import makes cold starts longer;
Jinja is loaded only for step pages that use it. The Content-Security-Policy lets only scripts with the page's nonce
run.
"""

from __future__ import annotations

import html
import json
import re
import secrets
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.model.texts import IN_ENGLISH, Texts, is_right_to_left
from hippodrome.control.participants import scripts
from hippodrome.control.participants.texts import in_script, in_template

WEB = Path(__file__).resolve().parents[2] / "web"
_SOURCE = re.compile(r"(?:https?|wss?)://[A-Za-z0-9.*\[\]:_-]+")  # a valid source in a Content-Security-Policy


class Page(NamedTuple):
    """A page and the headers it needs."""

    html: str
    headers: dict[str, str]


class Html(str):
    """Text that is HTML. `fill` escapes all other text."""

    __slots__ = ()


@dataclass(frozen=True)
class View:
    """A page as one participant sees it, at a step of their path. The page of an end has a step of its own."""

    project: Project
    step: Step
    user_id: str

    @cached_property
    def texts(self) -> Texts:
        """The study's texts."""
        return Texts(self.project.texts)


def message_page(title: str, text: str, *, lang: str = IN_ENGLISH.language, more: Html | None = None) -> Page:
    """Return a page with a title and a text, such as an error, and perhaps `more` HTML below them."""
    nonce = secrets.token_urlsafe(16)
    page = fill(
        "frame.html",
        lang=lang,
        dir=_direction(lang),
        title=title,
        head=Html(),
        style=Html(style("message") + _of_direction(lang)),
        body="message",
        data=Html(),
        header=Html(),
        main=fill("message", title=title, text=text, more=more or Html()),
        footer=Html(),
        script=Html(),
    )
    return Page(page, headers(None, nonce))


def form_message(title: str, text: str, *, step: str = "", ticket: str = "", also: str = "") -> str:
    """Return a title and a text as HTML, for a program with a form of its own, such as HIPPO's front end.

    The hidden fields in front name `step`, and `also` are further ones. A form without a `step` answers no step: the
    response to it is the page of the due step.
    """
    fields = fill("named", step=step, ticket=ticket)
    return fields + also + fill("message", title=title, text=text, more=Html())


def frame(
    view: View,
    nonce: str,
    *,
    main: Html,
    script: Html,
    title: str = "",
    lang: str = "",
    heading: bool = False,
    head: Html = Html(),  # noqa: B008 - immutable
    body: str = "step",
    sheets: tuple[str, ...] = (),
    data: Html = Html(),  # noqa: B008
) -> Html:
    """Return the whole HTML of a step's page.

    `main`, `head`, `script` and `data` are its parts: the content, further elements of the head, the scripts, and
    attributes of the body. `body` is the kind of page, for `style`. With `heading`, the study's name is the page's
    first heading. `sheets` names further style sheets of `hippodrome/web/`, which only some pages need.
    """
    project, step, texts = view.project, view.step, view.texts
    lang = lang or texts.language
    name = project.name or project.id
    at, steps = project.index(step.key), len(project.steps)
    shows_progress = at is not None and steps > 1  # the page of an end is no step
    numbers = {"step": (at or 0) + 1, "steps": steps}
    progress = fill("progress", texts, **numbers, done=at, all=steps - 1) if shows_progress else Html()
    return fill(
        "frame.html",
        lang=lang,
        dir=_direction(lang),
        title=texts.say("titleStep", title=title or name, **numbers) if shows_progress else title or name,
        head=head,
        style=Html(style(body) + "".join(map(_sheet, sheets)) + _of_direction(lang)),
        body=body,
        data=Html(fill("data", project=project.id, user=view.user_id, step=step.key) + data),
        header=fill("header", tag="h1" if heading else "p", name=name, progress=progress),
        main=main,
        footer=fill("footer", texts, researcher=project.researcher) if project.researcher else Html(),
        script=script,
    )


def script(
    name: str, nonce: str, *, module: bool = False, also: tuple[str, ...] = (), texts: Texts = IN_ENGLISH
) -> Html:
    """Return the script element with a script of `web/`. `also` are modules in the same folder that come before it."""
    kind = ' type="module"' if module else ""
    return Html(f'<script{kind} nonce="{nonce}">\n{_code(name, also, texts)}</script>\n')


def script_json(data: Any) -> Html:
    """Return data as JSON for a script element. No text in it can end the element."""
    return Html(json.dumps(data).replace("<", "\\u003c"))


# Headers


def headers(project: Project | None, nonce: str, connect: str = "") -> dict[str, str]:
    """Return the headers of a page.

    `connect` has further sources, separated by spaces, to which its scripts may connect.
    """
    hosts = " ".join(allowed_sources(project.allowed_hosts)) if project else ""
    policy = {
        "default-src": "'none'",
        "script-src": f"'nonce-{nonce}'",
        "style-src": "'self' 'unsafe-inline'",
        "img-src": f"'self' data: {hosts}",
        "media-src": f"'self' {hosts}",
        "font-src": "'self'",
        "frame-src": hosts or "'none'",
        "connect-src": f"'self' {' '.join(allowed_sources(connect.split()))}",
        "form-action": "'self'",
        "base-uri": "'none'",
        "frame-ancestors": "'none'",
    }
    return {
        "Content-Security-Policy": "; ".join(f"{name} {value.strip()}" for name, value in policy.items()),
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "private, no-cache",  # not no-store: after "back" a browser must show the form as it was
        "Permissions-Policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=(), browsing-topics=()",
    }


def allowed_sources(hosts: list[str]) -> list[str]:
    """Return the valid sources among the given ones. So no value can add a directive to the policy."""
    return [source for source in hosts if _SOURCE.fullmatch(source)]


# Templates

_PARTS = {
    "header": '<header>\n<div><$tag class="study">$name</$tag>$progress</div>\n</header>',
    "progress": '<label class="progress">TEXT.step <progress max="$all" value="$done"></progress></label>',
    "footer": "<footer><p>TEXT.studyBy</p></footer>",
    "data": ' data-project="$project" data-user="$user" data-step="$step"',
    "least": ' data-least="$seconds"',
    "end": ' data-end="$end"',
    "named": """<input type="hidden" name="hippodrome-step" value="$step">
<input type="hidden" name="hippodrome-ticket" value="$ticket">
""",
    "form": """<form class="page" method="post" action="$action" accept-charset="utf-8">
$named$content
<div class="send">$button<p class="status" role="status" aria-live="polite"></p></div>
</form>""",
    "button": '<button type="submit">$text</button>',
    "answered": """<p class="saved" role="status">TEXT.saved</p>
<fieldset class="page answered" disabled>
$content
</fieldset>""",
    "action": '<input type="hidden" name="hippodrome-action" value="$action">\n',
    "over": '<p><button type="submit" name="hippodrome-action" value="$action">$text</button></p>\n',
    "report": "<p>$text</p>\n",
    "message": '<div class="page">\n<h1>$title</h1>\n<p>$text</p>\n$more</div>',
    "endCode": '<p>$text</p>\n<p class="code">$code</p>\n',
    "endLink": '<p><a class="button" href="$link">$text</a></p>\n',
    "wrong": '<p class="problem" role="alert">$text</p>\n',
    "shown": '<input type="hidden" name="hippodrome-shown" value="$shown">\n',
    "reading": """
<section id="reading" tabindex="-1" style="outline:0" aria-label="TEXT.toRead" hidden>
<p id="reading-score"></p>
$texts
<p style="margin:2rem 0 0"><button type="button" class="button" id="reading-button"></button></p>
</section>""",
    "text": '<form class="page" id="text-$key" hidden>\n$content\n</form>',
    "alone": """<h1>TEXT.gettingReady</h1>
<p>TEXT.startingAlone</p>""",
    "together": """<h1>TEXT.preparedHeading</h1>
<p><span id="company"></span> TEXT.startingTogether</p>""",
    "stages": """<ol class="stages">
<li id="stage-queued"$queued_now>TEXT.stageQueued</li>
<li id="stage-starting"$starting_now>TEXT.stageStarting</li>
<li id="stage-naming"$naming_now>TEXT.stageNaming</li>
<li id="stage-ready"$ready_now>TEXT.stageReady</li>
</ol>""",
}


def fill(name: str, texts: Texts = IN_ENGLISH, /, **values: Any) -> Html:
    """Return the template `name` with a study's texts and these values filled in.

    Values that are not `Html` are escaped.
    """
    safe = {key: value if isinstance(value, Html) else html.escape(str(value)) for key, value in values.items()}
    return Html(_template(name, texts).substitute(safe))


_SECTION = re.compile(r"^/\* (step|game|message) pages: \*/$(.*?)^/\* all pages: \*/$", re.DOTALL | re.MULTILINE)


@cache
def style(kind: str | None = None) -> str:
    """Return `style.css` without the sections for other kinds of pages. The kinds are "step", "game" and "message".

    For None, return all of it.
    """
    text = _read("style.css")
    if kind:
        text = _SECTION.sub(lambda section: section[2] if section[1] == kind else "", text)
    return _plain("style.css", text)


def style_of_pages_in_game() -> str:
    """Return the sections of `style.css` for step pages, for what the game page shows of the researcher's pages."""
    sections = [section[2] for section in _SECTION.finditer(_read("style.css")) if section[1] == "step"]
    return _plain("pages-in-game.css", f"#reading {{\n{''.join(sections)}\n}}")


def _direction(lang: str) -> Html:
    """The attribute `dir` for a language that is written from right to left: browsers do not derive it from `lang`."""
    return Html(' dir="rtl"' if is_right_to_left(lang) else "")


def _of_direction(lang: str) -> str:
    return _sheet("right-to-left.css") if is_right_to_left(lang) else ""


@cache
def _sheet(name: str) -> str:
    return _plain(name, _read(name))


@lru_cache(maxsize=16)
def _joined(name: str, also: tuple[str, ...]) -> str:
    """A script of `web/`, with the modules that it imports and the modules in `also`. It still has names of texts."""
    return _plain(name, scripts.join(WEB / name, also))


@lru_cache(maxsize=32)
def _code(name: str, also: tuple[str, ...] = (), texts: Texts = IN_ENGLISH) -> str:
    """The same script with a study's texts in place of their names."""
    return in_script(_joined(name, also), texts)


@lru_cache(maxsize=256)
def _template(name: str, texts: Texts) -> Template:
    template = _PARTS[name] if name in _PARTS else _read(name)
    return Template(in_template(template, texts))


def _read(name: str) -> str:
    """The text of a file of `hippodrome/web/`."""
    return (WEB / name).read_text(encoding="utf-8")


_CODE_OR_TEXT = re.compile(
    r"""(?P<text>"(?:[^"\\\n]|\\.)*"|`(?:[^`\\$]|\\.|\$(?!\{)|\$\{(?:[^`{}]|`[^`]*`)*\})*`)|[^"`]+"""
)
"""A string; a template literal, with the code in it, which may have template literals of its own; or other code."""
_AROUND = re.compile(r" ?(=>|[=!]==|&&|\|\||\?\?=?|[-+*/]=|\*|[+-](?= [^-+])|[=?:{},;<>()[\]]) ?")
"""Operators and brackets around which spaces mean nothing. The spaces in `a + +b` are kept: `a++b` is no such sum."""


def _dense(code: str) -> str:
    """Code without most spaces and line ends. Its statements must end with semicolons or blocks; none may be empty."""
    code = re.sub(r",\n(?=[}\])])", "", _AROUND.sub(r"\1", code))
    return re.sub(r";(?=})", "", re.sub(r"([;{},(\[])\n", r"\1", code))


def _plain(name: str, text: str) -> str:
    """A style sheet or script without comments, indentation, and most of the spaces and line ends that mean nothing.

    A comment after code begins with a space, `//` and a space. No regular expression in our scripts has spaces.
    """
    if name.endswith(".css"):
        text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
        text = re.sub(r" ?([{};>~]) ?|([:,]) ", r"\1\2", text)  # no quoted text in our files has such a part
    if name.endswith(".js"):
        text = re.sub(r"[ \t]// .*$", "", text, flags=re.MULTILINE)
    if name.endswith((".css", ".js")):
        lines = (line.strip() for line in text.splitlines())
        text = "".join(f"{line}\n" for line in lines if line and not line.startswith("//"))
    if name.endswith(".css"):
        text = re.sub(r"(?<=[{;,}])\n|;?\n(?=})|;(?=})", "", text)
    if name.endswith(".js"):
        text = _CODE_OR_TEXT.sub(lambda part: part[0] if part["text"] else _dense(part[0]), text)
    return text
