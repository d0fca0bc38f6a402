"""Reads a project folder, compares it with an installation, and makes the registration from both."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from hippodrome.console.problem import Problem
from hippodrome.control.config import Config, ConfigErrors, Diagnostic, agent_imports, layout, read_project
from hippodrome.control.config.folder import read_source
from hippodrome.control.model.project import MIN_RUNTIME_MARGIN, Project
from hippodrome.protocol.section_keys import document
from hippodrome.protocol.values import KeyPath

if TYPE_CHECKING:
    from hippodrome.deployment.aws.account import Installation


@dataclass(frozen=True)
class ProjectFolder:
    """A project folder that fits the installation. `registration` is what `update_project_master_list` takes."""

    folder: Path
    config: Config
    registration: dict[str, Any]
    remarks: tuple[str, ...] = ()  # on values that have no effect in this installation

    @property
    def id(self) -> str:
        return self.config.project.id

    @property
    def plays(self) -> bool:
        """Whether there is a game, so that servers are needed."""
        return bool(self.config.game_steps)


def read(folder: Path, installation: Installation | None = None) -> ProjectFolder:
    """Read the project in `folder`. The registration gets the installation's values.

    Raises `Problem` with every mistake in config.yml and the step files; if there is none, with what is missing for AWS
    or wrong in agent.py; if there is none of that, with every value that contradicts the installation.
    """
    try:
        config = read_project(folder)
    except ConfigErrors as errors:
        raise _mistakes([str(mistake) for mistake in errors.diagnostics]) from None
    wrong = [*_with_lines(folder, [*_no_id(folder), *_lacking_for_aws(config)]), *_agent(folder, config)]
    if not wrong and installation is not None:
        wrong = _with_lines(folder, [*_contradictions(config, installation)])
    if wrong:
        raise _mistakes(wrong)
    registration = {**config.registration(), "useAWS": True}  # whatever config.yml says: a deployed study uses AWS
    remarks: list[str] = []
    if installation is not None:
        registration["awsSetup"] = {**registration["awsSetup"], **_aws_setup_of(installation)}
        registration["maxRuntime"] = min(config.project.max_runtime, int(installation["MaxRuntime"]))
        remarks = _with_lines(folder, [*_no_effect(config, installation)], remark=True)
    return ProjectFolder(folder, config, registration, tuple(remarks))


def id_in(folder: Path) -> str | None:
    """Return the project's id, even if config.yml has mistakes elsewhere; None if it cannot be read."""
    project_id = _value_of(folder, "id")
    return None if project_id is None else str(getattr(project_id, "text", project_id))


def uses_aws(folder: Path) -> bool:
    """Whether config.yml says `useAWS: true`."""
    use_aws = _value_of(folder, "useAWS")
    return getattr(use_aws, "value", use_aws) is True


def may_use_aws(folder: Path) -> bool:
    """Whether config.yml does not say if the study is on AWS: it has awsSetup, but no useAWS."""
    return _value_of(folder, "useAWS") is None and _value_of(folder, "awsSetup") is not None


def _value_of(folder: Path, key: str) -> Any:
    """Return the value of this key in the section `project` of config.yml; None if the key is missing."""
    try:
        return read_source(folder).adapted.at(("project", key))
    except ConfigErrors:
        return None


def registration_of(project: Project, live: bool) -> dict[str, Any]:
    """Return the registration with which `update_project_master_list` sets `live` of a registered project."""
    fields = msgspec.to_builtins(project)
    ours = {"salt", "version"}
    fields_kept = {key: value for key, value in fields.items() if value is not None and key not in ours}
    if project.aws_setup is not None:  # a record leaves out values that are the default
        fields_kept["awsSetup"] = {**fields["awsSetup"], "cpu": project.size.cpu, "memory": project.size.memory}
    return {**fields_kept, "live": live}


def _aws_setup_of(installation: Installation) -> dict[str, str]:
    """Return the values of `awsSetup` that the installation decides."""
    return {
        "bucket": installation["Bucket"],
        "region": installation.region,
        "rootDomain": installation["RootDomain"],
    }


def _no_id(folder: Path) -> Iterator[tuple[KeyPath, str]]:
    """Yield a mistake if the id is empty. On one machine an empty id stands for the folder's name."""
    section: Any = read_source(folder).parsed.values.get("project")
    if isinstance(section, dict) and section.get("id") in (None, ""):
        yield (
            ("project", "id"),
            "is empty; on AWS give the study an id of its own, since another folder may have the same name",
        )


