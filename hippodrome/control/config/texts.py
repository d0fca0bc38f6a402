"""Checks a study's own words for Hippodrome's texts (`project.texts`): mistakes, and texts that stay in English."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping

from hippodrome.control.config.config import Config
from hippodrome.control.config.diagnostics import Mistake, Remark
from hippodrome.control.config.each_value import Checked
from hippodrome.control.config.project_keys import TEXTS
from hippodrome.control.model.texts import ENGLISH, LANGUAGE, is_language, places, texts_of
from hippodrome.protocol.values import KeyPath, show

_BRACES = re.compile(r"\{[^{}]*\}")
_HTML = re.compile(r"</?[A-Za-z][^<>]*>|&(#[0-9]+|[A-Za-z]+);")
_QUOTED = re.compile("[“„«].*[”“»]")
_PAGE_LANGUAGE = re.compile(r"""<html\b[^>]*?\blang\s*=\s*["']?([A-Za-z0-9-]{2,35})""", re.IGNORECASE)
_WORD = re.compile(r"[^\W\d_]+")
_SHOWN = 3  # the most names of texts in a remark
_SENTENCE = 3  # a text with at least so many words is not the same in two languages


def mistakes(checked: Checked) -> Iterator[Mistake]:
    """Yield mistakes in texts: placeholders such as `{seconds}` that the text does not have, and wrong languages."""
    for name, text in checked.project.own_texts.items():
        if name == LANGUAGE and not is_language(text):
            yield Mistake((*TEXTS, name), f"must be a language as pages name it, such as de or pt-BR, not {show(text)}")
        elif wrong := [brace for brace in _BRACES.findall(text) if brace[1:-1] not in places(ENGLISH[name])]:
            yield Mistake((*TEXTS, name), f"nothing stands for {wrong[0]} here; {_known(name)}")
        elif match := re.search("[{}]", _BRACES.sub("", text)):
            yield Mistake((*TEXTS, name), f"participants would read {match[0]}, a brace too many; {_known(name)}")


def _known(name: str) -> str:
    """A clause that names the placeholders which this text may have."""
    placeholders = [f"{{{place}}}" for place in places(ENGLISH[name])]
    if not placeholders:
        return "this text has no placeholders"
    *first, last = placeholders
    return f"there are {', '.join(first)} and {last}" if first else f"there is {last}"


def shown_as_they_are(config: Config) -> Iterator[Remark]:
    """Yield remarks on texts with HTML or quotation marks, which participants would read as characters."""
    for name, text in config.project.own_texts.items():
        if match := _HTML.search(text):
            yield Remark((*TEXTS, name), f"participants read {match[0]} as it stands here: a text is no HTML")
        elif _QUOTED.fullmatch(text):
            message = f'participants read the quotation marks, too; YAML\'s own are "…", not {text[0]}…{text[-1]}'
            yield Remark((*TEXTS, name), message)


def left_in_english(config: Config) -> Iterator[Remark]:
    """Yield a remark if the study names another language, in `texts` or a page, and leaves texts in English."""
    own = config.project.own_texts
    pages = [file.read_text(encoding="utf-8", errors="replace") for step in config.steps for file in step.files]
    languages = [match[1] for page in pages if (match := _PAGE_LANGUAGE.search(page))]
    has_chat = config.trial.registered().get("chat") is not None
    needed = texts_of(has_game=bool(config.game_steps), has_sessions=config.project.has_sessions, has_chat=has_chat)
    yield from _left(own, languages, needed)


def _left(own: Mapping[str, str], languages: Iterable[str], needed: Iterable[str]) -> Iterator[Remark]:
    """The remark on a study that names another language, and does not translate all texts that it needs."""
    own_language = own.get(LANGUAGE)
    foreign = [language for language in (own_language, *languages) if language and not _is_english(language)]
    if not foreign or (own_language and _is_english(own_language)):
        return
    missing = [name for name in needed if name not in own or _is_untouched(name, own[name])]
    if missing:
        language = foreign[0]
        path: KeyPath = TEXTS if own else ("project",)
        shown = ", ".join(missing[:_SHOWN]) + (" …" if len(missing) > _SHOWN else "")
        which = f"{len(missing)} of Hippodrome's texts stay" if len(missing) > 1 else "one of Hippodrome's texts stays"
        message = f"the study is in another language ({language}), and {which} English: {shown}"
        yield Remark(path, f"{message}; see docs/texts.md")


def _is_untouched(name: str, text: str) -> bool:
    """Whether a text was copied and not translated. Short texts, such as Pause, can be the same in both languages."""
    return text == ENGLISH[name] and len(_WORD.findall(_BRACES.sub("", text))) >= _SENTENCE


def _is_english(language: str) -> bool:
    return language.lower().split("-")[0] == "en"
