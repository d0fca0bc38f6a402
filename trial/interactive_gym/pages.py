"""Makes the pages of steps/ from an experiment's texts."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Callable, Iterable
from typing import Any

from trial.interactive_gym.options import text_of
from trial.interactive_gym.playing import humans_of
from trial.interactive_gym.remote_config import RemoteConfig
from trial.interactive_gym.sources import Locate, put

_LINKED = re.compile(r'(?P<before>\b(?:src|href)=")(?P<path>[^":#?{}]+\.[A-Za-z0-9]+)(?=")')
_TAG = re.compile(r"<[A-Za-z/!]")
_JINJA = re.compile(r"\{[{%#]")


def welcome(config: RemoteConfig) -> str:
    """Make the first page of the study."""
    heading = config.welcome_header_text or config.page_title
    return _page(heading, config.welcome_text, plain="<p>Press the button to begin.</p>")


def around(config: RemoteConfig) -> tuple[dict[str, str], dict[str, str]]:
    """Make the pages before the game, and the pages after it. Return both by the pages' names, in their order."""
    before = _scenes("before", getattr(config, "before", ()))
    after = _scenes("after", getattr(config, "after", ()))
    return before or {"welcome": welcome(config)}, after or {"final": final(config)}


def _scenes(where: str, scenes: Iterable[Any]) -> dict[str, str]:
    return {_name(where, number, scene): _static(scene) for number, scene in enumerate(scenes, 1)}


def _name(where: str, number: int, scene: Any) -> str:
    """Return the name of a scene's page. It begins with the scene's id, if that can be part of a name."""
    name = str(scene.scene_id or "")
    fits = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,60}", name) and name not in ("game", "instructions", "between")
    return f"{name}_{where}_{number}" if fits else f"{where}_{number}"


def _static(scene: Any) -> str:
    subheader = text_of(scene.scene_subheader)
    page = _page(text_of(scene.scene_header), f"<p>{subheader}</p>" if subheader else "", text_of(scene.scene_body))
    if type(scene).__name__ == "CompletionCodeScene":
        page += '<p class="code">{{ completion_code }}</p>\n'
    url = text_of(getattr(scene, "url", None))
    return page + (_onward(url, bool(scene.append_subject_id)) if url else "")


def instructions(config: RemoteConfig, game: Any, human: Any, locate: Locate, remark: Callable[[str], None]) -> str:
    """Make the page with the instructions; empty if the experiment has none. `human` is the first human player."""
    parts = []
    if config.instructions_html_file is not None:
        path = locate(config.instructions_html_file)
        if path is None:
            remark(f"instructions_html_file: there is no {config.instructions_html_file}")
        else:
            parts.append(path.read_text(encoding="utf-8"))
    parts += [config.instructions, config.game_page_text]
    if config.game_page_html_fn is not None:
        game.human_players = {human: "participant"}
        if len(humans_of(config)) > 1:
            remark(f"game_page_html_fn is called for {human} alone: all participants read the same instructions")
        try:
            parts.append(str(config.game_page_html_fn(game, "participant")))
        except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything
            remark(f"game_page_html_fn is left out; it raises {type(error).__name__}: {error}")
    parts = [part for part in parts if part.strip()]
    if config.game_header_text and _has_heading(parts):
        remark("game_header_text is left out: the instructions have a heading (<h1>) of their own")
    return _page(config.game_header_text or "How to play", *parts) if parts else ""


def between(config: RemoteConfig, remark: Callable[[str], None]) -> str:
    """Make the page between two episodes; empty if there is none.

    With such a page, `reset_timeout` has no effect: if the experiment sets it, `remark` is called.
    """
    if not (config.between_episode_header or config.between_episode_text):
        return ""
    if config.reset_timeout != RemoteConfig().reset_timeout:
        remark("reset_timeout has no effect: participants go on themselves from the page between two episodes")
    return _page(config.between_episode_header, config.between_episode_text)


def final(config: RemoteConfig) -> str:
    """Make the last page, with a link if the experiment has an address. Unmatched participants get another text."""
    page = _page(config.final_page_header_text or "Thank you!", config.final_page_text, plain="<p>This is the end.</p>")
    page += _redirect(config, config.experiment_end_redirect_url or config.end_game_redirect_url)
    if len(humans_of(config)) == 1:
        return page
    alone = _page("There was nobody to play with", "<p>Thank you for waiting.</p>")
    alone += _redirect(config, config.waitroom_timeout_redirect_url)
    return "{% if participant.unmatched %}\n" + alone + "{% else %}\n" + page + "{% endif %}\n"


def _redirect(config: RemoteConfig, address: str | None) -> str:
    """Make a link to this address, and a script that opens it after `redirect_timeout`; empty without an address."""
    if not address:
        return ""
    appended = config.append_subject_id_to_redirect or config.append_subject_name_to_redirect
    return _onward(address, bool(appended)) + (
        "<script>\n"
        '  const onward = document.getElementById("onward");\n'
        f"  setTimeout(() => location.assign(onward.href), {max(0, round(config.redirect_timeout))});\n"
        "</script>\n"
    )


def _onward(address: str, appended: bool) -> str:
    """Make a link to another site. If `appended`, its address ends in the participant's id."""
    user_id = "{{ participant.userId|urlencode }}" if appended else ""
    return f'<p><a id="onward" href="{raw(html.escape(address, quote=True))}{user_id}">Go on</a></p>\n'


def with_files(page: str, locate: Locate, files: dict[str, bytes]) -> str:
    """Add the files to which the page links to `files`, beside the page. Return the page with links to their places."""

    def beside(link: re.Match[str]) -> str:
        path = locate(link["path"])
        if path is None:
            return link[0]
        return f"{link['before']}{put(path, 'steps', files)}"

    return _LINKED.sub(beside, page)


def raw(text: str) -> str:
    """Write the text in a form that a template shows unchanged."""
    return "{% raw %}" + text + "{% endraw %}" if _JINJA.search(text) else text


def as_html(text: str) -> str:
    """Put plain text into paragraphs; return HTML as it is."""
    if _TAG.search(text):
        return text
    return "\n".join(f"<p>{html.escape(part.strip(), quote=False)}</p>" for part in text.split("\n\n") if part.strip())


def _page(heading: str, *parts: str, plain: str = "") -> str:
    shown = [as_html(part) for part in parts if part.strip()] or [plain]
    title = f"<h1>{html.escape(heading, quote=False)}</h1>" if heading and not _has_heading(shown) else ""
    return raw("\n".join(part for part in (title, *shown) if part)) + "\n"


def _has_heading(parts: Iterable[str]) -> bool:
    return any("<h1" in part for part in parts)


def quoted(text: str) -> str:
    """Write the text as a literal of Python, which is one of JSON, too."""
    return json.dumps(text, ensure_ascii=False)
