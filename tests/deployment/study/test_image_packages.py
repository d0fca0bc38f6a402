"""The packages of an image: chosen for the servers, whatever machine they are chosen on. Real uv, wheels of our own."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from hippodrome import places
from hippodrome.console.problem import Problem
from hippodrome.deployment.code.packages import SERVER_PINS, read_pins
from hippodrome.deployment.study.image import packages
from hippodrome.deployment.study.image.packages import Packages, explained, install

ROOT = Path(__file__).resolve().parents[3]


def wheel(folder: Path, name: str, version: str, needs: tuple[str, ...] = (), tag: str = "py3-none-any") -> str:
    """Make a wheel, and return the hash that uv wants of it."""
    import base64
    import hashlib

    info = f"{name}-{version}.dist-info"
    members = {
        f"{name}.py": f"version = {version!r}\n",
        f"{name}_tests/tests/test_it.py": "",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
        + "".join(f"Requires-Dist: {need}\n" for need in needs),
        f"{info}/WHEEL": f"Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: {tag}\n",
        f"{info}/entry_points.txt": f"[console_scripts]\n{name} = {name}:main\n",
    }
    rows = [
        f"{member},sha256={base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).decode().rstrip('=')},{len(text)}"
        for member, text in members.items()
    ]
    members[f"{info}/RECORD"] = "\n".join([*rows, f"{info}/RECORD,,", ""])
    place = folder / name
    place.mkdir(exist_ok=True)
    file = place / f"{name}-{version}-{tag}.whl"
    with zipfile.ZipFile(file, "w") as archive:
        for member, text in members.items():
            archive.writestr(member, text)
    links = "".join(f'<a href="{each.name}">{each.name}</a>' for each in place.glob("*.whl"))
    (place / "index.html").write_text(f"<!DOCTYPE html><html><body>{links}</body></html>")
    return hashlib.sha256(file.read_bytes()).hexdigest()


@pytest.fixture
def wheels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A trial that needs `game`, which brings `base` along; and an index with these and what studies need."""
    folder, root = tmp_path / "wheels", tmp_path / "root/requirements"
    folder.mkdir()
    root.mkdir(parents=True)
    hashes = {
        "game": wheel(folder, "game", "1.0", ("base>=1",)),
        "base": wheel(folder, "base", "1.0"),
    }
    wheel(folder, "base", "2.0")
    wheel(folder, "base", "0.9")
    wheel(
        folder,
        "extra",
        "1.0",
        ("old; python_version < '3.12'", "new; python_version >= '3.13'", "elsewhere; sys_platform != 'linux'"),
    )
    wheel(folder, "new", "3.0")
    wheel(folder, "modern", "1.0", ("base>=2",))
    wheel(folder, "ancient", "1.0", ("base<1",))
    (root / "trial.txt").write_text("game==1.0\n")
    (root / "image.txt").write_text("".join(f"{name}==1.0 --hash=sha256:{value}\n" for name, value in hashes.items()))
    monkeypatch.setattr(places, "ROOT", tmp_path / "root")
    monkeypatch.setenv("PIP_INDEX_URL", folder.as_uri())
    monkeypatch.setenv("UV_CACHE_DIR", str(tmp_path / "uv"))  # it would remember the pages of this index
    return folder


def modules(installed: Packages) -> set[str]:
    return {path.stem for path in installed.folder.glob("*.py")}


def test_all_studies_share_the_trials_packages(wheels: Path, tmp_path: Path) -> None:
    (alone,) = install("# none\n", tmp_path / "cache")
    shared, own = install("extra\n", tmp_path / "cache")
    assert shared == alone
    assert modules(alone) == {"game", "base"}
    assert modules(own) == {"extra", "new"}, "markers are those of the servers' Python and system, not of this machine"


def test_only_what_always_is_the_same_goes_into_the_image(wheels: Path, tmp_path: Path) -> None:
    shared, own = install("extra\n", tmp_path / "cache")
    names = {path.relative_to(own.folder).as_posix() for path in own.folder.rglob("*") if path.is_file()}
    assert {name for name in names if ".dist-info" in name and name.startswith("extra")} == {
        f"extra-1.0.dist-info/{name}" for name in ("METADATA", "WHEEL", "entry_points.txt")
    }
    assert not any(name.startswith("bin/") for name in names), "scripts name this machine's Python"
    assert "extra_tests/tests/test_it.py" in names, "nobody here knows what a study's packages need of themselves"
    assert not list(shared.folder.glob("*_tests/tests/*.py"))
    assert "hippodrome/packages/lib/python3.13/site-packages/extra.py" in own.entries


