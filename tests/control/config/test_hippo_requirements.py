"""The lines of a HIPPO Gym project's requirements.txt that the image installs."""

from __future__ import annotations

import pytest

from hippodrome.control.config.hippo_requirements import adapt

HERE = "left out, since the servers' image has them in versions of its own"
PRESENT = ("numpy", "Pillow", "PyYAML", "websockets")


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("gym==0.17.2", "left out: gym (Gymnasium stands in for it)"),
        ("gym[atari]==0.21.0  # games", "left out: gym (Gymnasium stands in for it)"),
        ("atari_py==0.2.6", "left out: atari-py (ale-py stands in for it)"),
        ("asyncio==3.4.3", "left out: asyncio (it is a part of Python)"),
        ("pyYaml==5.4", f"{HERE}: pyyaml"),
        ("numpy", f"{HERE}: numpy"),
        ("numpy>=1.22.0", f"{HERE}: numpy"),
    ],
)
def test_packages_that_the_image_has_or_does_not_need_are_left_out(line: str, why: str) -> None:
    text, remarks = adapt(f"# ours\n{line}\nshortuuid==1.0.1", "requirements.txt", PRESENT)
    assert text == "# ours\n\nshortuuid==1.0.1\n"
    assert [str(remark) for remark in remarks] == [f"requirements.txt: remark: {why}"]


def test_packages_that_are_left_out_are_named_in_two_remarks() -> None:
    lines = "gym==0.17.2\nasyncio\nnumpy==1.18.5\nPillow==7.0.0\nshortuuid==1.0.1\n"
    text, remarks = adapt(lines, "requirements.txt", PRESENT)
    assert text == "\n\n\n\nshortuuid==1.0.1\n"
    assert [remark.message for remark in remarks] == [
        "left out: gym (Gymnasium stands in for it), asyncio (it is a part of Python)",
        f"{HERE}: numpy, pillow",
    ]


@pytest.mark.parametrize(
    "line",
    ["shortuuid==1.0.1", "numpy-stl==2", "gymnasium-robotics", "-r more.txt", "./numpy", "torch @ https://a.example/x"],
)
def test_all_other_lines_stay_unchanged(line: str) -> None:
    assert adapt(f"{line}\n", "requirements.txt", PRESENT) == (f"{line}\n", [])
