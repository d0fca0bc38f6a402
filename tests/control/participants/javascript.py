"""The tokens of a script, by the grammar of ECMAScript (section 12), so that two forms of it can be compared."""

from __future__ import annotations

import re

_SPACE = re.compile(r"(?:[ \t\n]|//[^\n]*|/\*(?:[^*]|\*(?!/))*\*/)*")
_TOKEN = re.compile(
    r"""(?P<name>\#?[A-Za-z_$][\w$]*)
    | (?P<number>(?:0[xX][0-9a-fA-F]+|(?:[0-9][0-9_]*\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)n?(?![\w$.]))
    | (?P<text>"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*')
    | (?P<sign>=>|\.\.\.|\?\.(?![0-9])|>>>=?|(?:\*\*|<<|>>|&&|\|\||\?\?)=?|[=!]==?|[-+*%&|^<>]=|\+\+|--
        |[-+*%&|^<>=!~?:;,.(){}[\]])""",
    re.VERBOSE,
)
_REGULAR = re.compile(r"/(?![*/])(?:[^\\/\[\n]|\\.|\[(?:[^\]\\\n]|\\.)*\])+/[a-z]*")
_DIVIDED = re.compile(r"/=|/(?=[ (])")  # before anything else it may be a regular expression: `if (a) /b/.exec(c)`
_TEMPLATE = re.compile(r"(?:[^`\\$]|\\.|\$(?!\{))*(`|\$\{)", re.DOTALL)
_OPERATORS = {"return", "typeof", "case", "in", "of", "delete", "void", "throw", "new", "else", "do", "await", "yield"}
_ENDS = {")", "]", "}", "++", "--"}


def tokens(code: str) -> list[str]:
    """Return the tokens, without the spaces between them. A template gives its texts and the tokens of the code in it.

    Left out, because they have no effect: a semicolon at the end of a block, a comma behind the last item of a list.
    Raises ValueError for text that is no token, that would begin a comment of HTML, or that would end the script.
    """
    found, end = _tokens(code, 0)
    if end != len(code):
        raise ValueError(f"brackets that nothing opens: {code[end : end + 40]}")
    return [token for token, before, after in zip(found, ["", *found], [*found[1:], ""], strict=False) if not (
        (token == ";" and after == "}") or (token == "," and after in _ENDS and before not in ("[", ","))
    )]  # fmt: skip


def _tokens(code: str, at: int) -> tuple[list[str], int]:
    """Return the tokens from `at` to a closing bracket that was opened before, and its position; or to the end."""
    found: list[str] = []
    depth = 0
    while (at := _end(_SPACE, code, at)) < len(code) and (depth or code[at] != "}"):
        if re.compile(r"<!--|-->|</?script", re.IGNORECASE).match(code, at):
            raise ValueError(f"a browser may take this for HTML: {code[at : at + 40]}")
        if code[at] == "`":
            inside, at = _template(code, at)
            found += inside
            continue
        previous = found[-1] if found else ""
        divides = previous in _ENDS or (re.match(r"[\w$\"'`#]", previous) and previous not in _OPERATORS)
        kind = (_DIVIDED if divides else _REGULAR) if code[at] == "/" else _TOKEN
        token = kind.match(code, at)
        if token is None:
            raise ValueError(f"no token: {code[at : at + 40]}")
        depth += (token[0] == "{") - (token[0] == "}")
        found.append(token[0])
        at = token.end()
    return found, at


def _template(code: str, at: int) -> tuple[list[str], int]:
    """Return the template that begins at `at`, and the position of its end."""
    found: list[str] = []
    while True:
        part = _TEMPLATE.match(code, at + 1)
        if part is None:
            raise ValueError(f"a template without an end: {code[at : at + 40]}")
        found.append(code[at : part.end()])
        if part[1] == "`":
            return found, part.end()
        inside, at = _tokens(code, part.end())
        found += inside


def _end(pattern: re.Pattern[str], code: str, at: int) -> int:
    found = pattern.match(code, at)
    return found.end() if found else at
