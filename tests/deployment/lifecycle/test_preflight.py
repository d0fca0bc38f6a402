"""The checks before apply makes anything: each problem has its sentence and its remedy."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from botocore.exceptions import ClientError

from hippodrome.console.problem import Problem
from hippodrome.deployment.aws import caa, quotas
from hippodrome.deployment.aws import hosted_zone as zones
from hippodrome.deployment.aws.caa import find as find_caa
from hippodrome.deployment.aws.hosted_zone import Delegation, Zone, delegation
from hippodrome.deployment.core import project_folder
from hippodrome.deployment.core.finding import Finding, Mark
from hippodrome.deployment.lifecycle import apply as applying
from hippodrome.deployment.lifecycle import preflight
from hippodrome.deployment.lifecycle.apply import ApplyRequest, apply, plan
from hippodrome.deployment.stack.changes import prepare
from hippodrome.deployment.stack.settings import StackSettings
from tests.certificate.nameserver import SERVFAIL, answering, ask_only
from tests.deployment.registering import write_study
from tests.deployment.stack_world import DOMAIN, World

FIRST = StackSettings(domain=DOMAIN)
NOBODY = Delegation((), "The Internet knows no name servers for example.org.")
Capsys = pytest.CaptureFixture[str]


@pytest.fixture
def game(tmp_path: Path) -> project_folder.ProjectFolder:
    """A study whose servers have a vCPU each."""
    return project_folder.read(write_study(tmp_path / "study"))


def findings(
    world: World, settings: StackSettings = FIRST, game: project_folder.ProjectFolder | None = None
) -> list[Finding]:
    return preflight.look_at(prepare(world.account, "hippodrome", settings), game)


def only(found: list[Finding]) -> Finding:
    (one,) = found
    assert re.fullmatch(r"(?s)[A-Z0-9].*[.)]", one.text), one.text
    return one


def nothing_was_made(world: World) -> bool:
    made = [name for name, _ in world.cloud.calls if not name.startswith(("get_", "describe_", "list_"))]
    buckets = world.account.client("s3").list_buckets()["Buckets"]
    return not made and not buckets and not world.account.client("iam").list_roles()["Roles"]


# -- the list ----------------------------------------------------------------------------------------------------------


def test_without_problems_there_are_no_findings(world: World) -> None:
    assert findings(world) == []


def test_all_problems_are_reported_at_once_with_their_remedies(
    world: World, game: project_folder.ProjectFolder, capsys: Capsys
) -> None:
    world.delegated = NOBODY
    world.caa[f"study.{DOMAIN}"] = caa.Caa(DOMAIN, (("issue", "digicert.com"),))
    world.limits.executions = 10
    record(world, f"study.{DOMAIN}")
    with pytest.raises(Problem, match=r"3 things are in the way, marked ✗\. Nothing was deployed\.") as caught:
        apply(world.account, "hippodrome", FIRST, ApplyRequest(game))
    assert caught.value.advice == "Put that right, and run the same command again."
    lines = capsys.readouterr().err.splitlines()
    marks = [line.split(":")[0] for line in lines if line[0] in "✗!"]
    assert marks == ["! Lambda", "✗ domain", "✗ CAA", "✗ site"]
    assert [line.startswith("    → ") for line in lines] == [False, True] * 4
    assert nothing_was_made(world)


def test_mistakes_in_the_study_are_in_the_same_list(world: World, capsys: Capsys) -> None:
    world.delegated = NOBODY
    mistakes = Problem("The project cannot be registered.", "Correct it.", ["config.yml:3: no", "config.yml:4: no"])
    with pytest.raises(Problem, match="2 things are in the way"):
        apply(world.account, "hippodrome", FIRST, ApplyRequest(wrong=[preflight.of_problem("study", mistakes)]))
    said = capsys.readouterr().err
    assert (
        "✗ study: The project cannot be registered.\n    config.yml:3: no\n    config.yml:4: no\n    → Correct it.\n"
        in said
    )
    assert "✗ domain" in said
    assert nothing_was_made(world)


def test_a_domain_without_a_zone_does_not_hide_the_rest(world: World, capsys: Capsys) -> None:
    world.limits.quotas[quotas.SPOT] = 6
    with pytest.raises(Problem, match="1 thing is in the way"):
        apply(world.account, "hippodrome", StackSettings(domain="example.com"))
    said = capsys.readouterr().err
    assert "✗ installation: This account has no public hosted zone for example.com." in said
    assert "! Fargate, Spot: 6 vCPU: 6 servers of 1 vCPU may run at once." in said
    assert said.index("! Fargate") < said.index("✗ installation")
    assert nothing_was_made(world)


def test_a_mistake_in_the_study_comes_after_the_remarks(world: World, capsys: Capsys) -> None:
    world.limits.executions = 10
    wrong = preflight.of_problem("study", Problem("The project cannot be registered."))
    with pytest.raises(Problem, match="1 thing is in the way"):
        apply(world.account, "hippodrome", FIRST, ApplyRequest(wrong=[wrong]))
    said = capsys.readouterr().err
    assert said.index("! Lambda") < said.index("✗ study")


def test_a_plan_lists_remarks_before_problems(world: World) -> None:
    world.delegated = NOBODY
    world.limits.executions = 10
    assert [one.check for one in plan(world.account, "hippodrome", FIRST).findings] == ["Lambda", "domain"]


def test_a_plan_shows_the_problems_and_does_not_stop(world: World) -> None:
    world.delegated = NOBODY
    found = plan(world.account, "hippodrome", FIRST)
    assert found.kind == "create"
    assert [one.check for one in found.findings] == ["domain"]
    assert found.as_json()["findings"][0]["mark"] == "bad"
    assert nothing_was_made(world)


def test_a_plan_of_an_update_shows_its_problems(world: World) -> None:
    apply(world.account, "hippodrome", FIRST)
    world.delegated = NOBODY
    found = plan(world.account, "hippodrome", StackSettings(site="lab"))
    assert found.kind == "update"
    assert [one.check for one in found.findings] == ["domain"]


def test_a_plan_names_the_address_that_participants_will_open(world: World) -> None:
    """With DOMAIN=study.example.org the plan shows the second `study` in the address before it is made."""
    first = [line for line, _ in plan(world.account, "hippodrome", FIRST).lines()]
    assert f"Participants will open https://study.{DOMAIN}/next" in first
    apply(world.account, "hippodrome", FIRST)
    moved = [line for line, _ in plan(world.account, "hippodrome", StackSettings(site="lab")).lines()]
    assert f"Participants will open https://lab.{DOMAIN}/next" in moved


def test_problems_can_be_overruled(world: World, capsys: Capsys) -> None:
    world.delegated = NOBODY
    assert apply(world.account, "hippodrome", FIRST, ApplyRequest(anyway=True)).changed
    assert "✗ domain" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("operation", "check"),
    [
        ("GetAccountSettings", "Lambda"),
        ("GetServiceQuota", "Fargate"),
        ("DescribeVpcBlockPublicAccessOptions", "Internet"),
    ],
)
def test_a_check_without_permission_is_a_remark(world: World, capsys: Capsys, operation: str, check: str) -> None:
    world.limits.denied.add(operation)
    assert apply(world.account, "hippodrome", FIRST).changed
    said = capsys.readouterr().err
    assert f"! {check}: could not be checked: These credentials may not " in said


def test_of_an_existing_installation_only_changes_are_checked(world: World) -> None:
    world.delegated = NOBODY
    world.limits.executions = 10
    world.limits.quotas.clear()
    record(world, f"study.{DOMAIN}")  # the site's own record
    world.stand()
    assert findings(world, StackSettings(max_runtime=30)) == []
    assert {one.check for one in findings(world, StackSettings(site="lab"))} == {"domain"}
    assert apply(world.account, "hippodrome", StackSettings(max_runtime=30)).changed


# -- the account -------------------------------------------------------------------------------------------------------


def test_a_region_without_a_needed_service_is_a_problem(world: World, capsys: Capsys) -> None:
    world.account.region = "ap-southeast-7"
    found = only([one for one in findings(world) if one.mark is Mark.BAD])
    assert "cannot be installed in ap-southeast-7" in found.text
    assert "ap-southeast-1" in found.advice


def test_few_executions_are_a_remark_that_says_how_they_are_divided(world: World) -> None:
    world.limits.executions = 10
    found = only(findings(world))
    assert found.mark is Mark.LOOK
    assert "10 functions at once: 4 for participants' pages, 2 to start servers" in found.text
    assert "--service-code lambda --quota-code L-B99A9384 --desired-value 1000 --region ca-central-1" in found.advice
    world.limits.executions = 100
    assert findings(world) == []


@pytest.mark.parametrize(("vcpu", "servers"), [(6, "6 servers"), (1, "1 server")])
def test_few_vcpus_are_a_remark(world: World, game: project_folder.ProjectFolder, vcpu: float, servers: str) -> None:
    world.limits.quotas |= {quotas.SPOT: vcpu, quotas.ON_DEMAND: vcpu}
    spot, on_demand = findings(world, game=game)
    assert (spot.mark, on_demand.mark) == (Mark.LOOK, Mark.LOOK)
    assert spot.text == f"{vcpu} vCPU: {servers} of 1 vCPU may run at once."
    assert on_demand.text == f"{vcpu} vCPU: {servers} of 1 vCPU may run at once, if Spot has no room."
    assert "--quota-code L-36FBB829 --desired-value 20" in spot.advice
    assert "--quota-code L-3032A538 --desired-value 20" in on_demand.advice


def test_an_account_that_may_run_no_server_is_a_problem_for_a_study_with_a_game(
    world: World, game: project_folder.ProjectFolder
) -> None:
    world.limits.quotas |= {quotas.SPOT: 0, quotas.ON_DEMAND: 0}
    found = only(findings(world, game=game))
    assert (found.mark, found.text.partition(":")[0]) == (Mark.BAD, "This account may run no server at all")
    assert "--quota-code L-3032A538 --desired-value 20" in found.advice


def test_a_study_without_a_game_needs_no_servers(world: World, tmp_path: Path) -> None:
    folder = write_study(tmp_path / "study")
    config = folder / "config.yml"
    config.write_text(config.read_text().replace("2: game, 3: thanks", "2: thanks").partition("trial:")[0])
    world.limits.quotas |= {quotas.SPOT: 0, quotas.ON_DEMAND: 0}
    assert findings(world, game=project_folder.read(folder)) == []


def test_a_budget_is_refused_where_cloudformation_makes_none(world: World) -> None:
    world.text = world.text.replace("Parameters:\n", "Parameters:\n  MonthlyBudget: {Type: Number, Default: 0}\n")
    prepare(world.account, "hippodrome", StackSettings(domain=DOMAIN, budget=50))
    world.account.region = "eu-north-1"
    with pytest.raises(Problem, match="cannot be made like this") as refused:
        prepare(world.account, "hippodrome", StackSettings(domain=DOMAIN, budget=50))
    assert refused.value.details == (
        "--budget must be 0 in eu-north-1: make it in the console, Billing and Cost Management",
    )


def test_a_used_up_quota_of_vpcs_is_a_problem(world: World) -> None:
    ec2 = world.account.client("ec2")
    there = len(ec2.describe_vpcs()["Vpcs"])
    world.limits.quotas[quotas.VPCS] = there + 1
    assert findings(world) == []
    world.limits.quotas[quotas.VPCS] = there
    found = only(findings(world))
    assert (found.mark, found.check) == (Mark.BAD, "VPCs")
    assert "--vpc" in found.advice
    assert f"--quota-code L-F678F1CE --desired-value {there + 1}" in found.advice


# -- the addresses -----------------------------------------------------------------------------------------------------


def record(world: World, name: str, kind: str = "A", value: str = "192.0.2.1") -> None:
    change = {
        "Action": "CREATE",
        "ResourceRecordSet": {"Name": name, "Type": kind, "TTL": 60, "ResourceRecords": [{"Value": value}]},
    }
    batch = {"Changes": [change]}
    world.account.client("route53").change_resource_record_sets(HostedZoneId=world.zone, ChangeBatch=batch)


def test_a_domain_that_is_not_delegated_is_a_problem_with_the_name_servers_to_set(world: World) -> None:
    """Without this check the stack would wait for ACM for hours."""
    world.delegated = NOBODY
    found = only(findings(world))
    assert found.mark is Mark.BAD
    servers = world.account.client("route53").get_hosted_zone(Id=world.zone)["DelegationSet"]["NameServers"]
    assert len(servers) == 4
    assert all(one in found.advice for one in servers)


@pytest.mark.parametrize("kind", ["CNAME", "NS"])
def test_a_record_that_hides_the_proof_of_the_servers_domain_is_a_problem(world: World, kind: str) -> None:
    record(world, f"_acme-challenge.servers.{DOMAIN}", kind, "elsewhere.example.net")
    found = only(findings(world))
    assert found.mark is Mark.BAD
    assert (
        f"The hosted zone has a record {kind} of _acme-challenge.servers.{DOMAIN}, so no authority can see the proof"
        in found.text
    )


def test_dns_that_cannot_be_asked_is_a_remark(world: World) -> None:
    world.delegated = Delegation((), "Whether example.org is delegated could not be asked: LifetimeTimeout.", False)
    world.caa[f"servers.{DOMAIN}"] = caa.Caa(certain=False)
    domain, authorities = findings(world)
    assert (domain.mark, authorities.mark) == (Mark.LOOK, Mark.LOOK)


# Each of these names allows ACM to issue (ACM's user guide, "(Optional) Configure a CAA record").
AMAZON = ("amazon.com", "amazontrust.com", "awstrust.com", "amazonaws.com")


@pytest.mark.parametrize(
    ("name", "records", "who"),
    [
        ("study.example.org", [("issue", "digicert.com")], "Amazon"),
        ("study.example.org", [("issue", ";")], "Amazon"),
        ("study.example.org", [("issue", "letsencrypt.org"), ("issuewild", "amazon.com")], "Amazon"),
        ("example.org", [("issue", "amazon.com")], "Let's Encrypt"),
        ("example.org", [("issue", "letsencrypt.org"), ("issuewild", ";")], "Let's Encrypt"),
        ("example.org", [("issue", "letsencrypt.org; validationmethods=http-01")], "Let's Encrypt"),
        *[("study.example.org", [("issue", name)], "") for name in AMAZON],
        ("study.example.org", [("issue", "amazon.com"), ("issuewild", ";")], ""),
        ("study.example.org", [("iodef", "mailto:admin@example.org")], ""),
        ("example.org", [("issue", "letsencrypt.org")], ""),
        ("example.org", [("issue", ";"), ("issuewild", "letsencrypt.org")], ""),
    ],
)
def test_caa_records_must_allow_both_authorities(world: World, name: str, records: list[caa.Record], who: str) -> None:
    """Amazon issues the site's certificate, which is no wildcard; Let's Encrypt issues the servers' wildcard certificate."""
    for wild in {name, *([DOMAIN, f"servers.{DOMAIN}"] if name == DOMAIN else [])}:
        world.caa[wild] = caa.Caa(name, tuple(records))
    found = findings(world)
    assert [one.mark for one in found] == ([Mark.BAD] if who else [])
    for one in found:
        assert f"The CAA records of {name} (" in one.text
        assert f"keep {who} from issuing" in one.text
        assert one.advice == f'Add two CAA records to {name}: 0 issue "amazon.com" and 0 issuewild "letsencrypt.org".'


