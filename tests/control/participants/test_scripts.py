"""The modules of the game page: each says what it needs, and they can be joined into one script."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import pytest

from hippodrome.control.participants import frame, game_modules, scripts
from tests.control.participants.javascript import tokens

GAME = Path(__file__).resolve().parents[3] / "hippodrome" / "web" / "game"
MODULES = sorted(GAME.glob("*.js"), key=lambda path: path.name)

IMPORT = re.compile(r'^import \{([\w\s,]*)\} from "\./([\w-]+\.js)";$', re.MULTILINE)
DECLARED = re.compile(r"^(?P<export>export )?(?:async )?(?:const|let|function) (?P<name>\w+)(?P<more>.*)", re.MULTILINE)
NOT_CODE = re.compile(r"""^\s*//.*|\s// .*|"(?:[^"\\\n]|\\.)*"|(?<=\.)\w+|\b\w+(?=:(?!:))""", re.MULTILINE)
"""Comments, texts, properties, and keys of objects."""


def declared(module: Path, *, exported: bool = False) -> list[str]:
    """Return the top-level names of a module, `const KEY = 0, DIFFERENCE = 1` included."""
    found = []
    for match in DECLARED.finditer(module.read_text()):
        if match["export"] or not exported:
            found += [match["name"], *re.findall(r", ([A-Z]+) = ", match["more"])]
    return found


def imported(module: Path) -> dict[str, list[str]]:
    """Return the names that a module imports, by the module they come from."""
    return {name: re.findall(r"\w+", names) for names, name in IMPORT.findall(module.read_text())}


def words(module: Path) -> set[str]:
    """Return the names that the module's code mentions."""
    return set(re.findall(r"[A-Za-z_]\w*", NOT_CODE.sub(" ", IMPORT.sub("", module.read_text()))))


def local(module: Path) -> set[str]:
    """Return the names that a module declares inside its functions: variables and parameters, also unpacked ones."""
    text = module.read_text()
    found = re.findall(r"\b(?:const|let) (\w+|[\[{][^\]}]*[\]}])", text) + re.findall(
        r"\(([\w, {}=]*)\)(?: =>| \{)", text
    )
    return {name for names in found for name in re.findall(r"\w+", names)}


def test_no_top_level_name_occurs_in_two_modules() -> None:
    names = [name for module in MODULES for name in declared(module)]
    assert sorted(names) == sorted(set(names))


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.stem)
def test_a_module_imports_exactly_the_names_that_it_uses_of_others(module: Path) -> None:
    others = {name for other in MODULES if other != module for name in declared(other)}
    wanted = {name for names in imported(module).values() for name in names}
    assert words(module) & others - local(module) == wanted


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.stem)
def test_the_names_that_a_module_imports_are_exported(module: Path) -> None:
    for name, names in imported(module).items():
        assert set(names) <= set(declared(GAME / name, exported=True))


def test_every_module_is_in_the_script_behind_the_modules_that_it_imports() -> None:
    joined = scripts.join(GAME / "main.js", (*game_modules.MODULES, *game_modules.OWN_WORDS, *game_modules.TOGETHER))
    places = {module.name: joined.index(f"\n{code_of(module)}") for module in MODULES}
    assert len(set(places.values())) == len(MODULES)
    for module in MODULES:
        assert all(places[name] < places[module.name] for name in imported(module))


def test_modules_for_some_projects_are_not_in_the_script_of_others() -> None:
    joined = scripts.join(GAME / "main.js")
    assert [module.name for module in MODULES if f"\n{code_of(module)}" not in joined] == sorted(
        (
            *game_modules.MODULES,
            *game_modules.OWN_WORDS,
            *game_modules.TOGETHER,
            "sliders.js",
        )  # `reading.js` imports it
    )


def test_additional_modules_come_before_the_script_and_behind_their_imports(tmp_path: Path) -> None:
    (tmp_path / "a.js").write_text("export const a = 1;\n")
    (tmp_path / "b.js").write_text('import { a } from "./a.js";\na(2);\n')
    (tmp_path / "c.js").write_text('import { a } from "./a.js";\na(3);\n')
    assert scripts.join(tmp_path / "c.js", ("b.js",)) == "const a = 1;\na(2);\na(3);\n"


def code_of(module: Path) -> str:
    """Return the last function of a module, or its last constant, as it stands in the script."""
    match = list(DECLARED.finditer(module.read_text()))[-1]
    return match[0].removeprefix("export ")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('import all from "./b.js";', 'a.js cannot be joined: import all from "./b.js";'),
        ('import { b as c } from "./b.js";', 'a.js cannot be joined: import { b as c } from "./b.js";'),
        ("export default b;", "a.js cannot be joined: export default b;"),
        ("export { b };", "a.js cannot be joined: export { b };"),
        ('import { a } from "./a.js";', "a.js imports itself, by way of a.js"),
    ],
)
def test_a_module_that_cannot_be_joined_is_refused(tmp_path: Path, line: str, said: str) -> None:
    (tmp_path / "b.js").write_text("export const b = 1;\n")
    (tmp_path / "a.js").write_text(f"{line}\n")
    with pytest.raises(ValueError) as refused:
        scripts.join(tmp_path / "a.js")
    assert str(refused.value) == said


