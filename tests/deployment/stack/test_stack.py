"""Stack, template, zone, settings and code bucket, on which plan and apply are built."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from typing import Any

import pytest
from botocore.awsrequest import AWSResponse
from botocore.exceptions import ClientError
from moto.core.botocore_stubber import MockRawResponse

from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.aws import hosted_zone as zones
from hippodrome.deployment.code.template import PATH, Template
from hippodrome.deployment.stack import stack as stacks
from hippodrome.deployment.stack.code_bucket import CodeBucket
from hippodrome.deployment.stack.settings import StackSettings, option
from hippodrome.deployment.stack.stack import Stack
from tests.deployment.stack_world import ACCOUNT, REGION, TEMPLATE, World, function

FAILED_CREATION = [
    ("CREATE_IN_PROGRESS", [("Vpc", "AWS::EC2::VPC", "CREATE_IN_PROGRESS", "")]),
    (
        "ROLLBACK_IN_PROGRESS",
        [
            ("Vpc", "AWS::EC2::VPC", "CREATE_FAILED", "The maximum number of VPCs has been reached."),
            ("Sweep", "AWS::Lambda::Function", "CREATE_FAILED", "Resource creation cancelled"),
        ],
    ),
    ("ROLLBACK_COMPLETE", [("Vpc", "AWS::EC2::VPC", "DELETE_COMPLETE", "")]),
]


def made(world: World) -> Stack:
    return Stack(world.account, "hippodrome", sleep=lambda _: None)


# -- following ---------------------------------------------------------------------------------------------------------


def test_only_the_first_cause_of_a_failure_is_reported(world: World) -> None:
    world.stand("CREATE_COMPLETE")
    stack = made(world)
    stack_id = world.cloud.stack["StackId"]
    after = stack.last_event(stack_id)
    world.cloud.script = list(FAILED_CREATION)
    assert stack.follow("Making", stack_id, 3, after) == "ROLLBACK_COMPLETE"
    problem = stack.problem("It could not be made", stack_id, "ROLLBACK_COMPLETE")
    assert str(problem) == "It could not be made (now ROLLBACK_COMPLETE)."
    assert problem.details == ("Vpc (AWS::EC2::VPC, physical-Vpc):", "  The maximum number of VPCs has been reached.")
    assert "--vpc" in problem.advice


def test_failures_of_earlier_operations_are_not_reported(world: World) -> None:
    world.stand("CREATE_COMPLETE")
    world.cloud.script = list(FAILED_CREATION)
    stack, stack_id = made(world), world.cloud.stack["StackId"]
    while world.cloud.script:
        world.cloud.describe_stacks(stack_id)
    after = stack.last_event(stack_id)
    world.cloud.script = [
        ("UPDATE_IN_PROGRESS", [("Bucket", "AWS::S3::Bucket", "UPDATE_COMPLETE", "")]),
        ("UPDATE_COMPLETE", []),
    ]
    assert stack.follow("Updating", stack_id, 1, after) == "UPDATE_COMPLETE"
    operation = stack.operation(stack_id)
    assert operation.failures == []
    assert operation.states == {"Bucket": "UPDATE_COMPLETE"}


def test_the_status_before_an_operation_is_not_taken_for_its_end(world: World) -> None:
    """ExecuteChangeSet returns before the status is IN_PROGRESS; until then UPDATE_COMPLETE is that of the last update."""
    world.stand("UPDATE_COMPLETE")
    stack, stack_id = made(world), world.cloud.stack["StackId"]
    after = stack.last_event(stack_id)
    world.cloud.script = [
        ("UPDATE_COMPLETE", []),
        ("UPDATE_COMPLETE", []),
        ("UPDATE_IN_PROGRESS", []),
        ("UPDATE_ROLLBACK_IN_PROGRESS", []),
        ("UPDATE_ROLLBACK_COMPLETE", []),
    ]
    assert stack.follow("Updating", stack_id, 1, after) == "UPDATE_ROLLBACK_COMPLETE"


def test_ctrl_c_says_that_cloudformation_goes_on(world: World) -> None:
    world.stand("UPDATE_IN_PROGRESS")
    world.cloud.interrupt_after = 2
    with pytest.raises(Problem, match="CloudFormation goes on") as caught:
        made(world).attach()
    assert caught.value.exit_code == Exit.INTERRUPTED


def test_attach_waits_for_the_operation_in_progress(world: World) -> None:
    world.stand("UPDATE_IN_PROGRESS")
    world.cloud.script = [
        ("UPDATE_IN_PROGRESS", []),
        ("UPDATE_COMPLETE_CLEANUP_IN_PROGRESS", []),
        ("UPDATE_COMPLETE", []),
    ]
    made(world).attach()
    assert world.cloud.stack["StackStatus"] == "UPDATE_COMPLETE"


def test_a_failed_deletion_reports_its_reason(world: World) -> None:
    world.stand()
    reason = "The VPC 'vpc-1' has dependencies and cannot be deleted."
    world.cloud.operations = [
        [("DELETE_IN_PROGRESS", [("Vpc", "AWS::EC2::VPC", "DELETE_FAILED", reason)]), ("DELETE_FAILED", [])]
    ]
    with pytest.raises(Problem, match="could not be deleted") as caught:
        made(world).delete()
    assert any(reason in line for line in caught.value.details)


def test_deleting_a_missing_stack_does_nothing(world: World) -> None:
    made(world).delete()
    assert not world.cloud.called("delete_stack")


def test_a_refusal_is_not_taken_for_a_missing_stack(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(**_: Any) -> None:
        raise ClientError({"Error": {"Code": "AccessDenied", "Message": "no"}}, "DescribeStacks")

    monkeypatch.setattr(world.cloud, "describe_stacks", denied)
    with pytest.raises(ClientError):
        made(world).describe()


@pytest.mark.parametrize(
    ("reason", "word"),
    [
        ("The maximum number of VPCs has been reached. (Service: Ec2)", "--vpc"),
        ("The AWS Access Key Id needs a subscription for the service (Service: Ecs)", "not activated this account"),
        ("Your account is not signed up for the S3 service. You must sign up before you can use S3.", "sign-up"),
        ("API: ecs:CreateCluster You are not authorized to perform: ecs:CreateCluster", "permission"),
        ("The domain name you provided already exists.", "--site"),
        ("[Tried to create resource record set [name='study.x.', type='A'] but it already exists]", "--site"),
        ("Unable to assume the service linked role.", "in a minute"),
        ("Specified ReservedConcurrentExecutions … decreases UnreservedConcurrentExecution below its minimum", "1,000"),
        ("LimitExceededException: too many roles", "Service Quotas"),
        ("Rate exceeded", "again"),
        (
            "Unable to complete operation due to concurrent modification. (ConflictException)",
            "two parts were made at once",
        ),
        ("Unable to complete operation due to concurrent modification. Please try again later.", "same command again"),
        ("hippodrome-sweep already exists in stack arn:…", "--stack"),
        ("Something nobody has seen before", "run the same command again"),
    ],
)
def test_known_causes_have_their_advice(reason: str, word: str) -> None:
    failure = stacks.FailedResource("Thing", "AWS::X::Y", "", reason)
    assert word in stacks.advice([failure])


# -- the template ------------------------------------------------------------------------------------------------------


def test_the_template_gets_the_keys_of_the_zips() -> None:
    functions = [function("sweep"), function("next_step", b"other\n")]
    text = Template(TEMPLATE).with_code(functions).text
    for one in functions:
        assert f"S3Key: {one.key}" in text
    assert "S3Key: sweep.zip" not in text
    assert text.replace(functions[0].key, "sweep.zip").replace(functions[1].key, "next_step.zip") == TEMPLATE


def test_a_function_without_a_file_is_reported_in_a_sentence() -> None:
    with pytest.raises(Problem, match="next_step"):
        Template(TEMPLATE).with_code([function("sweep")])


def test_conditions_decide_which_resources_there_are(world: World) -> None:
    template = Template(TEMPLATE)
    assert {"Vpc", "EitherThing"} <= set(template.resources(world.parameters()))
    assert not {"Mail", "BothThings"} & set(template.resources(world.parameters()))
    with_mail = set(template.resources(world.parameters(AlarmEmail="a@b.c")))
    assert {"Vpc", "Mail", "BothThings", "EitherThing"} <= with_mail
    assert "Vpc" not in template.resources(world.parameters(VpcId="vpc-1"))


def test_our_template_can_be_read() -> None:
    template = Template.read(PATH)
    handlers = {path.stem for path in (PATH.parent.parent / "lambdas").glob("*.py") if path.stem != "__init__"}
    assert template.functions == handlers
    assert set(template.function_names().values()) == handlers
    assert template.defaults["SiteHost"] == "study"
    assert template.defaults["RootDomain"] == ""
    assert template.defaults["CodeBucket"] is None
    bucket = template.body["Resources"]["Bucket"]
    assert bucket["DeletionPolicy"] == "Retain"


@pytest.mark.parametrize("text", ["", "a: [", "Resources", "just: this"])
def test_an_invalid_template_is_reported_in_a_sentence(text: str) -> None:
    with pytest.raises(Problem):
        assert Template(text).body


# -- the zone ----------------------------------------------------------------------------------------------------------


def test_the_zone_is_that_of_the_domain_or_of_a_parent(world: World) -> None:
    assert zones.find_zone(world.account, "example.org").id == world.zone
    assert zones.find_zone(world.account, "lab.dept.example.org").id == world.zone
    nearer = world.make_zone("dept.example.org")
    assert zones.find_zone(world.account, "lab.dept.example.org").id == nearer


def test_a_domain_needs_exactly_one_public_zone(world: World) -> None:
    with pytest.raises(Problem, match=r"no public hosted zone for nowhere\.org") as caught:
        zones.find_zone(world.account, "nowhere.org")
    assert "example.org" in caught.value.advice
    world.make_zone("secret.org", private=True)
    with pytest.raises(Problem, match="only a private one"):
        zones.find_zone(world.account, "secret.org")
    world.make_zone("example.org")
    with pytest.raises(Problem, match="2 public hosted zones") as caught:
        zones.find_zone(world.account, "example.org")
    assert "--zone" in caught.value.advice


@pytest.mark.parametrize(
    "domain", ["", "localhost", "a..b", "-a.org", "https://example.org", "exa mple.org", "x" * 250]
)
def test_invalid_domains_are_refused(domain: str) -> None:
    with pytest.raises(Problem, match="is not a domain"):
        zones.clean_domain(domain)


def test_domains_are_normalized() -> None:
    assert zones.clean_domain(" Example.ORG. ") == "example.org"


@pytest.mark.parametrize("zone", ["", "/hostedzone/Z123", "z123456", "Z0000000000000"])
def test_invalid_zone_ids_are_refused(world: World, zone: str) -> None:
    with pytest.raises(Problem):
        zones.read_zone(world.account, zone)


def test_the_record_of_a_name_is_found(world: World) -> None:
    zone = zones.read_zone(world.account, world.zone)
    assert zones.record_in(world.account, zone, "study.example.org") is None
    change = {
        "Action": "CREATE",
        "ResourceRecordSet": {
            "Name": "study.example.org",
            "Type": "CNAME",
            "TTL": 60,
            "ResourceRecords": [{"Value": "else.where"}],
        },
    }
    batch = {"Changes": [change]}
    world.account.client("route53").change_resource_record_sets(HostedZoneId=world.zone, ChangeBatch=batch)
    assert zones.record_in(world.account, zone, "study.example.org")["Type"] == "CNAME"
    assert zones.record_in(world.account, zone, "stud.example.org") is None


def test_delegation_is_read_from_a_name_server(dns: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zones, "DNS_TIMEOUT", 60.0)
    right = zones.Zone("Z1", "example.org", ("ns-1.awsdns-1.com", "ns-2.awsdns-2.net"))
    dns({"example.org.": ["NS-1.awsdns-1.com.", "ns-2.awsdns-2.net."]})
    assert zones.delegation(right) == zones.Delegation(("ns-1.awsdns-1.com", "ns-2.awsdns-2.net"))
    dns({"example.org.": ["ns.registrar.com."]})
    assert "other name servers: ns.registrar.com" in zones.delegation(right).problem
    dns({})
    found = zones.delegation(right)
    assert "knows no name servers" in found.problem
    assert found.certain
    dns(None)
    monkeypatch.setattr(zones, "DNS_TIMEOUT", 0.2)
    found = zones.delegation(right)
    assert "could not be asked" in found.problem
    assert not found.certain


@pytest.fixture
def dns(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Starts a real name server on loopback that answers NS queries; with None, one that never answers."""
    import socket
    import threading

    import dns.message
    import dns.rcode
    import dns.resolver
    import dns.rrset

    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.bind(("127.0.0.1", 0))
    answers: dict[str, Any] = {"now": {}}

    def serve() -> None:
        while True:
            try:
                query, client = server.recvfrom(4096)
            except OSError:
                return
            if not query:
                return
            if answers["now"] is None:
                continue
            asked = dns.message.from_wire(query)
            reply = dns.message.make_response(asked)
            name = asked.question[0].name
            found = answers["now"].get(name.to_text())
            if found:
                reply.answer.append(dns.rrset.from_text(name, 60, "IN", "NS", *found))
            else:
                reply.set_rcode(dns.rcode.NXDOMAIN)
            server.sendto(reply.to_wire(), client)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    real = dns.resolver.Resolver

    def resolver(configure: bool = True) -> Any:
        made = real(configure=False)
        made.nameservers = ["127.0.0.1"]
        made.port = server.getsockname()[1]
        return made

    monkeypatch.setattr(dns.resolver, "Resolver", resolver)
    yield lambda now: answers.__setitem__("now", now)
    port = server.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as waker:
        waker.sendto(b"", ("127.0.0.1", port))
    thread.join(5)
    server.close()


