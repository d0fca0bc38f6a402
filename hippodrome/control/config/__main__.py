"""The command line.

python -m hippodrome.control.config check [FOLDER]      print every mistake, in line order
python -m hippodrome.control.config schema              print the JSON Schema, for editors
python -m hippodrome.control.config texts               print all texts that participants read, to be translated
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from hippodrome.control.config import ConfigErrors, config_schema, layout, read_project
from hippodrome.control.model.texts import GROUPS, LANGUAGE

HEAD = """\
# What Hippodrome says to participants, in English. docs/texts.md says where these texts are seen.
# For another language copy everything from "texts:" on into your config.yml, below "project:", give the language, and
# write your own words into the quotes. A text that you remove stays English.
# A study whose participants play alone needs neither "The lobby" nor "Playing with others".
project:
  texts:
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Return the exit code: 1 if there are mistakes, or remarks with --strict, otherwise 0."""
    parser = argparse.ArgumentParser(
        prog="python -m hippodrome.control.config", description="Check a project's config.yml."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    check = commands.add_parser("check", help="print every mistake in a project folder")
    check.add_argument("folder", nargs="?", default=".", type=Path, help="the project's folder (default: this one)")
    check.add_argument("--strict", action="store_true", help="count remarks, such as on HIPPO's form, as mistakes")
    commands.add_parser("schema", help="print the JSON Schema for editors")
    commands.add_parser("texts", help="print all texts that participants read, to be translated")
    chosen = parser.parse_args(arguments)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a console that lacks a character must not hide the mistake
    if chosen.command == "schema":
        sys.stdout.write(json.dumps(config_schema(), indent=2, ensure_ascii=False) + "\n")
        return 0
    if chosen.command == "texts":
        sys.stdout.write(texts_file())
        return 0
    try:
        config = read_project(chosen.folder)
    except ConfigErrors as errors:
        sys.stdout.write(f"{errors}\n")
        return 1
    for remark in config.remarks:
        sys.stdout.write(f"{remark}\n")
    if chosen.strict and config.remarks:
        return 1
    sys.stdout.write(f"{layout.find(chosen.folder).config.name} is fine: {config.summary()}\n")
    return 0


def texts_file() -> str:
    """Return the content of `docs/texts.en.yml`. Its `language` is empty, so that `hippodrome check` asks for it."""
    groups = ("".join(_group(title, texts)) for title, texts in GROUPS.items())
    return HEAD + "\n".join(groups)


def _group(title: str, texts: Mapping[str, str]) -> list[str]:
    return [f"    # {title}\n", *(f"    {name}:{_value(name, text)}\n" for name, text in texts.items())]


def _value(name: str, text: str) -> str:
    return "  # of your words, such as fr" if name == LANGUAGE else f" {json.dumps(text, ensure_ascii=False)}"


if __name__ == "__main__":
    sys.exit(main())