def test_the_advice_on_caa_records_above_the_domain_adds_records_to_the_domain(world: World) -> None:
    world.caa["study.lab.example.org"] = caa.Caa("example.org", (("issue", "digicert.com"),))
    found = only(findings(world, StackSettings(domain="lab.example.org")))
    assert "The CAA records of example.org" in found.text
    assert "Add two CAA records to lab.example.org:" in found.advice


def test_the_caa_records_of_the_nearest_parent_count(monkeypatch: pytest.MonkeyPatch) -> None:
    above = {("example.org", "CAA"): ['0 issue "digicert.com"'], ("lab.example.org", "CAA"): ['0 ISSUE "amazon.com"']}
    with answering(above) as port:
        ask_only(monkeypatch, port)
        assert caa.find("study.example.org") == caa.Caa("example.org", (("issue", "digicert.com"),))
        assert caa.find("study.lab.example.org") == caa.Caa("lab.example.org", (("issue", "amazon.com"),))
        assert caa.find("example.com") == caa.Caa()


EVERY = {"study.lab.example.org", "lab.example.org", "example.org", "org"}


@pytest.mark.parametrize(
    ("there", "asked"),
    [
        ([], {"example.org", "org"}),
        (["mail.example.org"], {"example.org", "org"}),
        (["a.lab.example.org"], {"lab.example.org", "example.org", "org"}),
        (["a.study.lab.example.org"], EVERY),
        (["*.lab.example.org"], {*EVERY, "servers.lab.example.org"}),
        (["*.example.org"], {*EVERY, "servers.lab.example.org"}),
    ],
)
def test_dns_is_not_asked_for_names_that_do_not_exist_yet(
    world: World, monkeypatch: pytest.MonkeyPatch, there: list[str], asked: set[str]
) -> None:
    """A resolver caches for 15 minutes that a name does not exist: the administrator could not open the new site."""
    monkeypatch.setattr(caa, "find", find_caa)
    for name in there:
        record(world, name)
    heard: set[str] = set()
    with answering({("org", "CAA"): ['0 issue "amazon.com"', '0 issue "letsencrypt.org"']}, heard) as port:
        ask_only(monkeypatch, port)
        assert findings(world, StackSettings(domain="lab.example.org")) == []
    assert heard == asked


