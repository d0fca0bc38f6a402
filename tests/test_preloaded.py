"""A process that was forked with its imports done behaves in a test like `python -m …`."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from hippodrome.config import read_project
from local.check import agent
from local.check.agent_report import last_line
from testing import preloaded
from tests.local.conftest import write_study
from tests.trial.interactive_gym.experiments import ALONE, HELPER, RUN, environment, run_experiment
from trial.server import process_group

TELLS = """
import json, os, signal, sys
with open("told.json", "w") as file:
    links = [f"/proc/self/fd/{fd}" for fd in os.listdir("/proc/self/fd")]
    files = [os.readlink(link).partition(":")[0] for link in links if os.path.lexists(link)]
    json.dump({
        "arguments": sys.argv[1:], "path": sys.path[:2], "folder": os.getcwd(), "variables": dict(os.environ),
        "files": [name for name in files if name in ("socket", "pipe")], "leads": os.getsid(0) == os.getpid(),
        "interrupted": signal.getsignal(signal.SIGINT) is signal.default_int_handler,
        "name": __name__, "input": sys.stdin.read(),
    }, file)
print("out", flush=True)
print("err", file=sys.stderr)
if sys.argv[1:]:
    sys.exit(int(sys.argv[1]))
while True:
    signal.pause()
"""


@pytest.fixture(params=["forked", "new"])
def begin(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    """Start the module above; `new` has a variable that only a new Python heeds."""
    (tmp_path / "tells.py").write_text(TELLS)
    # A shell's background jobs ignore it, and hand that on.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    began = []

    def start(*arguments: str, **how: Any) -> Any:
        more = {"PYTHONHASHSEED": "1"} if request.param == "new" else {}
        env = {**os.environ, "PYTHONPATH": str(preloaded.ROOT), "WORD": "given", **more}
        began.append(preloaded.start("tells", arguments, cwd=tmp_path, env=env, stdout=subprocess.PIPE, **how))
        assert isinstance(began[-1], preloaded.Forked) == (request.param == "forked")
        return began[-1]

    yield start
    for process in began:
        process.kill()
        process.wait()
        process.stdout.close()
    signal.signal(signal.SIGINT, before)


def test_a_forked_process_has_only_its_own_arguments_and_variables(begin: Any, tmp_path: Path) -> None:
    process = begin("7", stderr=subprocess.STDOUT, start_new_session=True)
    assert process.stdout.read() == "out\nerr\n"
    assert process.wait(60) == process.returncode == 7
    told = json.loads((tmp_path / "told.json").read_text())
    assert told.pop("variables").items() >= {"WORD": "given"}.items()
    assert told == {
        "arguments": ["7"],
        "path": [str(tmp_path), str(preloaded.ROOT)],
        "folder": str(tmp_path),
        "files": ["pipe", "pipe"],
        "leads": True,
        "interrupted": True,
        "name": "__main__",
        "input": "",
    }


def test_the_output_of_a_forked_process_is_buffered_by_default(tmp_path: Path) -> None:
    (tmp_path / "says.py").write_text("import time; print('out'); open('said', 'w').close(); time.sleep(60)")
    seen = []
    for told in ("", "1"):
        env = {**os.environ, "PYTHONPATH": str(preloaded.ROOT), "PYTHONUNBUFFERED": told}
        (tmp_path / "said").unlink(missing_ok=True)
        with (tmp_path / "log").open("w") as log:
            process = preloaded.start("says", cwd=tmp_path, env=env, stdout=log, stderr=subprocess.STDOUT)
        assert isinstance(process, preloaded.Forked)
        while not (tmp_path / "said").exists():
            assert process.poll() is None
            time.sleep(0.01)
        process.kill()
        process.wait(60)
        seen.append((tmp_path / "log").read_text())
    assert seen == ["", "out\n"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_forked_process_ends_by_a_signal_and_can_be_waited_for(begin: Any, number: signal.Signals) -> None:
    process = begin(stderr=subprocess.STDOUT)
    assert process.stdout.readline() == "out\n"
    assert process.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.01)
    process.send_signal(number)
    assert process.wait(60) in (-number, 1)  # 1: KeyboardInterrupt, told by hand
    process.send_signal(number)  # and nothing happens


def test_a_signal_to_a_process_that_is_ending_is_no_error(begin: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    process = begin("0", stderr=subprocess.STDOUT)
    if isinstance(process, preloaded.Forked):
        monkeypatch.setattr(process, "poll", lambda: [process.wait(60), None][1])  # it ends meanwhile
    process.kill()
    assert process.wait(60) in (0, -signal.SIGKILL)


def test_each_forked_process_has_its_own_variables_and_memory(begin: Any) -> None:
    first, second = begin(stderr=subprocess.STDOUT), begin(stderr=subprocess.STDOUT)
    assert first.pid != second.pid
    first.kill()
    first.wait(60)
    assert second.poll() is None


def test_all_output_of_a_forked_process_is_read_and_its_end_awaited(begin: Any) -> None:
    process = begin("3", stderr=subprocess.STDOUT)
    assert process.communicate(timeout=60)[0] == "out\nerr\n"
    assert process.returncode == 3
    silent = begin(stderr=subprocess.STDOUT)
    with pytest.raises(subprocess.TimeoutExpired):
        silent.communicate(timeout=0.5)


ENDS = """
import atexit, os, sys, threading, time
atexit.register(lambda: print("at exit"))
done = threading.Event()
threading.Thread(target=lambda: [done.wait(), time.sleep(0.2), print("a thread")]).start()
threading.Thread(target=time.sleep, args=(600,), daemon=True).start()
print("main")
done.set()
CODE
"""


@pytest.mark.parametrize(
    ("statement", "code", "error"),
    [
        ("", 0, ""),
        ("sys.exit()", 0, ""),
        ("sys.exit(300)", 44, ""),
        ("sys.exit(-1)", 255, ""),
        ("sys.exit('a reason')", 1, "a reason\n"),
        ("raise ValueError('a mistake')", 1, "ValueError: a mistake\n"),
        ("os.close(1); sys.exit(3)", 120, ""),
    ],
)
@pytest.mark.parametrize("way", ["forked", "started"])
def test_a_forked_process_ends_as_any_process_does(
    tmp_path: Path, way: str, statement: str, code: int, error: str
) -> None:
    """After its threads and `atexit`, with all output written."""
    (tmp_path / "ends.py").write_text(ENDS.replace("CODE", statement))
    env = {**os.environ, "PYTHONPATH": str(preloaded.ROOT), "PYTHONUNBUFFERED": ""}
    env |= {} if way == "forked" else {"PYTHONHASHSEED": "0"}
    with (tmp_path / "errors").open("w") as errors:
        process = preloaded.start("ends", cwd=tmp_path, env=env, stdout=subprocess.PIPE, stderr=errors)
        assert isinstance(process, preloaded.Forked) == (way == "forked")
        said, _ = process.communicate(timeout=60)
    if "close" not in statement:
        assert said == "main\na thread\nat exit\n"
        assert (tmp_path / "errors").read_text().endswith(error)
    assert process.returncode == code


STARTS = """
import json, os, subprocess
from testing import preloaded
code = "import os; print(os.getppid(), sorted(os.environ.keys() - ['LC_CTYPE'])); raise SystemExit(5)"
with open("second.py", "w") as file:
    file.write(code)
