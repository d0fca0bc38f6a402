"""Sphinx's settings for the site of `make docs`: the repository's own Markdown files, as they are, by reader.

The source folder is the repository, so links between files work here as they do in a clone. A page that no list below
names, and a link or a heading that does not exist, is a warning, and a warning ends the build.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

project = "Hippodrome"
copyright = "the authors of Hippodrome"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
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
default_role = "code"
# The signatures are enough, so the site needs none of the product's packages.
autodoc_mock_imports = ["ale_py", "gymnasium", "numpy", "websockets", "msgspec", "PIL", "psutil"]
autodoc_typehints = "none"
autodoc_member_order = "bysource"

READERS = {
    "Researchers": [
        *("docs/tutorial", "docs/config", "docs/designs", "docs/agent", "docs/site/api", "docs/callbacks"),
        *(
            "docs/players",
            "docs/sessions",
            "docs/talk",
            "docs/lobby",
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


def _with_lists_of_pages(app: Any, name: str, source: list[str]) -> None:
    if name != root_doc:
        return
    for reader, pages in {"": ["docs/README"], **READERS}.items():
        caption = f":caption: {reader}\n" if reader else ""
        source[0] += "\n```{toctree}\n:hidden:\n" + caption + "\n" + "\n".join(pages) + "\n```\n"


def _lead_to_the_readme(app: Any, error: Exception | None) -> None:
    if error is None:
        page = f'<!doctype html><meta http-equiv="refresh" content="0; url={root_doc}.html"><title>{html_title}</title>'
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app: Any) -> None:
    app.connect("source-read", _with_lists_of_pages)
    app.connect("build-finished", _lead_to_the_readme)
