"""What `make check` advises where agent.py imports what is not there, by the errors that Python and Gymnasium raise."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hippodrome.local.check.remedies import remedy

OLD_GYM = Path(__file__).resolve().parents[3] / "hippodrome/trial/agent/old_gym"
STAND_IN = "; what stands in for Gym here has no {}: use Gymnasium's, or leave it out (docs/hippo.md#agents)"
PACKAGE = "; name its package in a requirements.txt beside agent.py: {}"


@pytest.fixture(autouse=True)
def without_gym(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the process of `make check`: tests before this one may have loaded an agent in this process, and with it `gym`."""
    monkeypatch.setattr(sys, "path", [place for place in sys.path if Path(place) != OLD_GYM])
    for name in [name for name in sys.modules if name.partition(".")[0] == "gym"]:
        monkeypatch.delitem(sys.modules, name)


@pytest.mark.parametrize(
    ("code", "advice"),
    [
        ("import no_such_thing", PACKAGE.format("no_such_thing")),
        ("import no_such_thing.part", PACKAGE.format("no_such_thing")),
        ("import stable_baselines", "; it needs TensorFlow 1 and Python 3.7: use stable_baselines3"),
        ("import atari_py", "; ale_py stands in for it"),
        ("import numpy.no_such_part", "; the numpy that is installed does not have it"),
        ("import gym.wrappers.monitoring", STAND_IN.format("gym.wrappers.monitoring")),
        ("from gym.wrappers import LazyFrames", STAND_IN.format("gym.wrappers.LazyFrames")),
        ("import gym; gym.no_such_name", STAND_IN.format("gym.no_such_name")),
        ("import numpy; numpy.no_such_name", ""),
        ("from numpy import no_such_name", ""),
        ("1 / 0", ""),
    ],
)
def test_the_advice_fits_the_error(code: str, advice: str) -> None:
    assert remedy(*raised(code)) == advice


@pytest.mark.parametrize(("module", "package"), [("sklearn", "scikit-learn"), ("cv2", "opencv-python-headless")])
def test_the_advice_names_the_package_and_not_the_module(module: str, package: str) -> None:
    assert remedy("ModuleNotFoundError", f"ModuleNotFoundError: No module named '{module}'") == PACKAGE.format(package)


def test_gymnasium_names_its_packages_itself() -> None:
    text = 'Box2D is not installed, run `pip install swig` followed by `pip install "gymnasium[box2d]"`'
    advice = "; instead of installing it by hand, name it in a requirements.txt beside agent.py: gymnasium[box2d]"
    assert remedy("DependencyNotInstalled", text) == advice


@pytest.mark.parametrize(
    ("game", "proposed"),
    [
        ("MiniGrid-DoorKey-5x5-v0", "MODULE:MiniGrid-DoorKey-5x5-v0"),
        ("Numpy/X-v0", "numpy:Numpy/X-v0"),
        ("CartPol-v1", None),
    ],
)
def test_an_id_that_gymnasium_does_not_have_needs_the_module_that_registers_it(game: str, proposed: str | None) -> None:
    advice = remedy(*raised(f"import gymnasium; gymnasium.make({game!r})"), game)
    assert advice == (
        f"; if another package has it, write the package's module before it (game: {proposed}), and the package into a "
        "requirements.txt beside agent.py"
        if proposed
        else ""
    )


def raised(code: str) -> tuple[str, str]:
    """Return the name and the text of the error that the code raises where `import gym` finds the stand-in."""
    program = f"try:\n    {code}\nexcept Exception as error:\n    print(type(error).__name__, error, sep='\\n')"
    source = f"import sys; sys.path.append({str(OLD_GYM)!r})\n{program}"
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=True)
    kind, text = done.stdout.splitlines()
    return kind, text
