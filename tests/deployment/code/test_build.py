"""The functions' zips: their contents, that each runs alone, and that the same input gives the same bytes."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import io
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from hippodrome import places
from hippodrome.console.problem import Problem
from hippodrome.deployment.code import build, bytecode, packages
from hippodrome.deployment.code.packages import Pin, Target, WheelCache
from testing.exploration import sample

LAMBDA = Target()
HERE = Target.here()
RUNTIME = ("boto3", "botocore", "dateutil", "jmespath", "s3transfer", "six", "urllib3")


@pytest.fixture(scope="module", params=[LAMBDA, HERE], ids=str)
def built(request: pytest.FixtureRequest) -> dict[str, build.Function]:
    return {function.name: function for function in build.functions(request.param)}


@pytest.fixture(scope="module")
def for_here() -> dict[str, build.Function]:
    return {function.name: function for function in build.functions(HERE)}


def names(function: build.Function) -> set[str]:
    return {member.name for member in function.members}


# -- what is in them ---------------------------------------------------------------------------------------------------


def test_every_handler_becomes_a_function(built: dict[str, build.Function]) -> None:
    handlers = {path.stem for path in (places.ROOT / "lambdas").glob("*.py") if path.stem != "__init__"}
    assert set(built) == handlers


def test_files_that_functions_share_are_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tree = build._Tree(places.ROOT)
    assert tree.sources("hippodrome.functions.web") is tree.sources("hippodrome.functions.web")
    read, text = [], packages.Wheel._text

    def reading(self: packages.Wheel, name: str) -> str:
        read.append((self.path, name))
        return text(self, name)

    monkeypatch.setattr(packages.Wheel, "_text", reading)
    build.functions(HERE)
    assert any(name == "METADATA" for _, name in read)
    assert len(read) == len(set(read))


def test_each_zip_carries_only_what_its_function_imports(built: dict[str, build.Function]) -> None:
    assert "hippodrome/web/frame.html" in names(built["next_step"])
    assert "hippodrome/functions/web.py" in names(built["next_step"])
    assert not any(name.startswith("hippodrome/web/") for name in names(built["sweep"]))
    assert not any(name.startswith("jinja2/") for name in names(built["start_server"]))
    assert "jinja2" in built["next_step"].distributions
    assert "cryptography" in built["renew_certificate"].distributions
    assert "cryptography" not in built["next_step"].distributions
    assert {
        "hippodrome/protocol/__init__.py",
        "hippodrome/protocol/trial.py",
        "hippodrome/protocol/values.py",
    } <= names(built["update_project_master_list"])
    assert not {"hippodrome/protocol/trial.py", "hippodrome/protocol/values.py"} & names(built["next_step"])
    for name, function in built.items():
        others = {one for one in names(function) if one.startswith("lambdas/")}
        assert {Path(one).stem for one in others} == {"__init__", name}


def test_zips_hold_only_what_is_needed_to_run(built: dict[str, build.Function]) -> None:
    for function in built.values():
        for name in names(function):
            assert name.split("/")[0] not in RUNTIME, name
            assert not name.endswith((".pyi", ".pyc", ".c", ".h")), name
            assert ".dist-info" not in name
            assert "tests" not in name.split("/"), name
            assert not name.startswith("/")
            assert ".." not in name


def test_pruning_leaves_out_most_of_powertools(built: dict[str, build.Function]) -> None:
    found = {name for name in names(built["sweep"]) if name.startswith("aws_lambda_powertools/")}
    assert "aws_lambda_powertools/logging/logger.py" in found
    assert not any(name.startswith("aws_lambda_powertools/event_handler/") for name in found)


def test_compiled_code_is_for_lambda() -> None:
    seen = 0
    for function in build.functions(LAMBDA):
        for member in function.members:
            if member.name.endswith(".so"):
                body = member.read()
                assert body[:4] == b"\x7fELF"
                assert body[18] == 0xB7, f"{member.name} is not for aarch64"
                assert "cpython-313-" in member.name or "abi3" in member.name or ".cpython-" not in member.name
                seen += 1
    assert seen


def test_every_module_that_reads_files_beside_it_is_known(built: dict[str, build.Function]) -> None:
    """A new `Path(__file__)` in what a function carries needs an entry in `build.DATA`."""
    carried = {name for function in built.values() for name in names(function)}
    readers = {
        name.removesuffix(".py").replace("/", ".")
        for name in carried
        if name.endswith(".py") and name.split("/")[0] in build.OURS
        if "__file__" in (places.ROOT / name).read_text()
    }
    assert readers == set(build.DATA)


# -- that they run -----------------------------------------------------------------------------------------------------

PROBE = """
import importlib, json, sys
sys.path[:0] = sys.argv[1:3]
sys.modules["unused"] = None
function, wanted = sys.argv[3], json.loads(sys.stdin.read())
assert callable(importlib.import_module("lambdas." + function).handler)
for name in wanted:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        parent, _, last = name.rpartition(".")
        getattr(importlib.import_module(parent), last)
