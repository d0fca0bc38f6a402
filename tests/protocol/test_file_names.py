"""Names of files that look alike are one name."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import pytest

from hippodrome.protocol.file_names import composed, on_disk

COMPOSED, DECOMPOSED = (unicodedata.normalize(form, "Übungé") for form in ("NFC", "NFD"))


@pytest.mark.parametrize("written", [COMPOSED, DECOMPOSED])
@pytest.mark.parametrize("stored", [COMPOSED, DECOMPOSED])
def test_a_file_is_found_in_either_form_of_its_name(tmp_path: Path, written: str, stored: str) -> None:
    (tmp_path / stored).mkdir()
    (tmp_path / stored / f"{stored}.onnx").touch()
    assert on_disk(tmp_path, f"{written}/{written}.onnx") == tmp_path / stored / f"{stored}.onnx"
    assert composed(stored) == COMPOSED


@pytest.mark.parametrize("name", ["x.onnx", f"{COMPOSED}.onnx", f"none/{COMPOSED}.onnx"])
def test_a_missing_file_is_where_it_would_be(tmp_path: Path, name: str) -> None:
    assert on_disk(tmp_path, name) == tmp_path / name
