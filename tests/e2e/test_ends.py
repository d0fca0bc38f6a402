"""`try --ends`: bots go to each cell and each end; an end that nobody can reach is named, with its rule and line."""

from __future__ import annotations

import textwrap
from pathlib import Path

from hippodrome.local.rehearsal.study_process import servers_of
from testing.processes import ROOT
from tests.e2e.test_rehearsal import rehearsal, said

CONFIG = """
project:
  id: ways
  live: true
  conditions: {advice: [on, off]}
  steps:
    - about
    - say: {page: "say-{advice}"}
    - debrief
  ends:
    veryYoung: answers.about.age < 14
    young: answers.about.age < 18
    child: answers.about.age < 12
    never: answers.say.more == "nothing"
    odd: answers.say.more == "much" and condition.advice == "on"
    late: {minutes: 45}
"""
MORE = '<select name="more" required><option value="">-<option>much<option>little</select><button>Go</button>'
PAGES = {
    "about": '<input type="number" name="age" min="10" max="99" required><button>Go</button>',
    "say-on": MORE,
    "say-off": MORE,
    "debrief": "<p>{{ completion_code }}</p>",
}


def study(folder: Path, config: str = CONFIG) -> Path:
    (folder / "steps").mkdir(parents=True)
    (folder / "config.yml").write_text(config)
    for name, text in PAGES.items():
        (folder / "steps" / f"{name}.html").write_text(text)
    return folder


def table(text: str) -> dict[str, str]:
    """The rows of the table of cells and ends: what stands beside each name."""
    rows = [line.strip("│ ").split("│") for line in text.partition("Cells and ends")[2].splitlines() if "│" in line]
    return {row[0].strip(): row[1].strip() for row in rows}


def test_each_cell_and_end_is_reached_and_the_others_are_named_with_their_lines(tmp_path: Path) -> None:
    folder = study(tmp_path / "study")
    process = rehearsal(folder, "--ends", "--ramp", "0", "--data", tmp_path / "data")
    text = said(process)
    assert process.returncode == 1, text
    rows = table(text)
    for reached in ("cell on", "cell off", "end complete", "end veryYoung", "end young", "end odd"):
        assert int(rows[reached]) > 0, text
    assert (rows["end child"], rows["end never"], rows["end late"]) == ("0", "0", "not tried")
    assert "config.yml:13: project.ends.child: no bot could reach this end. Its rule is answers.about.age < 12." in text
    assert "veryYoung stands before it in the file, and counts first." in text
    assert (
        'config.yml:14: project.ends.never: no bot could reach this end. Its rule is answers.say.more == "nothing"'
        in text
    )
    assert "No value that their pages offer makes it true." in text
    assert "logs of local mode" not in text, "nothing went wrong with the study itself"
    assert servers_of(tmp_path / "data") == []


def test_a_cell_whose_people_all_end_before_stays_empty(tmp_path: Path) -> None:
    out = (
        textwrap.dedent(CONFIG).partition("  ends:\n")[0]
        + '  ends:\n    off: condition.advice == "off" and answers.say.more != ""\n'
    )
    process = rehearsal(study(tmp_path / "study", out), "--ends", "--ramp", "0", "--data", tmp_path / "data")
    text = said(process)
    assert process.returncode == 1, text
    rows = table(text)
    assert (rows["cell off"], int(rows["cell on"]) > 0, int(rows["end off"]) > 0) == ("0", True, True), text
    assert "config.yml:5: project.conditions: cell off stayed empty. The bots sent there came to: end off (3)." in text


def test_the_example_with_four_cells_and_its_ends_is_fine(tmp_path: Path) -> None:
    example = ROOT / "examples" / "two-by-two"
    process = rehearsal(example, "--ends", "--play", "0", "--ramp", "0", "--data", tmp_path / "data")
    text = said(process)
    assert process.returncode == 0, text
    rows = table(text)
    assert [rows[f"cell {cell}"] for cell in ("copycat,shown", "copycat,hidden", "greedy,shown", "greedy,hidden")] == [
        "1"
    ] * 4
    assert (rows["end declined"], rows["end screenedOut"], rows["end late"]) == ("1", "1", "not tried")
