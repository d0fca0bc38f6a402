"""Makes the pages of steps/ from an experiment's texts."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from typing import Any

from hippodrome.trial.interactive_gym.files import locate, put
from hippodrome.trial.interactive_gym.options import Look, RemoteConfig, Unplayable
from hippodrome.trial.interactive_gym.scenes import CompletionCodeScene

_LINKED = re.compile(r'(?P<before>\b(?:src|href)=")(?P<path>[^":#?{}]+\.[A-Za-z0-9]+)(?=")')


def around(config: RemoteConfig) -> tuple[dict[str, str], dict[str, str]]:
    """Make the pages before the game, and the pages after it. Return both by the pages' names, in their order."""
    scenes = config.scenes
    place = scenes.index(config) if scenes else 0
    before = {_name("before", number, scene): _static(scene) for number, scene in enumerate(scenes[:place], 1)}
    after = {_name("after", number, scene): _static(scene) for number, scene in enumerate(scenes[place + 1 :], 1)}
    heading = config.welcome_header_text or config.page_title
    welcome = _page(heading, config.welcome_text or "Press the button to begin.")
    return before or {"welcome": welcome}, after or {"final": _final(config)}


def _name(where: str, number: int, scene: Any) -> str:
    """Return the name of a scene's page. It begins with the scene's id, if that can be part of a name."""
    name = str(scene.scene_id)
    fits = scene.scene_id and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,60}", name)
    return f"{name}_{where}_{number}" if fits else f"{where}_{number}"


def _static(scene: Any) -> str:
    subheader = _text(scene.scene_subheader)
    page = _page(scene.scene_header, f"<p>{subheader}</p>" if subheader else "", scene.scene_body)
    if isinstance(scene, CompletionCodeScene):
        page += '<p class="code">{{ completion_code }}</p>\n'
    url = getattr(scene, "url", None)
    return page + (_onward(url, scene.append_subject_id) if url else "")


def instructions(config: RemoteConfig, look: Look, remark: Callable[[str], None]) -> str:
    """Make the page with the instructions; empty if the experiment has none. Raises Unplayable."""
    parts = []
    if config.instructions_html_file is not None:
        path = locate(config.instructions_html_file)
        if path is None:
            raise Unplayable(f"instructions_html_file: there is no {config.instructions_html_file}")
        parts.append(path.read_text(encoding="utf-8"))
    parts += [config.instructions, config.game_page_text]
    if config.game_page_html_fn is not None:
        first, *others = config.humans
        look.game.human_players = {first: "participant"}
        parts.append(config.game_page_html_fn(look.game, "participant"))
        if others:
            remark(f"game_page_html_fn is called for {first} alone: all participants read the same instructions")
    return _page(config.game_header_text or "How to play", *parts) if any(map(_text, parts)) else ""


def between(config: RemoteConfig) -> str:
    """Make the page between two episodes; empty if there is none."""
    texts = config.between_episode_header, config.between_episode_text
    return _page(*texts) if any(texts) else ""


def _final(config: RemoteConfig) -> str:
    """Make the last page, with a link if the experiment has an address. Unmatched participants get another text."""
    page = _page(config.final_page_header_text or "Thank you!", config.final_page_text or "This is the end.")
    page += _redirect(config, config.experiment_end_redirect_url or config.end_game_redirect_url)
    if len(config.humans) == 1:
        return page
    alone = _page("There was nobody to play with", "Thank you for waiting.")
    alone += _redirect(config, config.waitroom_timeout_redirect_url)
    return "{% if participant.unmatched %}\n" + alone + "{% else %}\n" + page + "{% endif %}\n"


def _redirect(config: RemoteConfig, address: str | None) -> str:
    """Make a link to this address, and a script that opens it after `redirect_timeout`; empty without an address."""
    if not address:
        return ""
    return _onward(address, config.append_subject_id_to_redirect or config.append_subject_name_to_redirect) + (
        "<script>\n"
        '  const onward = document.getElementById("onward");\n'
        f"  setTimeout(() => location.assign(onward.href), {max(0, round(config.redirect_timeout))});\n"
        "</script>\n"
    )


def _onward(address: str, appended: bool) -> str:
    """Make a link to another site. If `appended`, its address ends in the participant's id."""
    user_id = "{{ participant.userId|urlencode }}" if appended else ""
    return f'<p><a id="onward" href="{_raw(html.escape(_text(address), quote=True))}{user_id}">Go on</a></p>\n'


def with_files(page: str, files: dict[str, bytes]) -> str:
    """Add the files to which the page links to `files`, beside the page. Return the page with links to their places."""

    def beside(link: re.Match[str]) -> str:
        path = locate(link["path"])
        return link[0] if path is None else link["before"] + put(path, "steps", files)

    return _LINKED.sub(beside, page)


def _page(heading: Any, *parts: Any) -> str:
    """Make a page. Its heading is left out if one of the parts has an `<h1>`."""
    shown = [_as_html(text) for text in map(_text, parts) if text.strip()]
    if _text(heading) and not any("<h1" in text for text in shown):
        shown.insert(0, f"<h1>{html.escape(_text(heading), quote=False)}</h1>")
    return _raw("\n".join(shown)) + "\n"


def _text(value: Any) -> str:
    """Return the text that an option or a scene is given. Parts of a tuple, as by a stray comma, are joined."""
    if isinstance(value, list | tuple):
        return "\n".join(map(_text, value))
    return "" if value is None else str(value)


def _as_html(text: str) -> str:
    """Put plain text into paragraphs; return HTML as it is."""
    if re.search(r"<[A-Za-z/!]", text):
        return text
    return "\n".join(f"<p>{html.escape(part.strip(), quote=False)}</p>" for part in text.split("\n\n") if part.strip())


def _raw(text: str) -> str:
    """Write the text in a form that a template shows unchanged."""
    return "{% raw %}" + text + "{% endraw %}" if re.search(r"\{[{%#]", text) else text