def test_a_module_that_two_others_import_is_in_the_script_once(tmp_path: Path) -> None:
    (tmp_path / "a.js").write_text("// A\nexport const a = 1;\n")
    (tmp_path / "b.js").write_text('import { a } from "./a.js";\nexport const b = a;\n')
    (tmp_path / "c.js").write_text('import {\n  a,\n} from "./a.js";\nimport { b } from "./b.js";\nb(a);\n')
    assert scripts.join(tmp_path / "c.js") == "// A\nconst a = 1;\nconst b = a;\nb(a);\n"


@pytest.mark.parametrize(
    ("source", "carried"),
    [
        ("  const a = (b) => ({ c: 1, d });\n", "const a=(b)=>({c:1,d});"),
        ("  if (a !== b && c) return;\n", "if(a!==b&&c)return;"),
        ('// "a\nsay("a = b", `${c} , d`); // "e\n', 'say("a = b",`${c} , d`);'),
        ("a + +b - -c;\n", "a + +b - -c;"),
        ("a(`b ${c > 1 ? `d = ${e} = f` : 2} = g`, 1);\n", "a(`b ${c > 1 ? `d = ${e} = f` : 2} = g`,1);"),
        ("{\n  a;\n}\nb()\n", "{a}b()\n"),
        ("f({ a, b: [\n  1,\n] }, /a{2,}/,\n);\n", "f({a,b:[1]},/a{2,}/);"),
    ],
)
def test_a_page_has_its_script_without_comments_spaces_and_line_ends_and_with_unchanged_texts(
    source: str, carried: str
) -> None:
    assert frame._plain("a.js", source) == carried


def shortened_tokens(source: str) -> list[str]:
    """Return the tokens of a script in the shortened form in which a page has it."""
    return tokens(frame._plain("a.js", source))


SHEET = re.compile(r"(?:addStyle\(|^const css = )`[^`]*`", re.MULTILINE)
"""A style sheet in a script. Indentation means nothing in it."""


@pytest.mark.parametrize("script", [*MODULES, GAME.parent / "step.js"], ids=lambda path: path.stem)
def test_the_shortened_script_of_a_page_has_the_same_tokens(script: Path) -> None:
    source = SHEET.sub(lambda sheet: re.sub(r"\n +", "\n", sheet[0]), script.read_text())
    assert shortened_tokens(source) == tokens(source)
    assert source.endswith("\n"), "the next module would stand on its last line"


@pytest.mark.parametrize(
    "source",
    [
        'say("a // b");\n',
        "say('a = b');\n",
        "find(/a, b/);\n",
        "find(/;}/);\n",
        'find(/"/, a = b, "c = d");\n',
        "say(`${f({ a })} = b`);\n",
        "say(`a\n  b`);\n",
        "a(); //b;\nc();\n",
        "a = [,\n];\n",
        "if (a < !--b) c();\n",
        'say("</script>" + /</script/);\n',
    ],
)
def test_the_comparison_notices_a_script_that_shortening_would_change(source: str) -> None:
    with contextlib.suppress(ValueError):
        assert shortened_tokens(source) != tokens(source)


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("a = b / c / d; // e", "a = b / c / d ;"),
        ('a(/[/"]=/g, b) / 2 /* c */ / d', 'a ( /[/"]=/g , b ) / 2 / d'),
        ("return /a/ ?.5 : b?.c ?? d", "return /a/ ? .5 : b ?. c ?? d"),
        ("a + +b - -c++ + d", "a + + b - - c ++ + d"),
        ("`a ${ { b: `c${d}` } } e`", "`a ${ { b : `c${ d }` } } e`"),
        ("{ a; }\n[b, c,]", "{ a } [ b , c ]"),
        ("x = [, b]; for (;;) {}", "x = [ , b ] ; for ( ; ; ) { }"),
    ],
)
def test_tokens_of_a_script(source: str, found: str) -> None:
    assert " ".join(tokens(source)) == found


@pytest.mark.parametrize("source", ["a }", "if (a) /b , c/.exec(d);", "`a", "`a ${b`", '"a', "3a", "a <!-- b", "@"])
def test_text_that_is_no_script_raises_value_error(source: str) -> None:
    with pytest.raises(ValueError):
        tokens(source)