# -- the settings ------------------------------------------------------------------------------------------------------


def decide(world: World, settings: StackSettings, previous: dict[str, str] | None = None) -> dict[str, str]:
    return settings.parameters(world.account, Template(TEMPLATE).defaults, previous or {}, world.code_bucket)


def test_the_first_settings_have_the_defaults(world: World) -> None:
    assert decide(world, StackSettings(domain="Example.org.", max_runtime=60)) == world.parameters(MaxRuntime="60")


def test_the_name_of_the_site_must_fit_a_certificate(world: World) -> None:
    """ACM: the first name of a certificate has at most 64 characters."""
    domain = f"{'x' * 50}.example"
    world.make_zone(domain)
    assert decide(world, StackSettings(domain=domain, site="study"))["SiteHost"] == "study"
    with pytest.raises(Problem, match="65 characters") as caught:
        decide(world, StackSettings(domain=domain, site="studie"))
    assert "--site" in caught.value.advice


def chosen(world: World, previous: dict[str, str] | None = None, **asked: Any) -> dict[str, str]:
    """Return the availability zones that the settings choose, with a template that has them as parameters."""
    defaults = Template(TEMPLATE).defaults | {"ZoneA": None, "ZoneB": None}
    subnets = asked.pop("standing", ())
    settings = StackSettings(domain="example.org", **asked)
    found = settings.parameters(world.account, defaults, previous or {}, world.code_bucket, subnets)
    return {name: found[name] for name in ("ZoneA", "ZoneB")}