def test_caa_records_of_an_existing_name_count(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(caa, "find", find_caa)
    record(world, "a.study.example.org")
    with answering({("study.example.org", "CAA"): ['0 issue ";"']}) as port:
        ask_only(monkeypatch, port)
        assert "The CAA records of study.example.org" in only(findings(world)).text


@pytest.mark.parametrize(
    ("records", "problem", "certain"),
    [
        ({("example.org", "NS"): ["ns-1.awsdns-1.org."]}, "", True),
        ({("example.org", "NS"): ["ns.elsewhere.net."]}, "is delegated to other name servers: ns.elsewhere.net.", True),
        ({("org", "NS"): ["ns.org."]}, "The Internet knows no name servers for example.org.", True),
        ({("example.org", "NS"): SERVFAIL, ("org", "NS"): ["ns.org."]}, "do not answer for it.", True),
        ({("example.org", "NS"): SERVFAIL, ("org", "NS"): SERVFAIL}, "do not answer for it.", False),
    ],
)
def test_delegation_is_judged_by_the_answers_of_dns(
    monkeypatch: pytest.MonkeyPatch, records: Any, problem: str, certain: bool
) -> None:
    """A zone that was deleted and made again has other name servers; the old ones answer SERVFAIL."""
    monkeypatch.setattr(zones, "DNS_TIMEOUT", 60.0)
    with answering(records) as port:
        ask_only(monkeypatch, port)
        found = delegation(Zone("Z1", "example.org", ("ns-1.awsdns-1.org", "ns-2.awsdns-2.com")))
    assert found.problem.endswith(problem)
    assert (bool(found.problem), found.certain) == (bool(problem), certain)


def test_the_sites_address_must_be_free(world: World) -> None:
    record(world, "study.example.org")
    found = only(findings(world))
    assert "already has a record of type A for study.example.org" in found.text
    assert "--site" in found.advice
    assert findings(world, StackSettings(domain=DOMAIN, site="lab")) == []


def test_the_sites_address_must_be_free_at_api_gateway(world: World) -> None:
    world.account.client("apigatewayv2").create_domain_name(DomainName="study.example.org")
    found = only(findings(world))
    assert (found.mark, "already serves study.example.org" in found.text) == (Mark.BAD, True)


def test_a_second_installation_on_one_domain_is_a_remark(world: World) -> None:
    world.cloud.others = [
        {
            "StackName": "other",
            "StackStatus": "CREATE_COMPLETE",
            "Tags": [{"Key": "hippodrome:stack", "Value": "other"}],
            "Parameters": [{"ParameterKey": "RootDomain", "ParameterValue": DOMAIN}],
        }
    ]
    found = only(findings(world))
    assert (found.mark, "The stack other has the domain" in found.text) == (Mark.LOOK, True)


# -- the network, and what is left of an earlier installation ----------------------------------------------------------


def test_subnets_are_checked(world: World) -> None:
    ec2 = world.account.client("ec2")
    vpcs = [ec2.create_vpc(CidrBlock=f"10.{n}.0.0/16")["Vpc"]["VpcId"] for n in (1, 2)]
    subnets = [
        ec2.create_subnet(VpcId=vpc, CidrBlock=f"10.{n}.1.0/24")["Subnet"]["SubnetId"] for n, vpc in enumerate(vpcs, 1)
    ]

    def found(subnet: str) -> list[tuple[Mark, str]]:
        settings = StackSettings(domain=DOMAIN, vpc=vpcs[0], subnets=subnet)
        return [(one.mark, one.text) for one in findings(world, settings)]

    in_one_zone = (Mark.LOOK, "All those subnets are in one zone: when Spot runs out of room there, servers cost more.")
    assert found(subnets[1]) == [
        in_one_zone,
        (Mark.BAD, f"The subnet {subnets[1]} is in {vpcs[1]}, not in {vpcs[0]}."),
    ]
    ((mark, said),) = found("subnet-12345678")
    assert (mark, "does not exist" in said) == (Mark.BAD, True)
    assert found(subnets[0]) == [in_one_zone]
    ec2.create_vpc_endpoint(
        VpcId=vpcs[0],
        ServiceName="com.amazonaws.us-east-1.execute-api",
        VpcEndpointType="Interface",
        SubnetIds=[subnets[0]],
        PrivateDnsEnabled=True,
    )
    assert [(mark, "has private DNS" in text) for mark, text in found(subnets[0])] == [
        (Mark.LOOK, False),
        (Mark.BAD, True),
    ]


@pytest.mark.parametrize("mode", ["block-ingress", "block-bidirectional"])
def test_an_account_that_closes_its_networks_to_the_internet_gets_no_installation(world: World, mode: str) -> None:
    world.limits.public_access = {"InternetGatewayBlockMode": mode, "ManagedBy": "account"}
    found = only(findings(world))
    assert (found.mark, found.check) == (Mark.BAD, "Internet")
    assert "servers cannot load their image, and no browser can reach them" in found.text
    assert "exempt a VPC there and name it" in found.advice
    assert found.advice.endswith(f"--internet-gateway-block-mode off --region {world.account.region}")
    world.limits.public_access["ManagedBy"] = "declarative-policy"
    assert only(findings(world)).advice.startswith("Your organization has set it: ask its administrators")


def test_a_network_that_is_exempt_from_the_block_is_good(world: World) -> None:
    world.limits.public_access = {"InternetGatewayBlockMode": "block-bidirectional"}
    ec2 = world.account.client("ec2")
    vpc = ec2.create_vpc(CidrBlock="10.1.0.0/16")["Vpc"]["VpcId"]
    subnets = [
        ec2.create_subnet(VpcId=vpc, CidrBlock=f"10.1.{n}.0/24", AvailabilityZone=f"ca-central-1{zone}")["Subnet"]
        for n, zone in enumerate("ab")
    ]
    names = [subnet["SubnetId"] for subnet in subnets]

    def closed(mode: str = "allow-bidirectional", state: str = "create-complete", *exempt: str) -> bool:
        world.limits.exclusions = [
            {
                "ResourceArn": f"arn:aws:ec2:ca-central-1:123456789012:{name.partition('-')[0]}/{name}",
                "InternetGatewayExclusionMode": mode,
                "State": state,
            }
            for name in exempt
        ]
        found = findings(world, StackSettings(domain=DOMAIN, vpc=vpc, subnets=",".join(names)))
        assert [one.check for one in found] in ([], ["Internet"])
        assert not found or f"exempt {vpc}: " in found[0].advice
        return bool(found)

    there, done = "allow-bidirectional", "create-complete"
    assert closed(there, done)
    assert not closed(there, done, vpc)
    assert not closed(there, done, *names)
    assert closed(there, done, names[0])
    assert closed("allow-egress", done, vpc)
    assert closed(there, "delete-complete", vpc)


def test_remains_of_an_unfinished_destroy_are_a_problem(world: World) -> None:
    world.account.client("logs").create_log_group(logGroupName="/hippodrome/hippodrome/sweep")
    found = only(findings(world))
    assert (found.mark, "An earlier installation hippodrome has left 1 log group" in found.text) == (Mark.BAD, True)
    assert "hippodrome destroy --stack hippodrome" in found.advice


# -- roles that were just made -----------------------------------------------------------------------------------------

NOT_YET = (
    'Resource handler returned message: "Invalid request provided: CreateCluster Invalid Request: Unable to assume the '
    'service linked role. Please verify that the ECS service linked role exists."'
)
UNKNOWN_ROLE = [
    ("CREATE_IN_PROGRESS", []),
    ("ROLLBACK_IN_PROGRESS", [("Cluster", "AWS::ECS::Cluster", "CREATE_FAILED", NOT_YET)]),
    ("ROLLBACK_COMPLETE", []),
]
OF_NEW_ROLES = [
    ("AWS::Lambda::Function", "The role defined for the function cannot be assumed by Lambda."),
    (
        "AWS::Lambda::EventSourceMapping",
        "Invalid request provided: The function execution role does not have permissions to call ReceiveMessage on SQS",
    ),
]


@pytest.fixture
def waits(world: World, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The pauses (seconds) in which apply waited for ECS's role."""
    slept: list[float] = []
    monkeypatch.setattr(applying.time, "sleep", lambda s: slept.append(s) if s >= applying.ROLE_PAUSE else None)
    return slept


def test_the_first_apply_makes_the_role_of_ecs_and_waits_ten_seconds(
    world: World, waits: list[float], capsys: Capsys
) -> None:
    apply(world.account, "hippodrome", FIRST)
    roles = world.account.client("iam").list_roles()["Roles"]
    assert [role["Path"] for role in roles] == ["/aws-service-role/ecs.amazonaws.com/"]
    assert waits == [10]
    assert "ECS's role was made just now" in capsys.readouterr().err


@pytest.mark.parametrize("code", ["InvalidInput", "AccessDenied"])
def test_an_existing_or_forbidden_role_of_ecs_is_not_waited_for(
    world: World, waits: list[float], code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: Any) -> None:
        raise ClientError({"Error": {"Code": code, "Message": "taken"}}, "CreateServiceLinkedRole")

    monkeypatch.setattr(world.account.client("iam"), "create_service_linked_role", refuse, raising=False)
    assert apply(world.account, "hippodrome", FIRST).changed
    assert waits == []


def test_a_creation_that_failed_because_ecs_does_not_know_its_role_is_repeated(
    world: World, waits: list[float]
) -> None:
    world.cloud.operations = [list(UNKNOWN_ROLE), [("DELETE_IN_PROGRESS", []), ("DELETE_COMPLETE", [])]]
    assert apply(world.account, "hippodrome", FIRST).changed
    assert waits == [10, 10]
    assert world.cloud.stack is not None
    assert world.cloud.stack["StackStatus"] == "CREATE_COMPLETE"


@pytest.mark.parametrize(("kind", "words"), OF_NEW_ROLES)
def test_an_update_that_failed_because_a_new_role_is_not_known_is_repeated(
    world: World, waits: list[float], kind: str, words: str, capsys: Capsys
) -> None:
    apply(world.account, "hippodrome", FIRST)
    world.cloud.operations = [
        [
            ("UPDATE_IN_PROGRESS", []),
            ("UPDATE_ROLLBACK_IN_PROGRESS", [("New", kind, "CREATE_FAILED", words)]),
            ("UPDATE_ROLLBACK_COMPLETE", []),
        ]
    ]
    assert apply(world.account, "hippodrome", StackSettings(max_runtime=60)).changed
    assert waits == [10, 10]
    assert "does not know a new role everywhere yet" in capsys.readouterr().err


def test_a_creation_that_fails_for_its_role_is_tried_three_times(world: World, waits: list[float]) -> None:
    gone = [("DELETE_IN_PROGRESS", []), ("DELETE_COMPLETE", [])]
    world.cloud.operations = [list(UNKNOWN_ROLE), list(gone), list(UNKNOWN_ROLE), list(gone), list(UNKNOWN_ROLE)]
    with pytest.raises(Problem, match="could not be made") as caught:
        apply(world.account, "hippodrome", FIRST)
    assert waits == [10, 10, 10]
    assert "in a minute" in caught.value.advice