from hippodrome.control.log import logger
logger.info("it logs")
from aws_lambda_powertools import Metrics
metrics = Metrics(namespace="probe", service="probe")
metrics.add_metric(name="probes", unit="Count", value=1)
metrics.flush_metrics()
if function == "next_step":
    from hippodrome.control.participants import frame
    assert len(frame.style()) > 100
outside = [m.__file__ for m in sys.modules.values() if getattr(m, "__file__", None) and "site-packages" in m.__file__]
assert not outside, outside
print("ran")
"""


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the packages of Lambda's runtime, and nothing else."""
    folder = tmp_path_factory.mktemp("runtime")
    for name in RUNTIME:
        spec = importlib.util.find_spec(name)
        assert spec
        assert spec.origin
        origin = Path(spec.origin)
        if origin.name == "__init__.py":
            shutil.copytree(origin.parent, folder / name, ignore=_models)
        else:
            shutil.copy(origin, folder / origin.name)
    return folder


def _models(folder: str, found: list[str]) -> set[str]:
    return {"data"} & set(found) if Path(folder).name in {"botocore", "boto3"} else set()


@pytest.mark.explores
def test_each_zip_runs_with_nothing_but_the_runtime(
    for_here: dict[str, build.Function], runtime: Path, tmp_path: Path
) -> None:
    tree = build._Tree(places.ROOT)
    for name, function in sample(for_here.items(), 8):
        place = tmp_path / name
        zipfile.ZipFile(io.BytesIO(function.pack())).extractall(place)
        closure = build._closure([f"lambdas.{name}"], tree.sources, build.OURS)
        wanted = sorted(closure.inside | {one for one in closure.outside if one.partition(".")[0] != "__future__"})
        probe = subprocess.run(
            [sys.executable, "-I", "-S", "-B", "-c", PROBE, str(place), str(runtime), name],
            input=json.dumps(wanted),
            check=False,
            capture_output=True,
            text=True,
            env={"PATH": os.environ["PATH"], "POWERTOOLS_SERVICE_NAME": "probe"},
            cwd=tmp_path,
        )
        assert probe.returncode == 0, f"{name}: {probe.stderr[-2000:]}"
        assert probe.stdout.endswith("ran\n")
        assert '"probes"' in probe.stdout
        assert "it logs" in probe.stdout


# -- that they come out the same ---------------------------------------------------------------------------------------


