"""up: its steps and their order, for administrators and researchers, and with each state of the certificate."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from botocore.exceptions import ClientError

from hippodrome import cli
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.certificates.rules import PRODUCTION, STAGING, Decision, Verdict
from hippodrome.deployment.aws.account import Installation
from hippodrome.deployment.lifecycle import deploy
from hippodrome.deployment.lifecycle.apply import ApplyOutcome, ApplyRequest
from hippodrome.deployment.stack.certificate import Choice, Report

ROOT = Path(__file__).resolve().parents[3]
NOW = datetime(2026, 11, 21, tzinfo=UTC)
CONFIG = """project:
  id: study
  useAWS: {use}
  awsSetup: {{cpu: 1, memory: 2}}
  steps: {{1: hello, finalStep: bye}}
"""


class FakeStored:
    """The part of `hippodrome.control.certificates.rules.StoredCertificate` that `up` reads."""

    def __init__(self, directory: str, days: int = 60) -> None:
        self.directory = directory
        self.not_after = NOW + timedelta(days=days)

    def days_left(self, now: datetime) -> int:
        return (self.not_after - now).days


def report(directory: str, due: Verdict) -> Report:
    stored: Any = FakeStored(directory) if directory or due is Verdict.FOREIGN else None
    return Report("example.org", directory, Decision(due, "because"), stored, NOW)


class FakeAccount:
    """The part of an account that `up` itself reads."""

    id, region = "123456789012", "ca-central-1"

    @property
    def identity(self) -> dict[str, str]:
        return {"Account": self.id, "Arn": f"arn:aws:sts::{self.id}:assumed-role/admin/me"}


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The calls that `up` makes to its parts, in order. The parts are replaced here, and have tests of their own."""
    done: list[str] = []
    installation = Installation("hippodrome", "ca-central-1", "CREATE_COMPLETE", {})

    def obtain(account: Any, installation: Any, choice: Choice, *, tell: Any) -> Report:
        names = {PRODUCTION: "production", STAGING: "staging", "": "usual"}
        done.append(f"certificate {names[choice.directory]}")
        return report(choice.directory or "own", Verdict.ORDER)

    def apply(account: Any, stack: str, settings: Any, wish: ApplyRequest) -> ApplyOutcome:
        assert not wish.wrong
        done.append(f"apply {settings.domain}")
        return ApplyOutcome(True, {"Site": "https://study.example.org", "RootDomain": "example.org"})

    def register(folder: Path, **options: Any) -> int:
        done.append(f"register {folder.name}" + (f" on {options['base']}" if options["base"] else ""))
        return Exit.DONE

    monkeypatch.setattr(deploy, "open_account", lambda profile, region: FakeAccount())
    monkeypatch.setattr(deploy, "describe_stack", lambda account, stack: {"StackStatus": "CREATE_COMPLETE"})
    monkeypatch.setattr(deploy, "find_installation", lambda account, stack: installation)
    monkeypatch.setattr(deploy, "may_apply", lambda account, stack: True)
    monkeypatch.setattr(deploy.applying, "apply", apply)
    monkeypatch.setattr(
        deploy.certificate_transfer, "take_over", lambda account, installation: done.append("take over")
    )
    monkeypatch.setattr(deploy.certificate, "inspect", lambda account, installation: report("", Verdict.ORDER))
    monkeypatch.setattr(deploy.certificate, "obtain", obtain)
    monkeypatch.setattr(deploy.register, "command", register)
    return done


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "project" / "steps").mkdir(parents=True)
    (tmp_path / "project" / "config.yml").write_text(CONFIG.format(use="true"))
    for page in ("hello", "bye"):
        (tmp_path / "project" / "steps" / f"{page}.html").write_text("<p>Hello</p>")
    return tmp_path / "project"


def test_the_first_run_does_all_steps_in_order(calls: list[str], folder: Path) -> None:
    assert cli.main(["deploy", str(folder), "--domain", "example.org"]) == Exit.DONE
    assert calls == [
        "apply example.org",
        "take over",
        "certificate staging",
        "certificate production",
        "register project",
    ]


def test_deploy_says_which_certificate_it_looks_at(
    calls: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["deploy", str(folder), "--domain", "example.org"]) == Exit.DONE
    looking = [line for line in capsys.readouterr().err.splitlines() if line.startswith("Looking at")]
    assert looking == ["Looking at the test certificate …", "Looking at the real certificate …"]


@pytest.mark.parametrize(
    ("directory", "due", "expected"),
    [
        (PRODUCTION, Verdict.FRESH, ["certificate production"]),
        (STAGING, Verdict.FRESH, ["certificate production"]),
        ("https://ca.example/dir", Verdict.FRESH, []),
        ("https://ca.example/dir", Verdict.ORDER, ["certificate usual"]),
        ("", Verdict.FOREIGN, []),
    ],
)
def test_a_certificate_is_ordered_if_the_present_one_is_due_or_missing(
    calls: list[str], monkeypatch: pytest.MonkeyPatch, directory: str, due: Verdict, expected: list[str]
) -> None:
    monkeypatch.setattr(deploy.certificate, "inspect", lambda account, installation: report(directory, due))
    deploy.certify(None, "hippodrome")  # type: ignore[arg-type]
    assert calls == ["take over", *expected]