def test_two_zones_with_fargate_are_chosen(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen(world) == {"ZoneA": "ca-central-1a", "ZoneB": "ca-central-1b"}
    offered = [
        {"ZoneName": f"ca-central-1{letter}", "ZoneId": f"cac1-az{number}", "State": "available"} | more
        for letter, number, more in [
            ("d", 1, {}),
            ("c", 4, {}),  # a zone without Fargate
            ("b", 2, {}),
            ("a", 1, {"State": "impaired"}),
            ("a-x-1a", 2, {"ZoneType": "local-zone"}),
        ]
    ]
    client = world.account.client("ec2")
    monkeypatch.setattr(client, "describe_availability_zones", lambda: {"AvailabilityZones": offered})
    assert chosen(world) == {"ZoneA": "ca-central-1b", "ZoneB": "ca-central-1d"}
    del offered[0]
    with pytest.raises(Problem, match="no two availability zones"):
        chosen(world)


def test_zones_stay_as_they_are(world: World) -> None:
    """CloudFormation would create the moved subnet beside the old one, with the same address range."""
    stood = {"ZoneA": "ca-central-1d", "ZoneB": "ca-central-1a"}
    assert chosen(world, stood) == stood


def test_an_earlier_installation_keeps_the_zones_of_its_subnets(world: World) -> None:
    ec2 = world.account.client("ec2")
    vpc = ec2.create_vpc(CidrBlock="10.0.0.0/16")["Vpc"]["VpcId"]
    made = [
        ec2.create_subnet(VpcId=vpc, CidrBlock=f"10.0.{n}.0/24", AvailabilityZone=f"ca-central-1{letter}")
        for n, letter in enumerate("db")
    ]
    standing = [one["Subnet"]["SubnetId"] for one in made]
    assert chosen(world, world.parameters(), standing=standing) == {"ZoneA": "ca-central-1d", "ZoneB": "ca-central-1b"}
    gone = ["subnet-0123456789abcdef0"]
    assert chosen(world, world.parameters(), standing=gone) == {"ZoneA": "ca-central-1a", "ZoneB": "ca-central-1b"}


def test_an_own_network_needs_no_zones(world: World) -> None:
    theirs = {"vpc": "vpc-1", "subnets": "subnet-1,subnet-2"}
    assert chosen(world, **theirs) == {"ZoneA": "", "ZoneB": ""}
    stood = {"ZoneA": "ca-central-1d", "ZoneB": "ca-central-1a"}
    assert chosen(world, stood, **theirs) == stood


def test_settings_that_are_left_out_stay(world: World) -> None:
    before = world.parameters(SiteHost="lab", MaxRuntime="30", AlarmEmail="a@b.c")
    assert decide(world, StackSettings(), before) == before
    assert decide(world, StackSettings(email=""), before)["AlarmEmail"] == ""
    assert decide(world, StackSettings(max_runtime=45), before)["MaxRuntime"] == "45"


def test_servers_listen_on_443_by_default_and_may_listen_on_5000() -> None:
    assert Template.read().defaults["ServerPort"] == "443"
    given = {"RootDomain": "example.org", "HostedZoneId": "Z1", "CodeBucket": "code"}
    taken = {name: value or "" for name, value in Template.read().defaults.items()} | given
    assert [*Template.read().refused({**taken, "ServerPort": "80"})] == [("ServerPort", "must be one of 443, 5000")]
    assert option("ServerPort") == "--port"


def test_front_ends_without_tokens_are_refused_by_default() -> None:
    assert Template.read().defaults["PlainClients"] == "refused"


def test_values_that_the_template_refuses_are_reported_with_their_options() -> None:
    given = {"RootDomain": "example.org", "HostedZoneId": "Z1", "CodeBucket": "code"}
    taken = {name: value or "" for name, value in Template.read().defaults.items()} | given
    values = {name: value or "" for name, value in taken.items()}
    assert [*Template.read().refused(values)] == []
    wrong = {
        "AlarmEmail": "me",
        "SiteHost": "a b",
        "LogRetentionDays": "2",
        "ServerNames": "id",
        "PlainClients": "yes",
        "VpcId": "mine",
    }
    found = dict(Template.read().refused({**values, **wrong}))
    assert set(found) == set(wrong)
    assert found["AlarmEmail"] == "must be an e-mail address, or empty"
    assert "1, 3, 5" in found["LogRetentionDays"]
    assert [*map(option, wrong)] == ["--email", "--site", "--log-days", "--server-names", "--plain-clients", "--vpc"]


def test_parameters_that_the_template_no_longer_has_are_dropped(world: World) -> None:
    assert "Old" not in decide(world, StackSettings(), world.parameters(Old="1"))


def test_an_installation_needs_no_domain_and_may_give_it_up(world: World) -> None:
    without = {"RootDomain": "", "HostedZoneId": ""}
    assert decide(world, StackSettings()).items() >= without.items()
    assert decide(world, StackSettings(), world.parameters())["RootDomain"] == "example.org", "it stays"
    assert decide(world, StackSettings(domain=""), world.parameters()).items() >= without.items()
    with pytest.raises(Problem, match="--zone is the zone of a domain"):
        decide(world, StackSettings(zone=world.zone))


def test_the_same_domain_keeps_its_zone_without_a_request(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hippodrome.deployment.stack.settings.find_zone", lambda *_: pytest.fail("looked"))
    assert decide(world, StackSettings(domain="example.org"), world.parameters())["HostedZoneId"] == world.zone


def test_the_zone_can_be_named_by_its_id(world: World) -> None:
    second = world.make_zone("example.org")
    assert decide(world, StackSettings(domain="example.org", zone=second))["HostedZoneId"] == second
    other = world.make_zone("elsewhere.org")
    with pytest.raises(Problem, match="not below"):
        decide(world, StackSettings(domain="example.org", zone=other))
    with pytest.raises(Problem, match="not below"):
        decide(world, StackSettings(domain="notelsewhere.org", zone=other))


@pytest.mark.parametrize("settings", [StackSettings(vpc="vpc-1"), StackSettings(subnets="subnet-1,subnet-2")])
def test_vpc_and_subnets_go_together(world: World, settings: StackSettings) -> None:
    with pytest.raises(Problem, match="go together"):
        decide(world, settings, world.parameters())


def test_subnets_are_normalized(world: World) -> None:
    found = decide(world, StackSettings(vpc="vpc-1", subnets=" subnet-1 , subnet-2,"), world.parameters())
    assert found["SubnetIds"] == "subnet-1,subnet-2"


# -- the code bucket ---------------------------------------------------------------------------------------------------


def test_the_bucket_is_made_private_and_encrypted(world: World) -> None:
    bucket = CodeBucket(world.account, "hippodrome")
    assert not bucket.exists()
    assert bucket.make()
    assert not bucket.make()
    assert bucket.name == world.code_bucket
    s3 = world.account.client("s3")
    block = s3.get_public_access_block(Bucket=bucket.name)["PublicAccessBlockConfiguration"]
    assert all(block.values())
    assert len(block) == 4
    rules = s3.get_bucket_encryption(Bucket=bucket.name)["ServerSideEncryptionConfiguration"]["Rules"]
    assert rules[0]["ApplyServerSideEncryptionByDefault"]["SSEAlgorithm"] == "AES256"
    policy = json.loads(s3.get_bucket_policy(Bucket=bucket.name)["Policy"])
    assert policy["Statement"][0]["Condition"] == {"Bool": {"aws:SecureTransport": "false"}}
    assert s3.get_bucket_location(Bucket=bucket.name)["LocationConstraint"] == REGION


def test_an_unfinished_bucket_is_finished(world: World) -> None:
    s3 = world.account.client("s3")
    s3.create_bucket(Bucket=world.code_bucket, CreateBucketConfiguration={"LocationConstraint": REGION})
    assert CodeBucket(world.account, "hippodrome").make()
    assert s3.get_bucket_tagging(Bucket=world.code_bucket)["TagSet"] == [
        {"Key": "hippodrome:stack", "Value": "hippodrome"}
    ]


@contextlib.contextmanager
def listening(world: World, event: str, handler: Any) -> Iterator[None]:
    events = world.account.client("s3").meta.events
    events.register(event, handler)
    try:
        yield
    finally:
        events.unregister(event, handler)


def test_a_bucket_of_another_account_is_refused(world: World) -> None:
    """Gap: moto does not compare ExpectedBucketOwner. S3 answers 403 to HeadBucket then."""
    bucket = CodeBucket(world.account, "hippodrome")

    def forbidden(request: Any, **_: Any) -> AWSResponse:
        assert request.headers["x-amz-expected-bucket-owner"] in {ACCOUNT, ACCOUNT.encode()}
        return AWSResponse(request.url, 403, {}, MockRawResponse(b""))

    with listening(world, "before-send.s3.HeadBucket", forbidden):
        with pytest.raises(Problem, match="belongs to another account"):
            bucket.exists()
        with pytest.raises(Problem, match="belongs to another account"):
            bucket.make()


def test_a_bucket_name_that_was_just_taken_is_refused(world: World) -> None:
    bucket = CodeBucket(world.account, "hippodrome")

    def taken(params: Any, **_: Any) -> None:
        raise ClientError({"Error": {"Code": "BucketAlreadyExists", "Message": ""}}, "CreateBucket")

    with (
        listening(world, "provide-client-params.s3.CreateBucket", taken),
        pytest.raises(Problem, match="belongs to another account"),
    ):
        bucket.make()


def test_every_request_names_the_owner(world: World) -> None:
    bucket = CodeBucket(world.account, "hippodrome")
    bucket.make()
    seen: list[dict[str, Any]] = []
    with listening(world, "provide-client-params.s3", lambda params, **_: seen.append(params)):
        bucket.upload([function("sweep")])
        bucket.put_template("text")
    assert seen
    assert all(one["ExpectedBucketOwner"] == ACCOUNT for one in seen)


def test_only_missing_zips_are_uploaded(world: World) -> None:
    bucket = CodeBucket(world.account, "hippodrome")
    bucket.make()
    assert bucket.upload([function("sweep"), function("next_step")]) == 2
    assert bucket.upload([function("sweep"), function("next_step")]) == 0
    assert bucket.upload([function("sweep", b"new\n"), function("next_step")]) == 1
    s3 = world.account.client("s3")
    body = s3.get_object(Bucket=bucket.name, Key=function("sweep").key)["Body"].read()
    assert body == function("sweep").pack()


def test_an_empty_object_is_uploaded_again(world: World) -> None:
    bucket = CodeBucket(world.account, "hippodrome")
    bucket.make()
    world.account.client("s3").put_object(Bucket=bucket.name, Key=function("sweep").key, Body=b"")
    assert bucket.upload([function("sweep")]) == 1


def test_templates_are_stored_at_an_address_for_cloudformation(world: World) -> None:
    bucket = CodeBucket(world.account, "hippodrome")
    bucket.make()
    url = bucket.put_template(TEMPLATE)
    assert url.startswith(f"https://s3.{REGION}.amazonaws.com/{bucket.name}/templates/")
    assert bucket.put_template(TEMPLATE) == url