def copy_of_project(folder: Path) -> Path:
    for part in ("lambdas", "hippodrome"):
        shutil.copytree(places.ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.mark.explores
def test_the_same_input_gives_the_same_bytes(
    built: dict[str, build.Function], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    target = request.node.callspec.params["built"]
    copy = copy_of_project(tmp_path / "elsewhere")
    for path in copy.rglob("*.py"):
        os.utime(path, (1, 1))
        path.chmod(0o600)
    before = Path.cwd()
    os.chdir(tmp_path)
    try:
        again = {function.name: function for function in build.functions(target, copy)}
    finally:
        os.chdir(before)
    assert {name: again[name].key for name in built} == {name: function.key for name, function in built.items()}
    for name, function in sample(built.items(), 8):
        packed = again[name].pack()
        bytecode._made.clear()  # then it is compiled again
        assert hashlib.sha256(packed).digest() == hashlib.sha256(function.pack()).digest()


def test_a_changed_file_changes_only_the_zips_that_import_it(tmp_path: Path) -> None:
    copy = copy_of_project(tmp_path)
    before = {function.name: function.key for function in build.functions(LAMBDA, copy)}
    with (copy / "hippodrome" / "control" / "servers" / "sweep.py").open("a") as file:
        file.write("\n# changed\n")
    after = {function.name: function.key for function in build.functions(LAMBDA, copy)}
    assert {name for name in before if before[name] != after[name]} == {"sweep"}


def test_line_ends_do_not_change_the_zip(tmp_path: Path) -> None:
    copy = copy_of_project(tmp_path)
    before = {function.name: function.key for function in build.functions(LAMBDA, copy)}
    for path in copy.rglob("*.py"):
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert {function.name: function.key for function in build.functions(LAMBDA, copy)} == before


def test_the_zip_holds_no_dates_and_plain_permissions(for_here: dict[str, build.Function]) -> None:
    entries = zipfile.ZipFile(io.BytesIO(for_here["next_step"].pack())).infolist()
    assert {entry.date_time for entry in entries} == {(1980, 1, 1, 0, 0, 0)}
    assert {entry.external_attr >> 16 for entry in entries} == {0o100644}
    assert [entry.filename for entry in entries] == sorted(entry.filename for entry in entries)


# -- imports -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "package", "expected"),
    [
        ("import a.b as c", False, {"a.b"}),
        ("from a import b, c", False, {"a", "a.b", "a.c"}),
        ("from . import b", False, {"p.q", "p.q.b"}),
        ("from . import b", True, {"p.q.m", "p.q.m.b"}),
        ("from ..x import y", False, {"p.x", "p.x.y"}),
        ("def f():\n    import late\n    class C:\n        import later", False, {"late", "later"}),
        ("if TYPE_CHECKING:\n    import a\nelse:\n    import b", False, {"b"}),
        ("import typing\nif typing.TYPE_CHECKING:\n    import a", False, {"typing"}),
        ("try:\n    import a\nexcept ImportError:\n    import b", False, {"a", "b"}),
        ("from a import *", False, {"a"}),
    ],
)
def test_imports_are_found(text: str, package: bool, expected: set[str]) -> None:
    assert build.imported(build.SourceModule(text, package), "p.q.m") == expected


def test_a_module_without_a_package_is_reported_in_a_sentence(tmp_path: Path) -> None:
    copy = copy_of_project(tmp_path)
    with (copy / "lambdas" / "sweep.py").open("a") as file:
        file.write("\nimport no_such_module_at_all\n")
    with pytest.raises(Problem, match="no_such_module_at_all"):
        build.functions(LAMBDA, copy)


def test_a_syntax_error_is_reported_in_a_sentence(tmp_path: Path) -> None:
    copy = copy_of_project(tmp_path)
    (copy / "lambdas" / "sweep.py").write_text("def (:")
    with pytest.raises(Problem, match="is not Python: line 1"):
        build.functions(LAMBDA, copy)


# -- pins and wheels ---------------------------------------------------------------------------------------------------


def test_pins_agree_with_the_requirements() -> None:
    pins = packages.read_pins()
    requirements = places.ROOT / "requirements"
    direct = packages.read_pins(requirements / "lambdas.txt") | {
        name: pin for name, pin in packages.read_pins(requirements / "deploy.txt").items() if name in packages.ALSO
    }
    for name, pin in direct.items():
        assert pins[name].version == pin.version, f"{name}: run python -m hippodrome.deployment.code.packages"
    assert all(len(pin.sha256) == 64 for pin in pins.values())


def test_the_pinned_versions_are_those_that_tests_run_with() -> None:
    """The installed versions, with which the tests run, are those that go into the zips."""
    import importlib.metadata

    for name, pin in packages.read_pins().items():
        assert importlib.metadata.version(name) == pin.version


def make_wheel(folder: Path, files: dict[str, bytes], name: str = "thing", spoil: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}-1.0-py3-none-any.whl"
    info = f"{name}-1.0.dist-info"
    files = {
        **files,
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n".encode(),
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    lines = [
        f"{key},sha256={base64.urlsafe_b64encode(hashlib.sha256(body).digest()).rstrip(b'=').decode()},{len(body)}"
        for key, body in files.items()
    ]
    with zipfile.ZipFile(path, "w") as archive:
        for key, body in files.items():
            archive.writestr(key, body + b"#" if key == spoil else body)
        archive.writestr(f"{info}/RECORD", "\n".join([*lines, f"{info}/RECORD,,\n"]))
    return path


def test_a_wheel_is_compared_with_its_record(tmp_path: Path) -> None:
    packages.Wheel(make_wheel(tmp_path / "good", {"thing.py": b"x = 1\n"})).check()
    with pytest.raises(Problem, match=r"thing\.py is not what its RECORD says"):
        packages.Wheel(make_wheel(tmp_path / "bad", {"thing.py": b"x = 1\n"}, spoil="thing.py")).check()
    (tmp_path / "torn-1.0-py3-none-any.whl").write_bytes(b"PK half")
    with pytest.raises(Problem, match="not a sound wheel"):
        packages.Wheel(tmp_path / "torn-1.0-py3-none-any.whl").check()


def test_the_zip_takes_only_the_needed_files_of_a_wheel(tmp_path: Path) -> None:
    wheel = packages.Wheel(
        make_wheel(
            tmp_path,
            {
                "thing/__init__.py": b"",
                "thing/tests/test_thing.py": b"",
                "thing/latest/new.py": b"",
                "thing/fast.c": b"",
                "thing/__init__.pyi": b"",
                "thing-1.0.data/scripts/thing": b"",
                "thing-1.0.data/purelib/more.py": b"",
                "../escape.py": b"",
                "/absolute.py": b"",
                "thing-1.0.data/purelib/../../escape.py": b"",
                "thing-1.0.data/purelib//absolute.py": b"",
            },
        )
    )
    assert set(wheel.members) == {"thing/__init__.py", "thing/latest/new.py", "more.py"}
    assert wheel.modules == {"thing", "more"}


class Interrupted(WheelCache):
    """pip brings one wheel and is interrupted."""

    def _pip(self, pins: list[Pin], folder: Path) -> None:
        make_wheel(folder, {"thing.py": b""})
        raise KeyboardInterrupt


class Brings(WheelCache):
    spoil = ""
    asked = 0

    def _pip(self, pins: list[Pin], folder: Path) -> None:
        self.asked += 1
        make_wheel(folder, {"thing.py": b""}, spoil=self.spoil)


def test_an_interrupted_download_leaves_nothing_behind(tmp_path: Path) -> None:
    pins = {"thing": Pin("thing", "1.0")}
    with pytest.raises(KeyboardInterrupt):
        Interrupted(LAMBDA, pins, tmp_path).wheels(pins)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert Brings(LAMBDA, pins, tmp_path).wheels(pins)["thing"].modules == {"thing"}


def test_wheels_are_cached(tmp_path: Path) -> None:
    pins = {"thing": Pin("thing", "1.0")}
    first, second = Brings(LAMBDA, pins, tmp_path), Brings(LAMBDA, pins, tmp_path)
    first.wheels(pins)
    second.wheels(pins)
    assert (first.asked, second.asked) == (1, 0)


def test_a_wheel_with_another_hash_is_refused(tmp_path: Path) -> None:
    pins = {"thing": Pin("thing", "1.0", "0" * 64)}
    with pytest.raises(Problem, match="is not the file that"):
        Brings(LAMBDA, pins, tmp_path).wheels(pins)
    assert not list(tmp_path.rglob("*.whl"))


def test_a_damaged_wheel_is_refused(tmp_path: Path) -> None:
    pins = {"thing": Pin("thing", "1.0")}
    wheels = Brings(LAMBDA, pins, tmp_path)
    wheels.spoil = "thing.py"
    with pytest.raises(Problem, match="is damaged"):
        wheels.wheels(pins)
    assert not list(tmp_path.rglob("*.whl"))


def test_a_failure_of_pip_is_reported_in_a_sentence(tmp_path: Path) -> None:
    pins = {"hippodrome-no-such-package": Pin("hippodrome-no-such-package", "1.0")}
    with pytest.raises(Problem, match="could not be downloaded") as caught:
        WheelCache(LAMBDA, pins, tmp_path).wheels(pins)
    assert any("hippodrome-no-such-package" in line for line in caught.value.details)


def test_an_unpinned_package_is_reported_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(Problem, match="does not pin"):
        WheelCache(LAMBDA, {}, tmp_path).wheels(["thing"])


def test_the_cache_is_in_the_systems_folder_for_caches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    assert packages.cache_folder() == tmp_path / "hippodrome"
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert packages.cache_folder() == tmp_path / "local" / "hippodrome"


def test_the_target_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HIPPODROME_TARGET", raising=False)
    assert Target.from_env() == Target("3.13", "aarch64")
    monkeypatch.setenv("HIPPODROME_TARGET", "here")
    assert Target.from_env() == Target.here()
    monkeypatch.setenv("HIPPODROME_TARGET", "mars")
    with pytest.raises(Problem):
        Target.from_env()


def test_zips_hold_bytecode_that_python_takes_without_looking_at_the_source(
    for_here: dict[str, build.Function], tmp_path: Path
) -> None:
    zipfile.ZipFile(io.BytesIO(for_here["sweep"].pack())).extractall(tmp_path)
    (tmp_path / "lambdas" / "sweep.py").write_text("raise SystemExit('the source was read')")
    code = "import sys; sys.path.insert(0, sys.argv[1]); import lambdas.sweep as m; print(m.__cached__)"
    done = subprocess.run([sys.executable, "-B", "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith(".pyc")


def test_without_the_targets_python_there_is_no_bytecode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bytecode.shutil, "which", lambda name: None)
    assert bytecode.compiler("3.99") is None


def test_a_module_that_does_not_compile_is_left_out() -> None:
    made = bytecode.compiled({"good.py": b"x = 1\n", "bad.py": b"def (:\n"}, sys.executable)
    assert [name.rpartition("/")[2].partition(".")[0] for name in made] == ["good"]


def test_a_file_of_several_functions_is_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bytecode, "_made", {})
    compiled, given = bytecode._compile, []
    monkeypatch.setattr(bytecode, "_compile", lambda sources, *how: given.append({*sources}) or compiled(sources, *how))
    shared, bad = {"p/__init__.py": b"", "p/q.py": b"x = 1\n"}, {"p/bad.py": b"def (:\n"}
    first = bytecode.compiled({**shared, **bad, "one.py": b"y = 1\n"}, sys.executable)
    second = bytecode.compiled({**shared, **bad, "one.py": b"y = 2\n"}, sys.executable)
    assert given == [{*shared, *bad, "one.py"}, {"one.py"}]
    assert set(first) == set(second)
    assert {path for path in first if first[path] != second[path]} == {path for path in first if "one" in path}
    assert len(first) == 3
