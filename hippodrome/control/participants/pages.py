"""Makes the pages that participants see: step pages in their frame, and the game page."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.model.texts import Texts
from hippodrome.control.participants import fragments, game_modules
from hippodrome.control.participants.fragments import Fragment
from hippodrome.control.participants.frame import (
    Html,
    Page,
    View,
    allowed_sources,
    fill,
    form_message,
    frame,
    headers,
    script,
    script_json,
    style_of_pages_in_game,
)
from hippodrome.protocol.answer import FAILED

STAGES = ("queued", "starting", "naming", "ready")  # the states of a server that the waiting page shows, in this order
LOBBY = "lobby"
"""The state of a participant who waits for others to play with."""


@dataclass(frozen=True)
class StepView(View):
    """What a step page shows to one participant."""

    source: str  # the text of the researcher's file
    values: Mapping[str, Any]  # the values that the file may use
    ticket: str
    action: str  # the address to which the form is sent: the page's own
    final: bool  # whether it is the last step
    answered: bool = False  # whether it is a final step whose form was sent before
    shown: str = ""  # of a check, or a page with minSeconds: which try it is, and since when
    least: int = 0  # seconds before which no answers are taken
    wrong: tuple[str, ...] = ()  # of a check: the fields that were not right
    tries_left: int = 0  # of a check; 0: as many as are needed
    end: str = ""  # of the page of an end: the end's name


@dataclass(frozen=True)
class GameView(View):
    """What the game page shows to one participant, who first waits and then plays on it.

    `project` is as the participant's session runs it (`Project.for_session`).
    """

    state: Mapping[str, Any]  # the same as the response of `poll`, see docs/pages.md
    poll: str  # the address of the state
    page: str  # the page's own address, to which its form is sent too
    ticket: str
    sources: str  # the sources in the Content-Security-Policy to which the game may connect
    # the researcher's pages that the game page shows: by the key of `trial` that names a page, its text and its values
    reading: Mapping[str, tuple[str, Mapping[str, Any]]] = field(default_factory=dict)


# Pages


def step_page(view: StepView) -> Page:
    """Return a step page in its frame. Raises FragmentError."""
    nonce = secrets.token_urlsafe(16)
    texts = view.texts
    filled = _prepare(view.project, view.source).fill(view.values, nonce)
    content = Html(filled.html)
    is_asked = filled.has_fields
    if not view.final or (is_asked and not view.answered):
        main = fill(
            "form",
            action=view.action,
            named=_step_fields(view),
            content=Html(_wrong(view) + content),
            button=Html() if filled.has_submit else fill("button", text=texts["send" if view.final else "continue"]),
        )
    elif is_asked:
        main = fill("answered", texts, content=content)
    else:
        main = Html(f'<div class="page">\n{content}\n</div>')
    text = frame(
        view,
        nonce,
        main=main,
        script=script("step.js", nonce, module=True, texts=texts),
        title=filled.title,
        lang=filled.lang,
        heading=not filled.has_heading,
        data=_done(view, is_asked),
    )
    return Page(text, headers(view.project, nonce))


def end_page(project: Project, user_id: str, end: str, code: str, link: str) -> Page:
    """Return the page of an end for which the study has no page of its own, with the code and the link if there are."""
    nonce = secrets.token_urlsafe(16)
    view = View(project, Step(end, ""), user_id)
    texts = view.texts
    title, text = texts["endTitle"], texts["endText"]
    page = frame(
        view,
        nonce,
        main=fill("message", title=title, text=text, more=end_code(texts, code, link)),
        script=script("step.js", nonce, module=True, texts=texts),
        title=title,
        data=fill("end", end=end),
    )
    return Page(page, headers(project, nonce))


def fragment(view: StepView) -> str:
    """Return the researcher's part of a page, for a program with a frame and a form of its own. Raises FragmentError.

    The hidden fields that name the step come first. The program sends them with the form: HIPPO's front end posts all
    named elements of its form (IRLL/HIPPO_Gym_FrontEnd_React, `src/main.js`).
    """
    return _step_fields(view) + _wrong(view) + _prepare(view.project, view.source).render(view.values)


def game_page(view: GameView) -> Page:
    """Return the page of a game step: waiting and playing. Raises FragmentError."""
    nonce = secrets.token_urlsafe(16)
    modules = game_modules.modules_of(view.project)
    is_talk = game_modules.is_talk(view.project.trial)
    texts = game_modules.texts_of(view.project)
    state = str(view.state["state"])
    over = is_over(view.state)
    data: dict[str, Any] = {
        "state": dict(view.state),
        "poll": view.poll,
        "page": view.page,
        "project": view.project.id,
        "step": view.step.key,
    }
    if "*" not in view.sources:  # the policy lets the page reach this one server: for another, it is loaded again
        data["server"] = view.sources
    if said := texts.of_server():
        data["said"] = said
    data |= _of_trial(view.project.trial)
    over_title, over_text = _over_texts(view.state, texts) if over else ("", "")
    moved = bool(view.state.get("replaces"))
    data |= {"talk": True} if is_talk else {}
    together = view.project.has_sessions
    if together:
        trial = view.project.trial
        data |= {"players": _players(view), "absentEnds": trial.get("afterAbsent") != "policy"}
        data |= {"names": names} if (names := trial.get("playerNames")) else {}
    main = fill(
        "game.html",
        texts,
        stages=_stages(state, texts),
        waiting=Html(" hidden") if over else Html(),
        lobby=_lobby(view, texts) if together else Html(),
        prepared=fill("together" if together else "alone", texts),
        first=Html(" hidden") if moved else Html(),
        moved=Html() if moved else Html(" hidden"),
        over=Html() if over else Html(" hidden"),
        over_title=over_title,
        over_text=over_text,
        again=Html() if over and (view.state.get("again") or view.state.get("without")) else Html(" hidden"),
        buttons=_buttons(view.state, texts) if over else Html(),
        report=_report(view, texts),
        action=view.page,
        step=view.step.key,
        ticket=view.ticket,
        data=script_json(data),
        reading=_reading(view, nonce, texts),
    )
    refresh = Html() if over or in_lobby(view.state) else _REFRESH
    text = frame(
        view,
        nonce,
        main=main,
        script=script("game/main.js", nonce, module=True, also=modules, texts=texts),
        head=Html(refresh + (f"<style>\n{style_of_pages_in_game()}</style>\n" if view.reading else "")),
        sheets=("sessions.css",) * together + ("chat.css",) * ("chat.js" in modules),
        body="game",
    )
    return Page(text, headers(view.project, nonce, connect=view.sources))


def _of_trial(trial: Mapping[str, Any]) -> dict[str, Any]:
    """What the page knows before the server's first message: the picture's shape, and the action without a button.

    In real time the idle action is taken while no key is pressed. Turn by turn it is a choice like any other.
    """
    found: dict[str, Any] = {}
    if isinstance(scene := trial.get("scene"), Mapping) and scene.get("width") and scene.get("height"):
        found["ratio"] = round(scene["width"] / scene["height"], 4)
    if trial.get("pace") != "turns" and (idle := trial.get("idleAction")):
        found["idle"] = idle
    return found


def is_over(state: Mapping[str, Any]) -> bool:
    """Return whether the server has ended or failed, and no other one will start by itself."""
    return state.get("state") in ("ended", "failed")


def in_lobby(state: Mapping[str, Any]) -> bool:
    """Return whether the participant waits for others to play with and is not matched yet."""
    return state.get("state") == LOBBY


def game_message(view: GameView) -> str:
    """Return the page of a game step whose server was lost or has ended, for a program with a form of its own.

    The form requests another server if the participant may have one.
    """
    texts = view.texts
    moved = texts["movedProgramTitle"], texts["movedProgram"]
    title, text = _over_texts(view.state, texts, below=True) if is_over(view.state) else moved
    action = "restart" if view.state.get("again") else "without" if view.state.get("without") else ""
    if is_over(view.state) and action:
        also = fill("action", action=action)
        return form_message(title, text, step=view.step.key, ticket=view.ticket, also=also)
    return form_message(title, text)


# Parts


def _step_fields(view: StepView) -> Html:
    """The hidden fields that name the step which a form answers, with the ticket that proves it."""
    shown = fill("shown", shown=view.shown) if view.shown else Html()
    return Html(fill("named", step=view.step.key, ticket=view.ticket) + shown)


def _done(view: StepView, is_asked: bool) -> Html:
    """The attributes of the body of a page after which nothing is asked any more."""
    if view.end:
        return fill("end", end=view.end)
    if view.least and not view.final:
        return fill("least", seconds=str(view.least))
    return Html(' data-done=""') if view.final and (view.answered or not is_asked) else Html()


def _wrong(view: StepView) -> Html:
    """The sentence on how many answers of a check are not right yet."""
    if not view.wrong:
        return Html()
    texts, number = view.texts, len(view.wrong)
    parts = [texts["wrongOne"] if number == 1 else texts.say("wrongSome", number=number)]
    if view.tries_left:
        parts.append(texts["triesOne"] if view.tries_left == 1 else texts.say("triesSome", number=view.tries_left))
    return fill("wrong", text=" ".join(parts))


def end_code(texts: Texts, code: str, link: str) -> Html:
    """Return the code of an end, and the link that leads back to the recruiter; empty without them."""
    parts = fill("endCode", text=texts["endCode"], code=code) if code else Html()
    return Html(parts + fill("endLink", text=texts["endLink"], link=link)) if link else parts


_REFRESH = Html('<noscript><meta http-equiv="refresh" content="5"></noscript>\n')
"""Reloads the page in a browser without JavaScript. Not in the lobby: a participant there could be matched, but not
play."""
_TITLES = {"lost": "lostTitle", "full": "fullTitle"}
_TRANSIENT = ("no capacity", "full")  # reasons that may pass by themselves
_TO_REPORT = ("lost", "refused")  # reasons for which the researcher or the administrator may have to act
_REASONS = {  # the values of `hippodrome.control.model.server.Reason`, and the texts for them
    "stopped": "stopped",
    "deadline": "deadline",
    "ended": "idle",
    "lost": "failed",
    "refused": "refused",
    "no capacity": "noCapacity",
    "full": "full",
}


def _over_texts(state: Mapping[str, Any], texts: Texts, *, below: bool = False) -> tuple[str, str]:
    """The title and the text for a server that has ended. They say what happened, what is kept, and what to do.

    With `below` the text names no button, because the client shows its own button below the text.
    """
    reason, ending = str(state.get("reason")), str(state["state"])
    title = texts[_TITLES.get(reason, f"{ending}Title")]
    sentences = [texts[_REASONS.get(reason, "computerGone")], texts["kept"]]
    if state.get("without") and not (below and state.get("again")):
        sentences.append(texts["withoutOrAgain" if state.get("again") else "without"])
    elif state.get("again"):
        go_on = texts["goOnBelow"] if below else texts.say("goOnWith", button=_button(ending, texts))
        sentences.append(texts["tryLater"] if reason in _TRANSIENT else go_on)
        if reason in _TO_REPORT:
            sentences.append(texts["tellIfAgain"])
    return title, " ".join(sentences)


def _buttons(state: Mapping[str, Any], texts: Texts) -> Html:
    """The buttons with which a participant goes on after their server has ended. The first one is the usual way."""
    names = {"without": texts["goWithoutGame"], "restart": _button(str(state["state"]), texts)}
    offered = [action for action in names if state.get("again" if action == "restart" else action)]
    return Html("".join(fill("over", action=action, text=names[action]) for action in offered))


def _report(view: GameView, texts: Texts) -> Html:
    """Whom the participant may ask, and what to quote, below the text on a server that has ended. Empty if they need
    not ask anybody.
    """
    if not is_over(view.state) or (view.state.get("again") and not view.state.get("without")):
        return Html()
    contact = view.project.contact
    whom = texts.say("contact", contact=contact) if contact else texts["tell"]
    if not view.state.get("without"):
        return fill("report", text=whom)
    code = ids.completion_code(view.project.secret, view.user_id, FAILED)
    quote = texts.say("quote", user=view.user_id, code=code)
    return Html(fill("report", text=whom) + fill("report", text=quote))


def _button(state: str, texts: Texts) -> str:
    """The text of the button that requests another server."""
    return texts["tryAgain" if state == "failed" else "startAgain"]


def _stages(state: str, texts: Texts) -> Html:
    """The list of the stages of waiting, with the present one marked."""
    now = STAGES.index(state) if state in STAGES else 0
    marks = {
        f"{name}_now": Html(' aria-current="step"') if at == now else Html(' class="past"') if at < now else Html()
        for at, name in enumerate(STAGES)
    }
    return fill("stages", texts, **marks)


def _lobby(view: GameView, texts: Texts) -> Html:
    """The lobby on the game page, which `web/game/lobby.js` fills in. It is hidden once the participant is matched."""
    players = _players(view)
    two = players == 2
    return fill(
        "lobby.html",
        lobby=Html() if in_lobby(view.state) else Html(" hidden"),
        title=texts["lobbyTitleOther" if two else "lobbyTitleOthers"],
        text=texts["lobbyOther"] if two else texts.say("lobbyOthers", players=players),
    )


def _players(view: GameView) -> int:
    """How many participants play together: the session's number, if it differs from the registered one."""
    return int(view.state.get("players", view.project.players))


def _prepare(project: Project, source: str) -> Fragment:
    hosts = tuple(allowed_sources(project.allowed_hosts))
    return fragments.prepare(source, f"/steps/{project.id}/", hosts)


def _reading(view: GameView, nonce: str, texts: Texts) -> Html:
    """The researcher's pages that the game page shows. They come last, so no id in them hides one of the page's."""
    shown = [
        fill("text", key=key, content=Html(_prepare(view.project, source).render(values, nonce)))
        for key, (source, values) in view.reading.items()
    ]
    return fill("reading", texts, texts=Html("\n".join(shown))) if shown else Html()