def test_after_a_failed_test_certificate_no_real_one_is_ordered(
    calls: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def obtain(account: Any, installation: Any, choice: Choice, *, tell: Any) -> Report:
        calls.append(choice.directory)
        raise Problem("The proof was not seen.", "Look at DNS.")

    monkeypatch.setattr(deploy.certificate, "obtain", obtain)
    (folder / "config.yml").write_text(CONFIG.format(use="false"))
    assert cli.main(["deploy", str(folder)]) == Exit.FAILED
    assert calls == ["apply None", "take over", STAGING]
    said = capsys.readouterr().err
    assert "The installation stands, but has no certificate. The proof was not seen." in said
    assert "Look at DNS." in said


def test_a_study_without_a_game_needs_no_certificate(
    calls: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def obtain(*_: Any, **__: Any) -> Report:
        raise Problem("The proof was not seen.")

    monkeypatch.setattr(deploy.certificate, "obtain", obtain)
    assert cli.main(["deploy", str(folder)]) == Exit.DONE
    assert calls == ["apply None", "take over", "register project"]


def test_no_certificate_is_ordered_on_request(calls: list[str], folder: Path) -> None:
    assert cli.main(["deploy", str(folder), "--no-certificate"]) == Exit.DONE
    assert calls == ["apply None", "register project"]


def test_for_a_researcher_only_the_study_is_registered(
    calls: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(deploy, "may_apply", lambda account, stack: False)
    assert cli.main(["deploy", str(folder)]) == Exit.DONE
    assert calls == ["register project"]
    assert "researcher" in capsys.readouterr().err


def test_mistakes_in_the_study_stop_it_before_anything_is_made(calls: list[str], folder: Path) -> None:
    (folder / "config.yml").write_text("project: {id: study, useAWS: true, steps: {x: 1}}")
    assert cli.main(["deploy", str(folder)]) == Exit.FAILED
    assert calls == []


def test_mistakes_and_missing_credentials_are_reported_together(
    calls: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def nobody(*_: Any) -> None:
        raise Problem("There are no AWS credentials on this machine.", "Log in.")

    monkeypatch.setattr(deploy, "open_account", nobody)
    (folder / "config.yml").write_text("project: {id: study, useAWS: true, steps: {x: 1}}")
    assert cli.main(["deploy", str(folder)]) == Exit.FAILED
    said = capsys.readouterr().err
    assert "✗ study: The project cannot be registered: there are" in said
    assert "✗ There are no AWS credentials on this machine." in said
    assert calls == []


@pytest.mark.parametrize(
    ("config", "said"), [(None, "has no config.yml"), (CONFIG.format(use="false"), "(useAWS: false); to put it on AWS")]
)
def test_a_folder_without_a_study_for_aws_gets_only_the_installation(
    calls: list[str], folder: Path, capsys: pytest.CaptureFixture[str], config: str | None, said: str
) -> None:
    (folder / "config.yml").unlink()
    if config:
        (folder / "config.yml").write_text(config)
    assert cli.main(["deploy", str(folder)]) == Exit.DONE
    assert said in capsys.readouterr().err
    assert calls[0] == "apply None"
    assert not any(line.startswith("register") for line in calls)


def test_a_study_without_use_aws_is_registered(calls: list[str], folder: Path) -> None:
    (folder / "config.yml").write_text(CONFIG.replace("  useAWS: {use}\n", "").format())
    assert cli.main(["deploy", str(folder)]) == Exit.DONE
    assert calls[-1] == "register project"


def test_the_example_study_is_registered_unchanged(calls: list[str]) -> None:
    assert cli.main(["deploy", str(ROOT), "--domain", "example.org", "--email", "me@example.org"]) == Exit.DONE
    assert calls[0] == "apply example.org"
    assert calls[-1] == f"register {ROOT.name}"


def test_a_study_without_aws_setup_is_refused(
    calls: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "config.yml").write_text(CONFIG.replace("  useAWS: {use}\n", "").replace("awsSetup", "#").format())
    assert cli.main(["deploy", str(folder)]) == Exit.FAILED
    assert calls == []
    assert "project.awsSetup: gives no cpu and no memory" in capsys.readouterr().err


def test_the_base_of_the_image_may_come_from_a_mirror(
    calls: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HIPPODROME_BASE_IMAGE", "mirror.example.org/python:3.13")
    assert cli.main(["deploy", str(folder)]) == Exit.DONE
    assert calls[-1] == "register project on mirror.example.org/python:3.13"


class Cloud:
    def __init__(self, standing: bool, error: str = "") -> None:
        self.existing, self.error = standing, error

    def client(self, service: str) -> Any:
        return self

    def describe_stacks(self, StackName: str) -> Any:
        if self.existing:
            tag = {"Key": "hippodrome:stack", "Value": StackName}
            return {"Stacks": [{"StackName": StackName, "StackStatus": "CREATE_COMPLETE", "Tags": [tag]}]}
        raise ClientError({"Error": {"Code": "ValidationError", "Message": "it does not exist"}}, "DescribeStacks")

    def get_template(self, StackName: str) -> Any:
        if self.error:
            raise ClientError({"Error": {"Code": self.error, "Message": ""}}, "GetTemplate")


def test_credentials_that_may_read_the_template_may_apply() -> None:
    assert deploy.may_apply(Cloud(False, "AccessDenied"), "hippodrome")  # type: ignore[arg-type]
    assert deploy.may_apply(Cloud(True), "hippodrome")  # type: ignore[arg-type]
    assert not deploy.may_apply(Cloud(True, "AccessDenied"), "hippodrome")  # type: ignore[arg-type]
    with pytest.raises(ClientError):
        deploy.may_apply(Cloud(True, "Throttling"), "hippodrome")  # type: ignore[arg-type]
