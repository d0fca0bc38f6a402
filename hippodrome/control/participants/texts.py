"""Puts a study's texts (`control/model/texts.py`) into the scripts and templates of `web/`, which name them.

A page contains neither names nor a table of texts, which would be more than a tenth of the game page's script. In a
script, `TEXT.start` becomes `"Start"`, and `TEXT.seconds(left)` becomes `` `${left} seconds` ``. The expression between
the brackets is evaluated as often as its placeholder is in the text, so it must have no effect but its value.
"""

from __future__ import annotations

import html
import json
import re

from hippodrome.control.model.texts import ENGLISH, IN_ENGLISH, LANGUAGE, PLACE, Texts, is_language, places

NAMED = re.compile(r"\bTEXT\.([A-Za-z]+)")


def in_script(code: str, texts: Texts) -> str:
    """Return the script with a study's texts in place of their names (`TEXT.start`)."""
    return _filled(code, {**texts.all(), LANGUAGE: _for_numbers(texts.language)})


def _for_numbers(language: str) -> str:
    """The language in which a script lets the browser format numbers, with the digits 0 to 9.

    English if the text is no valid language, as in a project that was registered without a check: the browser's
    functions would raise.
    """
    english = IN_ENGLISH.language
    return f"{language}-u-nu-latn" if language != english and is_language(language) else english


def in_template(template: str, texts: Texts) -> str:
    """Return the HTML template with a study's texts, escaped, in place of their names.

    `{step}` in a text becomes `$step`.
    """
    texts_by_name = texts.all()
    return NAMED.sub(lambda match: _in_html(texts_by_name[match[1]], places(ENGLISH[match[1]])), template)


def _in_html(text: str, placeholders: tuple[str, ...]) -> str:
    safe = html.escape(text, quote=False).replace('"', "&quot;").replace("$", "$$")
    return PLACE.sub(lambda place: f"${place[0]}" if place[1] in placeholders else place[0], safe)


def _filled(code: str, texts: dict[str, str]) -> str:
    done, at = "", 0
    while match := NAMED.search(code, at):
        done += code[at : match.start()]
        name, at = match[1], match.end()
        values: dict[str, str] = {}
        if placeholders := places(ENGLISH[name]):
            arguments, at = _arguments(code, at)
            values = dict(zip(placeholders, (_filled(argument, texts) for argument in arguments), strict=True))
        if done.endswith("${") and code.startswith("}", at):  # `${TEXT.name}`: the text becomes part of the template
            done, at = done[:-2] + _in_template(texts[name], values), at + 1
        else:
            done += f"`{_in_template(texts[name], values)}`" if values else _literal(texts[name])
    return done + code[at:]


def _literal(text: str) -> str:
    """The text as a string literal. `<` could end the script, and two characters end a line in older browsers."""
    written = json.dumps(text, ensure_ascii=False).replace("<", "\\u003c")
    return written.replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _in_template(text: str, values: dict[str, str]) -> str:
    """The text as a part of a template literal, with code in its places."""
    inner = _literal(text)[1:-1].replace('\\"', '"').replace("`", "\\`").replace("$", "\\$")
    return PLACE.sub(lambda place: "${" + values[place[1]] + "}" if place[1] in values else place[0], inner)


_TOKEN = re.compile(r'"(?:[^"\\\n]|\\.)*"|`[^`$]*`|[(\[{]|[)\]}]|,|[^"`(\[{)\]},]+')


def _arguments(code: str, at: int) -> tuple[list[str], int]:
    """The arguments between the brackets that open at `at`, and the index after the closing bracket."""
    arguments, depth = [""], 0
    while token := _TOKEN.match(code, at):
        at = token.end()
        depth += (token[0] in "([{") - (token[0] in ")]}")
        if depth == 0:
            return arguments, at
        if depth == 1 and token[0] == ",":
            arguments.append("")
        elif depth > 1 or token[0] != "(":
            arguments[-1] += token[0] if arguments[-1] else token[0].lstrip()
    raise ValueError(f"brackets without an end: {code[at : at + 40]}")
