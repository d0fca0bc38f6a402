"""`hippodrome doctor`: each problem that would stop a study is a line, with its remedy."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shutil
import ssl
import urllib.error
from collections.abc import Callable, Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec
import pytest

from hippodrome.console.problem import Exit
from hippodrome.control.model.project import Project, step_key
from hippodrome.control.model.server import Reason
from hippodrome.control.servers.causes import Cause
from hippodrome.control.servers.sweep import Sweep
from hippodrome.control.storage.secret import SecretCache
from hippodrome.deployment.aws.account import Account, find_installation
from hippodrome.deployment.aws.hosted_zone import Delegation
from hippodrome.deployment.core.finding import Finding, Mark, examine
from hippodrome.deployment.operate.doctor import CHECKS, addresses, capacity, images, safety
from hippodrome.deployment.operate.doctor.check_context import CheckContext
from hippodrome.deployment.operate.doctor.rehearsal import LoneServer, rehearse
from hippodrome.deployment.stack.stack import Stack
from testing.moto_study import StudyOnMoto
from testing.studies import PAGES, study
from tests.certificate.pebble import make_ca
from tests.deployment.certificates import chain
from tests.deployment.installation import ROOT, Installed, process

TLS_ONLY = {
    "Effect": "Deny",
    "Principal": "*",
    "Action": "s3:*",
    "Condition": {"Bool": {"aws:SecureTransport": "false"}},
}
V2 = "application/vnd.docker.distribution.manifest.v2+json"


@pytest.fixture
def world(installed: Installed) -> Installed:
    """A healthy installation with one live project."""
    installed.register(project(installed))
    for file, source in PAGES.items():
        installed.put(step_key("maze", file), source.encode())
    installed.put("SSL/servers.example.org/fullchain.pem", chain("*.servers.example.org", days=60))
    for _ in range(20):
        quotas(installed)
        block_public_access(installed)
        installed.answer("s3:GetBucketPolicy", {"Policy": json.dumps({"Statement": [TLS_ONLY]})})
    sns = installed.client("sns")
    sns.subscribe(TopicArn=installed.alarm_topic, Protocol="email", Endpoint="admin@example.org")
    return installed


def quotas(world: Installed, spot: float = 100, on_demand: float = 100, functions: int = 1000) -> None:
    """Let AWS answer with these quotas. Gap: moto has none of them."""
    for value in (spot, on_demand):
        world.answer("service-quotas:GetServiceQuota", {"Quota": {"Value": value}})
    limit = {"ConcurrentExecutions": functions, "UnreservedConcurrentExecutions": functions}
    world.answer("lambda:GetAccountSettings", {"AccountLimit": limit})


def block_public_access(world: Installed, mode: str = "off") -> None:
    """Let AWS answer with this mode of VPC Block Public Access, and without exclusions. Gap: moto has neither call."""
    world.answer(
        "ec2:DescribeVpcBlockPublicAccessOptions", {"VpcBlockPublicAccessOptions": {"InternetGatewayBlockMode": mode}}
    )
    if mode != "off":
        world.answer("ec2:DescribeVpcBlockPublicAccessExclusions", {"VpcBlockPublicAccessExclusions": []})


def image(world: Installed, tag: str = "maze-0123456789ab") -> str:
    """Push an image (the same one for the same tag). Returns its uri@digest."""
    layer = {"size": 7_000_000, "digest": f"sha256:{hashlib.sha256(tag.encode()).hexdigest()}"}
    manifest = json.dumps({"schemaVersion": 2, "mediaType": V2, "config": layer, "layers": [layer]})
    ecr = world.client("ecr")
    with contextlib.suppress(ecr.exceptions.ImageAlreadyExistsException):
        ecr.put_image(repositoryName="hippodrome", imageManifest=manifest, imageTag=tag)
    (found,) = ecr.describe_images(repositoryName="hippodrome", imageIds=[{"imageTag": tag}])["imageDetails"]
    return f"{world.repository}@{found['imageDigest']}"


def definition(world: Installed, name: str = "hippodrome-maze", container: str = "trial", **changes: Any) -> str:
    given = {"name": container, "image": image(world), "essential": True, "memory": 2048, "stopTimeout": 120, **changes}
    answer = world.client("ecs").register_task_definition(
        family=name,
        networkMode="awsvpc",
        requiresCompatibilities=["FARGATE"],
        cpu="1024",
        memory="2048",
        containerDefinitions=[given],
    )
    return str(answer["taskDefinition"]["taskDefinitionArn"])


def project(world: Installed, **changes: Any) -> Project:
    task = changes.pop("task_definition", None) or definition(world)
    return msgspec.structs.replace(study(task_definition=task, server_port=443), **changes)


def context(account: Account, at_once: int = 20, **changes: Any) -> CheckContext:
    made = CheckContext(
        account, find_installation(account), at_once, datetime.now(UTC), delegation=lambda zone: Delegation(())
    )
    for name, value in changes.items():
        setattr(made, name, value)
    return made


def marks(findings: Iterable[Finding]) -> list[tuple[Mark, str]]:
    return [(one.mark, one.text) for one in findings]


def only(findings: Iterable[Finding]) -> Finding:
    (one,) = findings
    assert one.mark is Mark.GOOD or one.advice, one
    return one


def doctor(world: Installed, capsys: Any, *arguments: str) -> dict[str, tuple[str, str]]:
    ran = world.run(capsys, "doctor", "--only-aws", "--json", *(arguments or ["--all"]))
    found = ran.json
    assert (ran.code == Exit.DONE) is found["good"]
    return {one["check"]: (one["mark"], one["text"]) for one in found["checks"]}


# The whole


def test_doctor_finds_nothing_bad_in_a_healthy_installation(world: Installed, capsys: Any) -> None:
    ran = world.run(capsys, "doctor", "--all", "--only-aws")
    assert ran.code == Exit.DONE, ran.out
    assert "✗" not in ran.out
    for line in (
        "✓ credentials: ",
        "✓ region: us-east-1.",
        "✓ stack: hippodrome is in CREATE_COMPLETE.",
        "✓ hosted zone: example.org",
        "✓ Internet: The account does not block it for the servers' network.",
        "✓ certificate: *.servers.example.org: 60 days left.",
        "✓ Fargate quota, Spot: 100 vCPU: 100 servers of 1 vCPU at once; 20 are wanted.",
        "✓ Lambda quota: 1,000 executions",
        "✓ project maze: image of",
        "✓ bucket: hippodrome-123456789012: private, versioned, TLS only.",
        "✓ queues: No dead letters",
        "✓ alarms: 1 alarms, none fires.",
    ):
        assert line in ran.out, ran.out


def test_a_check_that_aws_refuses_says_why_and_the_others_go_on(world: Installed, account: Account) -> None:
    fresh(world)
    for action in ("s3:HeadBucket", "cloudwatch:DescribeAlarms", "service-quotas:GetServiceQuota"):
        world.fail(action, "AccessDenied", status=400)
    found = {one.check: one for one in examine(context(account), CHECKS)}
    assert found["alarms"].text.startswith("could not be checked: These credentials may not describe alarms")
    assert found["bucket"].mark is found["Fargate quotas"].mark is Mark.LOOK
    assert found["project maze"].mark is Mark.GOOD


def test_a_check_that_raises_has_a_line_too(account: Account, world: Installed) -> None:
    def broken(_: CheckContext) -> Iterable[Finding]:
        raise ZeroDivisionError("somebody's id")

    (line,) = examine(context(account), {"arithmetic": broken})
    assert (line.mark, line.check) == (Mark.LOOK, "arithmetic")


@pytest.mark.parametrize(
    ("status", "mark"),
    [
        ("ROLLBACK_COMPLETE", "bad"),
        ("CREATE_IN_PROGRESS", "bad"),
        ("UPDATE_ROLLBACK_FAILED", "look"),
        ("UPDATE_COMPLETE", "good"),
    ],
)
def test_the_state_of_the_stack_is_judged(world: Installed, capsys: Any, status: str, mark: str) -> None:
    world.stack_status(status)
    found = doctor(world, capsys)
    assert found["stack"][0] == mark
    assert status in found["stack"][1]
    assert ("bucket" in found) is (mark != "bad")


def test_a_failed_update_that_was_rolled_back_is_named(world: Installed, capsys: Any) -> None:
    world.stack_status("UPDATE_ROLLBACK_COMPLETE")
    mark, text = doctor(world, capsys)["stack"][:2]
    assert (mark, text) == ("look", "hippodrome works as before its last update, which failed.")


def test_doctor_names_missing_permissions(world: Installed, capsys: Any) -> None:
    world.fail("cloudformation:GetTemplate", "AccessDenied", status=403)
    world.fail("sns:ListSubscriptionsByTopic", "AuthorizationError", status=403)
    found = doctor(world, capsys)
    assert found["version"][:2] == ("look", "could not be checked: These credentials may not get template.")
    assert found["alarm e-mail"][1] == "could not be checked: These credentials may not list subscriptions by topic."


def test_without_a_stack_or_credentials_doctor_says_so(world: Installed, capsys: Any) -> None:
    found = doctor(world, capsys, "--stack", "nowhere")
    assert set(found) == {"credentials", "region", "stack"}
    world.fail("sts:GetCallerIdentity", "ExpiredToken", status=403)
    ran = world.run(capsys, "doctor", "--all")
    assert (ran.code, ran.out) == (Exit.FAILED, "")
    assert "credentials have expired" in ran.err


@pytest.mark.parametrize("code", ["OptInRequired", "SubscriptionRequiredException", "NotSignedUp"])
def test_commands_say_that_aws_has_not_activated_the_account_yet(world: Installed, capsys: Any, code: str) -> None:
    world.fail("cloudformation:DescribeStacks", code, status=403)
    ran = world.run(capsys, "status", "--all")
    assert ran.code == Exit.FAILED
    assert "✗ AWS has not activated this account yet." in ran.err
    assert "→ Finish the sign-up in AWS's console" in ran.err


def test_the_project_can_be_named_by_its_folder(world: Installed, capsys: Any, tmp_path: Path) -> None:
    for name in ("steps", "agent.py", "config.yml"):
        (shutil.copytree if name == "steps" else shutil.copy)(ROOT / name, tmp_path / name)
    ran = world.run(capsys, "doctor", "--only-aws", str(tmp_path))
    assert "No project named ms-pacman is registered" in ran.err
    assert "`hippodrome register STUDY` adds one" in ran.err
    world.register(project(world), project(world, id="ms-pacman", live=False))
    assert set(doctor(world, capsys, str(tmp_path))) >= {"project ms-pacman"}


# Addresses


def test_the_delegation_of_the_domain_is_checked(world: Installed, account: Account) -> None:
    elsewhere = Delegation(("ns1.elsewhere.net",), "example.org is delegated to other name servers: ns1.elsewhere.net.")
    line = only(addresses.zone(context(account, delegation=lambda _: elsewhere)))
    assert line.mark is Mark.BAD
    assert "awsdns" in line.advice
    unknown = Delegation((), "Whether example.org is delegated could not be asked: LifetimeTimeout.", False)
    assert only(addresses.zone(context(account, delegation=lambda _: unknown))).mark is Mark.LOOK


def test_a_missing_hosted_zone_is_reported(world: Installed, account: Account) -> None:
    world.client("route53").delete_hosted_zone(Id=world.env["HOSTED_ZONE_ID"])
    assert "no hosted zone" in only(addresses.zone(context(account))).text


def test_the_site_is_asked_for_its_page(world: Installed, account: Account) -> None:
    def refused(_: str) -> int:
        raise urllib.error.URLError("Name or service not known")

    asked: list[str] = []
    assert only(addresses.site(context(account, fetch=lambda url: asked.append(url) or 404))).mark is Mark.GOOD
    assert asked == ["https://study.example.org/next"]
    assert only(addresses.site(context(account, fetch=lambda _: 502))).mark is Mark.BAD
    assert "Name or service not known" in only(addresses.site(context(account, fetch=refused))).text


def authorities() -> set[str]:
    return {str(one["serialNumber"]) for one in addresses.authorities().get_ca_certs()}


def test_machines_without_certificate_authorities_use_those_of_mozilla(monkeypatch: Any, tmp_path: Path) -> None:
    """Python from python.org on macOS has no authorities. The machine's own authorities count as well."""
    (tmp_path / "none.pem").touch()
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "none.pem"))
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path / "none"))
    assert not ssl.create_default_context().get_ca_certs()
    mozillas = authorities()
    assert len(mozillas) > 50
    (tmp_path / "own.pem").write_text(make_ca(tmp_path)[0])
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "own.pem"))
    assert len(authorities() - mozillas) == 1