def test_a_study_may_need_another_version_of_what_the_trials_packages_bring_along(wheels: Path, tmp_path: Path) -> None:
    (together,) = install("modern\n", tmp_path / "cache")
    assert modules(together) == {"game", "base", "modern"}
    assert (together.folder / "base.py").read_text() == "version = '2.0'\n"


def test_versions_stay_until_they_are_looked_up_anew(wheels: Path, tmp_path: Path) -> None:
    _, before = install("extra\n", tmp_path / "cache")
    wheel(wheels, "new", "4.0")
    assert install("extra\n", tmp_path / "cache")[1] == before
    _, after = install("extra\n", tmp_path / "cache", fresh=True)
    assert (after.folder / "new.py").read_text() == "version = '4.0'\n"


def test_packages_that_do_not_fit_the_trials_are_refused(wheels: Path, tmp_path: Path) -> None:
    with pytest.raises(Problem, match="do not fit together, or not with the trial's") as caught:
        install("ancient\n", tmp_path / "cache")
    assert any("base<1" in line for line in caught.value.details)
    with pytest.raises(Problem, match="A package cannot be found") as caught:
        install("nosuchthing==9\n", tmp_path / "cache")
    assert "requirements.txt asks for nosuchthing" in caught.value.advice


def test_a_package_without_a_wheel_is_named_with_the_way_out(wheels: Path, tmp_path: Path) -> None:
    wheel(wheels, "compiled", "1.0", tag="cp311-cp311-macosx_11_0_arm64")
    with pytest.raises(Problem) as caught:
        install("compiled\n", tmp_path / "cache")
    told = f"{caught.value} {caught.value.advice} {' '.join(caught.value.details)}"
    assert "compiled" in told
    problem = explained(
        "error: Failed to download and build `netifaces==0.11.0`\n"
        "  cause: The built wheel `netifaces-0.11.0-cp311-cp311-linux_x86_64.whl` is not compatible with the target "
        "Python 3.13 on Linux x86_64. Consider using `--no-build` to disable building wheels.\n"
    )
    assert str(problem) == "netifaces==0.11.0 has no wheel for Python 3.13 on Linux and would have to be compiled."
    assert "--docker --base public.ecr.aws/docker/library/python:3.13-trixie" in problem.advice
    failed = explained("error: Failed to build `box2d-py==2.3.8`\n  cause: The build backend returned an error\n")
    assert str(failed).startswith("box2d-py==2.3.8 has no wheel")


def test_a_network_that_fails_is_not_blamed_on_a_package() -> None:
    problem = explained(
        "error: Failed to download and build `idna @ https://files.example.org/x.zip`\n"
        "  cause: Request failed after 3 retries in 6.0s\n  cause: dns error\n"
    )
    assert str(problem) == "The packages could not be downloaded."


def test_pips_index_is_uvs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PIP_INDEX_URL", raising=False)
    text = "[global]\nindex-url = https://mirror.example/simple\nextra-index-url = https://piwheels.example/simple\n"
    (tmp_path / "pip.conf").write_text(text)
    monkeypatch.setenv("PIP_CONFIG_FILE", str(tmp_path / "pip.conf"))
    assert packages._index() == ["--default-index", "https://mirror.example/simple"]
    monkeypatch.setenv("PIP_INDEX_URL", "https://other.example/simple")
    assert packages._index() == ["--default-index", "https://other.example/simple"]


def test_the_lock_has_the_trials_packages() -> None:
    """`python -m hippodrome.deployment.code.packages` writes it anew."""
    pins, trial = read_pins(SERVER_PINS), read_pins(ROOT / "requirements/trial.txt")
    assert {name: pins[name].version for name in trial} == {name: pin.version for name, pin in trial.items()}
    assert all(pin.sha256 for pin in pins.values())