def _lacking_for_aws(config: Config) -> Iterator[tuple[KeyPath, str]]:
    """Yield the missing keys that only AWS needs. With `useAWS: true` the servers' size has been checked already."""
    setup = config.project.aws_setup
    missing = [key for key in ("cpu", "memory") if not setup.given(key)]
    if config.project.keeps_off_aws:
        yield ("project", "useAWS"), "is false, which keeps this study on one machine; write true"
    if missing:
        yield (
            ("project", "awsSetup"),
            f"gives no {' and no '.join(missing)}; on AWS each participant gets a server: write how large, such as "
            "awsSetup: {cpu: 1, memory: 2}",
        )


def _contradictions(config: Config, installation: Installation) -> Iterator[tuple[KeyPath, str]]:
    """Yield the project's values that this installation does not allow."""
    project = config.project
    given = document(project.aws_setup)
    for key, here in _aws_setup_of(installation).items():
        if key != "bucket" and given[key] is not None and given[key] != here:
            yield (
                ("project", "awsSetup", key),
                f"is {given[key]}, but the installation {installation.stack} has {here}; leave the key out, or name "
                "another installation with --stack, --region and --profile",
            )
    if project.subdomain == "userId" and installation.parameters.get("ServerNames", "userId") != "userId":
        yield ("project", "subdomain"), "is userId, which this installation does not allow (ServerNames); use hash"
    if project.plain_clients and installation.parameters.get("PlainClients", "refused") != "allowed":
        yield ("project", "plainClients"), "is true, which this installation does not allow (PlainClients); use false"
    most = int(installation["MaxRuntime"])
    needed = min(project.max_runtime, most) + MIN_RUNTIME_MARGIN
    if project.warm_servers and needed > most:
        yield (
            ("project", "warmServers"),
            f"is {project.warm_servers}: with an hour of waiting and maxRuntime, a server may need "
            f"{needed} minutes, and this installation allows {most}; take a shorter "
            "maxRuntime, or 0",
        )


def _no_effect(config: Config, installation: Installation) -> Iterator[tuple[KeyPath, str]]:
    """Yield the values that have no effect here: another bucket's name, and a maxRuntime that is too long."""
    most = int(installation["MaxRuntime"])
    if config.project.max_runtime > most:
        yield (
            ("project", "maxRuntime"),
            f"is {config.project.max_runtime} minutes; the installation {installation.stack} stops servers at {most}",
        )
    bucket = config.project.aws_setup.bucket
    if bucket not in (None, installation["Bucket"]):
        yield (
            ("project", "awsSetup", "bucket"),
            f"no effect: it is {bucket}, and the study's pages and data are in {installation['Bucket']}, the bucket of "
            f"the installation {installation.stack}",
        )


def _with_lines(folder: Path, key_paths: list[tuple[KeyPath, str]], remark: bool = False) -> list[str]:
    """Put before each text its line in config.yml."""
    source = read_source(folder) if key_paths else None
    return [str(source.diagnostic(path, text, remark=remark)) for path, text in key_paths] if source else []


def _agent(folder: Path, config: Config) -> Iterator[str]:
    """Yield a mistake if Python cannot parse agent.py, or if no server could start beside the files of its folder.

    `hippodrome check` runs it, too.
    """
    agent = layout.find(folder)
    if agent.agent is None or not config.game_steps:
        return
    label = agent.label(agent.agent)
    try:
        ast.parse(agent.agent.read_bytes())
    except SyntaxError as error:
        yield str(Diagnostic(label, error.lineno, "", f"Python cannot read this: {error.msg}"))
    except (ValueError, OSError) as error:
        yield str(Diagnostic(label, None, "", f"Python cannot read this: {error}"))
    yield from map(str, agent_imports.hiding_files(folder))


def _mistakes(wrong: list[str]) -> Problem:
    count = "there is a mistake" if len(wrong) == 1 else f"there are {len(wrong)} mistakes"
    return Problem(
        f"The project cannot be registered: {count} in it.",
        "docs/config.md explains every key; `hippodrome check` looks at the pages and at agent.py too.",
        wrong,
    )