def test_the_certificate_of_the_site_must_be_issued(
    world: Installed, account: Account, monkeypatch: pytest.MonkeyPatch
) -> None:
    arn = world.client("acm").request_certificate(DomainName="study.example.org", ValidationMethod="DNS")[
        "CertificateArn"
    ]
    here = [{"ResourceType": "AWS::CertificateManager::Certificate", "PhysicalResourceId": arn}]
    monkeypatch.setattr(Stack, "resources", lambda _: here)
    one = context(account)
    world.answer(
        "acm:DescribeCertificate", {"Certificate": {"Status": "PENDING_VALIDATION", "DomainName": "study.example.org"}}
    )
    assert only(addresses.site_certificate(one)).mark is Mark.BAD
    world.answer("acm:DescribeCertificate", {"Certificate": {"Status": "ISSUED", "DomainName": "study.example.org"}})
    assert only(addresses.site_certificate(one)).mark is Mark.GOOD


@pytest.mark.parametrize(
    ("pem", "mark", "says"),
    [
        (b"", Mark.BAD, "is no certificate"),
        (b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n", Mark.BAD, "is no certificate"),
        (chain("*.servers.example.org", days=-2), Mark.BAD, "expired on"),
        (chain("*.servers.example.org", days=5), Mark.BAD, "5 days left"),
        (chain("*.servers.example.org", days=20), Mark.LOOK, "20 days left"),
        (chain("*.servers.example.org", days=50, issuer="(STAGING) Riddling Rhubarb R12"), Mark.BAD, "staging"),
        (chain("*.example.com", days=50), Mark.BAD, "not for *.servers.example.org"),
        (chain(days=50), Mark.BAD, "It is for no name"),
        (chain("*.servers.example.org", days=50), Mark.GOOD, "50 days left"),
        # Certificates that are renewed when a third of 45 days is left, or half of 160 hours.
        (chain("*.servers.example.org", days=20, lifetime=45), Mark.GOOD, "20 days left"),
        (chain("*.servers.example.org", days=12, lifetime=45), Mark.LOOK, "12 days left"),
        (chain("*.servers.example.org", days=3, lifetime=45), Mark.BAD, "3 days left"),
        (chain("*.servers.example.org", days=5, lifetime=6.6), Mark.GOOD, "5 days left"),
        (chain("*.servers.example.org", days=2, lifetime=6.6), Mark.LOOK, "2 days left"),
        (chain("*.servers.example.org", days=0.5, lifetime=6.6), Mark.BAD, "0 days left"),
    ],
)
def test_the_certificate_of_the_servers_is_checked(
    world: Installed, account: Account, pem: bytes, mark: Mark, says: str
) -> None:
    world.put("SSL/servers.example.org/fullchain.pem", pem)
    line = only(addresses.certificate(context(account)))
    assert (line.mark, says in line.text) == (mark, True), line


def test_a_missing_certificate_is_bad(world: Installed, account: Account) -> None:
    world.client("s3").delete_object(Bucket=world.env["BUCKET"], Key="SSL/servers.example.org/fullchain.pem")
    assert only(addresses.certificate(context(account))).mark is Mark.BAD


# Capacity


def fresh(installed: Installed) -> None:
    installed._answers.clear()


def test_an_account_that_closes_the_servers_network_to_the_internet_is_bad(world: Installed, account: Account) -> None:
    fresh(world)
    block_public_access(world, "block-bidirectional")
    found = only(addresses.internet(context(account)))
    assert (found.mark, "servers cannot load their image" in found.text) == (Mark.BAD, True)
    assert "aws ec2 modify-vpc-block-public-access-options" in found.advice


def test_quotas_that_are_too_small_come_with_the_command_to_raise_them(world: Installed, account: Account) -> None:
    fresh(world)
    quotas(world, spot=6, on_demand=6, functions=10)
    one = context(account, at_once=20)
    spot, on_demand = capacity.fargate(one)
    assert (spot.mark, on_demand.mark) == (Mark.LOOK, Mark.LOOK)  # a study of six participants is possible
    assert "6 vCPU: 6 servers of 1 vCPU at once, and 20 are wanted" in spot.text
    assert "--service-code fargate --quota-code L-36FBB829 --desired-value 20" in spot.advice
    executions = only(capacity.functions(one))
    assert (executions.mark, "10 executions at once" in executions.text) == (Mark.LOOK, True)
    assert "--service-code lambda --quota-code L-B99A9384" in executions.advice


@pytest.mark.parametrize(("free", "mark"), [(6, Mark.BAD), (7, Mark.LOOK), (14, Mark.LOOK), (15, Mark.GOOD)])
def test_pages_need_executions_beside_the_functions_behind_queues(
    world: Installed, account: Account, free: int, mark: Mark
) -> None:
    fresh(world)
    quotas(world, functions=free)
    assert only(capacity.functions(context(account, at_once=20))).mark is mark


def test_sessions_need_executions_for_each_participant_and_not_for_each_server(
    world: Installed, account: Account
) -> None:
    fresh(world)
    quotas(world, functions=20)  # ten of them for the functions behind queues
    alone = context(account, at_once=20, projects=[study()])
    assert only(capacity.functions(alone)).mark is Mark.GOOD
    fresh(world)
    quotas(world, functions=20)
    together = context(account, at_once=20, projects=[study(players=4)])
    found = only(capacity.functions(together))
    assert found.mark is Mark.LOOK
    assert "80 participants" in found.text


def test_unknown_quotas_are_remarks_or_the_defaults_of_aws(world: Installed, account: Account) -> None:
    fresh(world)
    for action in ("GetServiceQuota", "GetAWSDefaultServiceQuota"):
        world.fail(f"service-quotas:{action}", "NoSuchResourceException", times=2)
    assert [line.mark for line in capacity.fargate(context(account))] == [Mark.LOOK, Mark.LOOK]
    world.fail("service-quotas:GetServiceQuota", "NoSuchResourceException", times=2)
    world.answer("service-quotas:GetAWSDefaultServiceQuota", {"Quota": {"Value": 4000.0}}, times=2)
    assert [line.mark for line in capacity.fargate(context(account))] == [Mark.GOOD, Mark.GOOD]


def test_large_servers_need_a_larger_quota(world: Installed, account: Account) -> None:
    fresh(world)
    quotas(world, spot=30, on_demand=30)
    large = project(world)
    large = msgspec.structs.replace(large, aws_setup=msgspec.structs.replace(large.size, cpu=4, memory=8))
    spot, _ = capacity.fargate(context(account, at_once=10, wanted=large))
    assert (spot.mark, "7 servers of 4 vCPU" in spot.text) == (Mark.LOOK, True)


def test_warm_servers_count_against_the_quota(world: Installed, account: Account) -> None:
    fresh(world)
    quotas(world, spot=23, on_demand=24)
    world.register(project(world, warm_servers=4))
    spot, on_demand = capacity.fargate(context(account, at_once=20))
    assert (spot.mark, on_demand.mark) == (Mark.LOOK, Mark.GOOD)
    assert "23 vCPU: 19 servers of 1 vCPU at once beside 4 warm ones, and 20 are wanted" in spot.text
    assert "--desired-value 24" in spot.advice


def test_a_quota_that_warm_servers_use_up(world: Installed, account: Account) -> None:
    fresh(world)
    quotas(world, spot=3, on_demand=3)
    world.register(project(world, warm_servers=4))
    spot, on_demand = capacity.fargate(context(account, at_once=1))
    assert (spot.mark, on_demand.mark) == (Mark.BAD, Mark.BAD)
    assert ": 0 servers of 1 vCPU" in spot.text


# Projects


def test_without_a_live_project_capacity_is_checked_for_servers_of_the_usual_size(
    world: Installed, account: Account
) -> None:
    world.register(project(world, live=False))
    assert only(images.projects(context(account))).text == "None is live."
    fresh(world)
    quotas(world, spot=6, on_demand=60)
    # An administrator may run doctor before a study is registered.
    spot, on_demand = capacity.fargate(context(account, at_once=20))
    assert (spot.mark, on_demand.mark) == (Mark.LOOK, Mark.GOOD)
    assert "6 vCPU: 6 servers of 1 vCPU at once" in spot.text


def test_a_missing_image_is_bad(world: Installed, account: Account) -> None:
    digest = "sha256:" + "0" * 64
    world.register(project(world, task_definition=definition(world, image=f"{world.repository}@{digest}")))
    for answer in (None, {"imageDetails": []}):
        if answer:
            world.answer("ecr:DescribeImages", answer)
        line = only(images.projects(context(account)))
        assert (line.mark, "pushed half-way, or deleted" in line.text) == (Mark.BAD, True)


def test_task_definitions_that_cannot_run_are_bad(world: Installed, account: Account) -> None:
    missing = f"arn:aws:ecs:us-east-1:{world.env['SCHEDULE_ROLE_ARN'].split(':')[4]}:task-definition/gone:7"
    retired = definition(world, "retired")
    world.client("ecs").deregister_task_definition(taskDefinition=retired)
    for task in (missing, retired):
        world.register(project(world, task_definition=task))
        line = only(images.projects(context(account)))
        assert (line.mark, "is gone: no server can start" in line.text) == (Mark.BAD, True), line
    world.register(msgspec.structs.replace(study(), task_definition=None))
    assert "has no task definition" in only(images.projects(context(account))).text


def test_a_study_whose_language_model_has_no_key_is_bad(world: Installed, account: Account) -> None:
    talks = project(world, trial={"llm": {"url": "https://models.example.org/v1", "model": "small"}})
    world.register(talks)
    found = images.projects(context(account))
    assert [one.text for one in found if one.mark is Mark.BAD] == [
        "its servers need LLM_KEY, which is not stored: none can start."
    ]
    world.client("ssm").put_parameter(Name="/hippodrome/hippodrome/LLM_KEY", Value="sk-1", Type="SecureString")
    assert all(one.mark is not Mark.BAD for one in images.projects(context(account)))


def test_images_with_weaknesses_are_remarks(world: Installed, account: Account) -> None:
    counts = {"findingSeverityCounts": {"CRITICAL": 2, "HIGH": 7, "LOW": 90}}
    world.answer("ecr:DescribeImageScanFindings", {"imageScanFindings": counts})
    found = marks(images.projects(context(account, now=datetime.now(UTC) + timedelta(days=200))))
    assert (Mark.LOOK, "its image has known vulnerabilities: 2 critical, 7 high.") in found
    assert any(mark is Mark.LOOK and "200 days old" in text for mark, text in found)


def test_a_study_on_another_port_than_the_installation_is_a_remark(world: Installed, account: Account) -> None:
    world.register(project(world, server_port=5000))
    (found,) = [one for one in images.projects(context(account)) if one.mark is Mark.LOOK]
    assert found.text == "its servers listen on port 5000, and the installation's port is 443."
    assert "hippodrome register" in found.advice
    world.change(ServerPort="5000")
    assert {one.mark for one in images.projects(context(account))} == {Mark.GOOD}


@pytest.mark.parametrize(("warm", "max_runtime", "needed"), [(0, 121, 121), (2, 61, 121)])
def test_a_study_that_may_run_longer_than_the_installation_allows_is_a_remark(
    world: Installed, account: Account, warm: int, max_runtime: int, needed: int
) -> None:
    world.register(project(world, warm_servers=warm, max_runtime=max_runtime))
    (line,) = (one for one in images.projects(context(account)) if one.mark is not Mark.GOOD)
    assert line.mark is Mark.LOOK
    assert line.text.startswith(f"maxRuntime is {max_runtime} minutes")
    assert line.text.endswith("the installation stops servers after 120.")
    assert ("its warm servers need an hour more" in line.text, "warmServers: 0" in line.advice) == (warm > 0, warm > 0)
    assert f"--max-runtime {needed}, or" in line.advice


@pytest.mark.parametrize(
    "fits", [{"max_runtime": 60}, {"max_runtime": 110, "live": False}, {"max_runtime": 110, "warm_servers": 0}]
)
def test_warm_servers_with_time_to_wait_and_studies_without_them_are_good(
    world: Installed, account: Account, fits: dict[str, Any]
) -> None:
    kept = project(world, **{"warm_servers": 2, **fits})
    assert only(images.projects(context(account, wanted=kept))).mark is Mark.GOOD


def test_a_study_without_a_game_needs_no_image(world: Installed, account: Account) -> None:
    survey = msgspec.structs.replace(study(), steps=[step for step in study().steps if not step.type.on_server])
    world.register(survey)
    assert only(images.projects(context(account))).mark is Mark.GOOD
    assert only(capacity.fargate(context(account))).text == "No project needs servers."


# Safety


def test_an_open_bucket_is_bad(world: Installed, account: Account) -> None:
    fresh(world)
    s3, name = world.client("s3"), world.env["BUCKET"]
    s3.delete_public_access_block(Bucket=name)
    s3.put_bucket_versioning(Bucket=name, VersioningConfiguration={"Status": "Suspended"})
    found = {line.text: line.mark for line in safety.bucket(context(account))}
    assert len(found) == 3
    assert [mark for text, mark in found.items() if "Public access" in text or "without TLS" in text] == [Mark.BAD] * 2
    assert any("no older versions" in text for text in found)


def test_a_foreign_or_missing_bucket_is_reported(world: Installed, account: Account) -> None:
    world.fail("s3:HeadBucket", "403", status=403)
    assert "belongs to another account" in only(safety.bucket(context(account))).text
    world.fail("s3:HeadBucket", "404", status=404)
    assert "is gone" in only(safety.bucket(context(account))).text


def test_dead_letters_and_firing_alarms_are_bad(world: Installed, account: Account) -> None:
    sqs = world.client("sqs")
    dead = sqs.get_queue_url(QueueName="hippodrome-start-dead-letters")["QueueUrl"]
    sqs.send_message(QueueUrl=dead, MessageBody="{}")
    line = only(safety.queues(context(account)))
    assert (line.mark, "hippodrome-start-dead-letters 1" in line.text) == (Mark.BAD, True)
    world.client("cloudwatch").set_alarm_state(AlarmName="hippodrome-dead-letters", StateValue="ALARM", StateReason="x")
    assert only(safety.alarms(context(account))).mark is Mark.BAD


def test_the_subscribers_of_alarms_are_checked(world: Installed, account: Account) -> None:
    topic = world.alarm_topic
    given = {"TopicArn": topic, "Protocol": "email", "Owner": "123456789012", "Endpoint": "admin@example.org"}
    for arn, mark in (("PendingConfirmation", Mark.LOOK), (f"{topic}:1", Mark.GOOD)):
        world.answer("sns:ListSubscriptionsByTopic", {"Subscriptions": [{**given, "SubscriptionArn": arn}]})
        assert only(safety.listeners(context(account))).mark is mark
    world.answer("sns:ListSubscriptionsByTopic", {"Subscriptions": []})
    assert "no subscriber" in only(safety.listeners(context(account))).text


# The rehearsal


class Clock:
    """A clock whose time passes only in `sleep`, in which AWS acts as well."""

    def __init__(self, world: Installed, study_functions: StudyOnMoto | None = None) -> None:
        self.now = 0.0
        self.world, self.study_functions = world, study_functions
        self.world.in_sync = True

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        if self.study_functions:
            self.study_functions.deliver_some()


def rehearsed(
    world: Installed,
    study_functions: StudyOnMoto | None,
    *,
    whose: Project | None = None,
    reach: Callable[[str], object] | None = None,
    told: list[str] | None = None,
    sleep: Callable[[float], None] | None = None,
) -> list[Finding]:
    clock = Clock(world, study_functions)
    whose = whose or msgspec.structs.replace(study(), id="ms-pacman")
    tell = told.append if told is not None else lambda _: None
    findings: list[Finding] = []
    lone = LoneServer(world.platform, whose, tell, clock=clock, sleep=sleep or clock.sleep)
    with contextlib.suppress(KeyboardInterrupt):
        rehearse(lone, whose, findings, reach)
    return findings


def assert_nothing_left(world: Installed) -> None:
    assert [t.name for t in world.platform.tasks.list()] == []
    assert (world.records(), world.timers()) == ({}, {})


def test_a_rehearsal_starts_a_server_and_leaves_nothing(world: Installed) -> None:
    study_functions, told = StudyOnMoto(world), []
    SecretCache(world.platform.documents).get_or_create()
    before = world.keys()
    found = rehearsed(world, study_functions, told=told)
    assert [line.mark for line in found] == [Mark.GOOD, Mark.GOOD], found
    assert "ready after" in found[0].text
    assert any("its name is being made known" in line for line in told)
    assert_nothing_left(world)
    study_functions.deliver()
    assert world.keys() == before
    assert_nothing_left(world)


def test_a_rehearsal_says_that_it_got_a_warm_server(world: Installed) -> None:
    study_functions = StudyOnMoto(world)
    whose = project(world, id="ms-pacman", warm_servers=1)
    world.register(whose)
    (name,) = world.warm(whose, 1)
    found = rehearsed(world, study_functions, whose=whose)
    assert [line.mark for line in found] == [Mark.GOOD, Mark.GOOD], found
    assert found[0].text.startswith("A warm server of ms-pacman, on Spot: ")
    assert name not in [task.name for task in world.platform.tasks.list()]
    assert not any("rehearsal" in key for key in world.keys("ms-pacman/"))
    assert world.keys("ms-pacman/handovers/") == []


def test_a_rehearsal_of_a_project_with_sessions_starts_the_server_of_a_session(world: Installed) -> None:
    """A participant's start message would start no server; and the sweep must not stop the session's server as needless."""
    whose = msgspec.structs.replace(study(players=2), id="ms-pacman")
    study_functions = StudyOnMoto(world)
    world.register(whose)
    SecretCache(world.platform.documents).get_or_create()
    before, swept = world.keys(), []
    clock = Clock(world, study_functions)

    def sleep(seconds: float) -> None:
        clock.sleep(seconds)
        swept.append(Sweep(world.platform).run().sessions)

    found = rehearsed(world, study_functions, whose=whose, sleep=sleep)
    assert [line.mark for line in found] == [Mark.GOOD, Mark.GOOD], found
    assert set(swept) == {0}
    assert_nothing_left(world)
    study_functions.deliver()
    after = world.keys()
    assert [key for key in after if not key.startswith("_lobb")] == before


def test_a_rehearsal_connects_to_its_server_as_browsers_do(world: Installed) -> None:
    asked: list[str] = []

    def closed(url: str) -> None:
        asked.append(url)
        raise urllib.error.URLError("timed out")

    def distrusted(_: str) -> None:
        raise urllib.error.URLError(ssl.SSLCertVerificationError(1, "self-signed certificate"))

    study_functions = StudyOnMoto(world)
    for reach, mark in ((asked.append, Mark.GOOD), (closed, Mark.LOOK), (distrusted, Mark.BAD)):
        found = rehearsed(world, study_functions, reach=reach)
        assert [line.mark for line in found] == [Mark.GOOD, mark, Mark.GOOD], found
        assert_nothing_left(world)
    assert re.fullmatch(r"https://s[a-z2-7]{20}-1\.servers\.example\.org:5000/", asked[0])


def test_a_rehearsal_cleans_up_if_no_function_acts(world: Installed) -> None:
    found = rehearsed(world, None)
    assert "No function acted on the start message" in found[0].text
    assert found[0].mark is Mark.BAD
    assert found[-1].mark is Mark.LOOK
    StudyOnMoto(world).deliver()  # the start message arrives late, when the server is closed
    assert_nothing_left(world)


def test_a_rehearsal_says_why_its_server_was_closed(world: Installed) -> None:
    study_functions = StudyOnMoto(world)
    world.fail("ecs:RunTask", "InvalidParameterException", "No such task definition.", times=10)
    found = rehearsed(world, study_functions)
    assert found[0].text == f"The server was closed: {Reason.REFUSED}."
    assert found[0].advice == Cause.DEFINITION.sentence
    assert_nothing_left(world)


def test_ctrl_c_in_a_rehearsal_leaves_nothing(world: Installed) -> None:
    study_functions, slept = StudyOnMoto(world), 0
    clock = Clock(world, study_functions)

    def sleep(seconds: float) -> None:
        nonlocal slept
        slept += 1
        if slept == 2:
            raise KeyboardInterrupt
        clock.sleep(seconds)

    assert [line.text for line in rehearsed(world, study_functions, sleep=sleep)] == [
        "It was stopped, and nothing of it is left."
    ]
    study_functions.deliver()
    assert_nothing_left(world)


@pytest.mark.parametrize(("mark", "code"), [(Mark.GOOD, Exit.DONE), (Mark.BAD, Exit.FAILED)])
def test_a_rehearsal_decides_how_the_command_ends(
    world: Installed, capsys: Any, monkeypatch: Any, mark: Mark, code: Exit
) -> None:
    """Other problems are still reported."""
    world.put("SSL/servers.example.org/fullchain.pem", chain("*.servers.example.org", days=-1))
    assert world.run(capsys, "doctor", "--all", "--only-aws").code == Exit.FAILED

    def rehearse(lone: LoneServer, project: Project, findings: list[Finding], reach: object) -> None:
        findings.append(Finding("rehearsal", mark, "A server was started and stopped.", "Look at the logs."))

    monkeypatch.setattr("hippodrome.deployment.operate.doctor.rehearsal.rehearse", rehearse)
    ran = world.run(capsys, "doctor", "--all", "--only-aws", "--rehearse")
    assert ran.code == code
    assert "✗ certificate: It expired" in ran.out
    last = "The rehearsal succeeded; 1 to mend" if mark is Mark.GOOD else "2 to mend"
    assert ran.out.splitlines()[-1].startswith(last)


def test_a_rehearsal_without_a_live_project_is_bad(world: Installed, capsys: Any) -> None:
    world.register(project(world, live=False))
    assert doctor(world, capsys, "--all", "--rehearse")["rehearsal"][0] == "bad"


# As a process


def test_as_a_process(world: Installed) -> None:
    world.register(project(world, task_definition=definition(world, image=f"{world.repository}:latest")))
    with world.served() as env:
        ran = process(env, "doctor", "--all", "--only-aws", "--json")
        plain = process(env, "doctor", "--all", "--only-aws")
        nowhere = process({**env, "AWS_REGION": "eu-west-1"}, "doctor", "--all", "--json")
    found = {one["check"]: one for one in ran.json["checks"]}
    # Moto has neither quotas nor a policy that asks for TLS.
    assert ran.code == plain.code == nowhere.code == Exit.FAILED
    assert found["certificate"]["mark"] == "good"
    assert found["project maze"]["mark"] == "bad"
    assert found["bucket"]["text"].endswith("can be read without TLS.")
    assert "✗ project maze: its image is not in the repository" in plain.out
    assert "There is no stack named hippodrome in eu-west-1" in nowhere.out