before = sorted(os.environ)
second = preloaded.start("second", cwd=os.getcwd(), env=os.environ, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
assert isinstance(second, preloaded.Forked)
said, _ = second.communicate(timeout=60)
print(json.dumps([said, f"{os.getppid()} {before}\\n", second.returncode]))
"""


def test_a_forked_process_starts_others_by_the_same_forking_process(tmp_path: Path) -> None:
    """And in the environment of neither is anything of it."""
    (tmp_path / "starts.py").write_text(STARTS)
    env = {**os.environ, "PYTHONPATH": str(preloaded.ROOT)}
    options: Any = {"cwd": tmp_path, "env": env, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = preloaded.start("starts", starts=True, **options)
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 0, said
    second, own, code = json.loads(said)
    assert (second, code) == (own, 5)
    assert preloaded._ASKS not in own
    again = preloaded.start("starts", starts=True, **options)
    assert json.loads(again.communicate(timeout=60)[0])[1] == own, "who asked has gone, and the next one asks too"


PART = "import os; WORD, PID, WIDTH = {word!r}, os.getpid(), os.environ['COLUMNS']"
WHOLE = "import os, part, sys; print(part.WORD, part.WIDTH, part.PID, part.PID == os.getpid(), sys.argv[1:])"


def test_of_a_copy_of_the_project_the_present_code_is_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(preloaded.OTHERS, "whole", (("part",), {}))
    (tmp_path / "whole.py").write_text(WHOLE)
    loaded_by = []
    for word, width in [("first", "80"), ("", "80"), ("", "160"), ("changed", "80")]:
        if word:
            (tmp_path / "part.py").write_text(PART.format(word=word))
        env = {"PATH": os.environ["PATH"], "COLUMNS": width, "PYTHONDONTWRITEBYTECODE": ""}
        process = preloaded.start(
            "whole", ["x"], cwd=tmp_path, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, copied=True
        )
        assert isinstance(process, preloaded.Forked)
        said = process.communicate(timeout=60)[0].split()
        assert (said[:2], said[3:]) == ([word or "first", width], ["False", "['x']"])
        loaded_by.append(said[2])
    assert loaded_by[0] == loaded_by[1], "it is loaded once"
    assert len({*loaded_by}) == 3, "and again for other code, or for a console of another size"


AGENT_TELLS = """
import json, os, sys
class Agent:
    def start(self, game):
        names = {name.partition(".")[0] for name, module in list(sys.modules.items())
                 if "site-packages" in (getattr(module, "__file__", None) or "")}
        raise ValueError(json.dumps([
            sys.path, sorted(names), os.getcwd(), os.getsid(0) == os.getpid(), sys.dont_write_bytecode,
            sys.argv, "local.check.agent_process" in sys.modules, dict(os.environ),
        ]))
    def reset(self, seed=None): ...
    def step(self, action): ...
    def render(self): ...
    def close(self): ...
"""


def test_the_process_in_which_make_check_tries_an_agent_is_the_same_when_forked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_study(tmp_path / "study", start=2)
    (folder / "agent.py").write_text(AGENT_TELLS)
    (tmp_path / "place").mkdir()
    begun: list[Any] = []
    told: list[str] = []

    def forked(*command: Any, **options: Any) -> Any:
        begun.append(preloaded.popen(*command, **options))
        return begun[-1]

    def one_place(prefix: str) -> Any:  # for both, since the variables name it
        return contextlib.nullcontext(str(tmp_path / "place"))

    monkeypatch.setattr(agent.tempfile, "TemporaryDirectory", one_place)
    for popen in (subprocess.Popen, forked):
        monkeypatch.setattr(process_group, "Popen", popen)
        agent.try_agent(folder, read_project(folder))
        told.append(last_line((tmp_path / "place" / "report").read_text())["error"]["text"])
    assert isinstance(begun[0], preloaded.Forked)
    first, second = (json.loads(text.partition(": ")[2]) for text in told)
    assert first == second
    assert "numpy" in first[1]


EXPERIMENT_TELLS = """
import json, os, sys
files = {name: getattr(module, "__file__", None) or "" for name, module in list(sys.modules.items())}
print(json.dumps([
    __name__, __file__, __spec__, vars(sys.modules["__main__"]) is globals(), sys.argv, sys.path, os.getcwd(),
    sys.dont_write_bytecode, dict(os.environ),
    sorted(name for name, file in files.items() if "site-packages" in file or name.startswith("trial")),
]))
sys.exit("in the end")
"""


def test_the_process_of_an_experiment_is_the_same_when_forked(tmp_path: Path) -> None:
    """What is loaded, too: an experiment's project holds what the experiment has imported."""
    (tmp_path / "how.html").write_text("<h1>How</h1>")
    (tmp_path / "helper.py").write_text(HELPER)
    (tmp_path / preloaded.EXPERIMENT).write_text(ALONE + RUN.replace("SERVE", "False") + EXPERIMENT_TELLS)
    forked = run_experiment(tmp_path)
    command = [sys.executable, preloaded.EXPERIMENT]
    new = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    assert "The project is in" in forked.stdout
    assert json.loads(forked.stdout.splitlines()[-1]) == json.loads(new.stdout.splitlines()[-1])
    assert (forked.returncode, forked.stderr) == (new.returncode, new.stderr) == (1, "in the end\n")
