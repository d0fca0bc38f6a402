"""requirements.txt of a HIPPO Gym project: what the image installs of it."""

from __future__ import annotations

import pytest

from hippodrome.config.hippo_requirements import adapt

PRESENT = ("numpy", "Pillow", "PyYAML", "websockets")


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("gym==0.17.2", "Gymnasium stands in for it"),
        ("gym[atari]==0.21.0  # games", "Gymnasium stands in for it"),
        ("atari_py==0.2.6", "ale-py stands in for it"),
        ("asyncio==3.4.3", "it is a part of Python"),
        ("pyYaml==5.4", "the image has it in a version of its own"),
        ("numpy", "the image has it in a version of its own"),
        ("numpy>=1.22.0", "the image has it in a version of its own"),
    ],
)
def test_what_the_image_has_or_does_without_is_left_out(line: str, why: str) -> None:
    text, remarks = adapt(f"# ours\n{line}\nshortuuid==1.0.1", "requirements.txt", PRESENT)
    assert text == "# ours\n\nshortuuid==1.0.1\n"
    assert [str(remark) for remark in remarks] == [f"requirements.txt:2: remark: {line} is left out: {why}"]


@pytest.mark.parametrize(
    "line",
    ["shortuuid==1.0.1", "numpy-stl==2", "gymnasium-robotics", "-r more.txt", "./numpy", "torch @ https://a.example/x"],
)
def test_everything_else_stays_as_it_is(line: str) -> None:
    assert adapt(f"{line}\n", "requirements.txt", PRESENT) == (f"{line}\n", [])
