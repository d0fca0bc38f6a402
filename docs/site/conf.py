"""Sphinx's settings for the site of `make docs`: the repository's own Markdown files, as they are, by reader.

The source folder is the repository, so links between files work here as they do in a clone. A page that no list below
names, and a link or a heading that does not exist, is a warning, and a warning ends the build.
"""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

project = "Hippodrome"
copyright = "the authors of Hippodrome"
extensions = ["myst_parser"]
root_doc = "README"
include_patterns = ["*.md", "docs/**.md", "examples/*/README.md"]
exclude_patterns = [
    ".*",
    "bench",
    "data*",
    "deploy",
    "dist",
    "hippodrome",
    "infra",
    "lambdas",
    "shots",
    "testing",
    "tests",
]
html_theme = "furo"
html_title = "Hippodrome"
html_copy_source = False
html_show_sphinx = False
myst_heading_anchors = 4
myst_enable_extensions = ["html_image"]
suppress_warnings = [
    "myst.header",  # some pages have no heading of a level in between
    "misc.highlighting_failure",  # blocks with … for what is left out
]

READERS = {
    "Researchers": [
        *("docs/tutorial", "docs/config", "docs/designs", "docs/agent", "docs/site/api", "docs/callbacks"),
        *(
            "docs/players",
            "docs/sessions",
            "docs/talk",
            "docs/lobby",
            "docs/lab",
            "docs/recruiting",
            "docs/data",
            "docs/aws-project",
        ),
        *("docs/gym", "docs/hippo", "docs/interactive-gym"),
    ],
    "Participants' pages": ["docs/pages", "docs/texts", "docs/objects"],
    "Examples": sorted(path.relative_to(ROOT).with_suffix("").as_posix() for path in ROOT.glob("examples/*/README.md")),
    "Administrators": [
        *("docs/first-hour", "docs/aws", "docs/running", "docs/certificates", "docs/functions", "docs/permissions"),
        *("docs/security", "SECURITY", "docs/unproven"),
    ],
    "Programmers": ["CONTRIBUTING", "docs/architecture", "docs/decisions", "docs/wire", "CHANGELOG"],
}
"""The pages for each kind of reader, in the order of the site."""


CLASS = re.compile(r"<!-- class (\S+) (\w+) -->")


def _complete(app: Any, name: str, source: list[str]) -> None:
    if name == root_doc:
        for reader, pages in {"": ["docs/README"], **READERS}.items():
            caption = f":caption: {reader}\n" if reader else ""
            source[0] += "\n```{toctree}\n:hidden:\n" + caption + "\n" + "\n".join(pages) + "\n```\n"
    source[0] = CLASS.sub(lambda named: _class(ROOT / named[1], named[2]), source[0])


def _class(file: Path, name: str) -> str:
    """What the source says of a class: its docstring, fields and public methods. The source is read, not imported."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    (described,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    parts = [f"## {name}", ast.get_docstring(described) or ""]
    for node, after in zip(described.body, [*described.body[1:], None], strict=True):
        if isinstance(node, ast.FunctionDef) and (not node.name.startswith("_") or node.name == "__init__"):
            parts += [f"### `{_signature(node, name)}`", ast.get_docstring(node) or ""]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id[0] != "_":
            said = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            parts.append(f"* `{node.target.id}`" + (f": {inspect.cleandoc(str(said))}" if said else ""))
    return "\n\n".join(filter(None, parts)) + "\n"


def _signature(node: ast.FunctionDef, name: str) -> str:
    for argument in ast.walk(node.args):
        if isinstance(argument, ast.arg):
            argument.annotation = None
    given = ast.unparse(node.args).removeprefix("self").removeprefix(", ")
    return f"{name if node.name == '__init__' else node.name}({given})"


def _lead_to_the_readme(app: Any, error: Exception | None) -> None:
    if error is None:
        page = f'<!doctype html><meta http-equiv="refresh" content="0; url={root_doc}.html"><title>{html_title}</title>'
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app: Any) -> None:
    app.connect("source-read", _complete)
    app.connect("build-finished", _lead_to_the_readme)
