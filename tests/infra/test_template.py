"""The template by itself: well formed, complete, and its parts fit each other and the code."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.aws.bus import TOPICS
from hippodrome.control.model import sessions
from hippodrome.control.model.project import Project
from hippodrome.control.ports import PORTS, Settings
from hippodrome.local.web.gateway import ROUTES
from testing import template as cfn

ROOT = Path(__file__).resolve().parents[2]
OUTPUTS = [
    *(
        "Site",
        "Bucket",
        "HostedZoneId",
        "RootDomain",
        "ServersHost",
        "MaxRuntime",
        "ServerPort",
        "Cluster",
        "Subnets",
        "SecurityGroup",
    ),
    *("StartServerTopic", "StopServerTopic", "TaskQueue", "ScheduleGroup", "ScheduleRole", "Repository"),
    *("TaskExecutionRole", "TrialLogGroup", "RegisterFunction", "ResearcherPolicy"),
    *("Dashboard", "Alarms"),
]


def test_cfn_lint_finds_nothing() -> None:
    done = subprocess.run(
        [Path(sys.executable).with_name("cfn-lint"), cfn.PATH], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stdout


def test_the_template_is_plain_cloudformation() -> None:
    assert "Transform" not in cfn.template()


def test_the_template_has_the_outputs_that_the_commands_read() -> None:
    assert sorted(cfn.template()["Outputs"]) == sorted(OUTPUTS)


def test_the_functions_that_register_and_start_know_whether_front_ends_need_tokens() -> None:
    told = {
        name: one["Properties"]["Environment"]["Variables"]
        for name, one in cfn.template()["Resources"].items()
        if one["Type"] == "AWS::Lambda::Function" and "Environment" in one["Properties"]
    }
    knowing = {name: it["PLAIN_CLIENTS"] for name, it in told.items() if "PLAIN_CLIENTS" in it}
    assert knowing == {name: {"Ref": "PlainClients"} for name in ("StartServer", "UpdateProjectMasterList")}


@pytest.mark.parametrize("function", ["NextStep", "StartServer", "Sweep"])
def test_the_functions_of_the_lobby_give_no_session_a_server_that_has_too_little_time_left(function: str) -> None:
    told = cfn.template()["Resources"][function]["Properties"]["Environment"]["Variables"]
    settings = Settings.from_env(cfn.ReferenceValues(parameters={"MaxRuntime": "120"}).resolve(told))
    study = Project(id="maze", steps=[], max_runtime=110, players=2)
    assert sessions.open_for(study, settings) == timedelta(minutes=10)


def test_every_parameter_says_what_it_is_and_is_checked() -> None:
    shown = [
        p
        for g in cfn.template()["Metadata"]["AWS::CloudFormation::Interface"]["ParameterGroups"]
        for p in g["Parameters"]
    ]
    assert sorted(shown) == sorted(cfn.template()["Parameters"])
    for name, parameter in cfn.template()["Parameters"].items():
        assert parameter["Description"], name
        assert {"AllowedPattern", "AllowedValues", "MinValue"} & set(parameter), name
        assert "AllowedPattern" not in parameter or parameter["ConstraintDescription"], name


@pytest.mark.parametrize(
    ("parameter", "good", "bad"),
    [
        ("RootDomain", "example.org play.lab.example.co.uk xn--bcher-kva.example", "example Example.org .example.org example.org. a..b *.example.org"),
        ("HostedZoneId", "Z0123456789ABCDEFGHIJ", "/hostedzone/Z01 z01"),
        ("SiteHost", "study s a-1", "Study a.b -a a- _a"),
        ("ServersHost", "servers s a-1 " + "s" * 20, "Servers a.b -a a- _a " + "s" * 21),
        ("AlarmEmail", "a@example.org", "a@b a b@example.org,c@example.org"),
        ("VpcId", "vpc-0123456789abcdef0 vpc-01234567", "vpc-x subnet-01234567"),
        ("SubnetIds", "subnet-01234567 subnet-01234567,subnet-0123456789abcdef0", "subnet-01234567, subnet-1 ,subnet-01234567"),
        ("ZoneA", "us-east-1a ca-central-1d us-gov-west-1a", "us-east-1 use1-az1 us-east-1a,us-east-1b"),
        ("ZoneB", "us-east-1a ca-central-1d us-gov-west-1a", "us-east-1 use1-az1 us-east-1a,us-east-1b"),
        ("CodeBucket", "hippodrome-code-123456789012-us-east-1", "A ab_c s3://x"),
    ],
)  # fmt: skip
def test_patterns_of_parameters(parameter: str, good: str, bad: str) -> None:
    pattern = cfn.template()["Parameters"][parameter]["AllowedPattern"]
    assert all(re.fullmatch(pattern, text) for text in good.split())
    assert not any(re.fullmatch(pattern, text) for text in bad.split())


def test_the_longest_name_of_a_server_fits_into_dns() -> None:
    """RFC 1035, 2.3.4: 63 characters between two dots, 253 in all."""
    longest = [int(cfn.template()["Parameters"][name]["MaxLength"]) for name in ("ServersHost", "RootDomain")]
    assert 63 + sum(1 + length for length in longest) <= 253


def test_names_carry_the_stacks_name() -> None:
    """Whatever has a name of its own has the stack's in it, so two installations live in one account."""
    keys = {
        "FunctionName",
        "QueueName",
        "TopicName",
        "LogGroupName",
        "ClusterName",
        "AlarmName",
        "DashboardName",
        "Name",
    }
    for name, one in cfn.template()["Resources"].items():
        for key in keys & set(one.get("Properties", {})):
            value = one["Properties"][key]
            if one["Type"] == "AWS::Route53::RecordSet" or (key == "FunctionName" and value.get("Ref")):
                continue
            assert "AWS::StackName" in json.dumps(value), f"{name}.{key}"
        assert "RoleName" not in one.get("Properties", {}), "would need CAPABILITY_NAMED_IAM"
        assert "BucketName" not in one.get("Properties", {})


# Functions


def test_each_function_runs_the_file_of_its_name() -> None:
    """What else each one needs: `test_functions.py`."""
    for name, logical in cfn.functions().items():
        properties = cfn.resources("AWS::Lambda::Function")[logical]
        assert properties["Handler"] == f"lambdas.{name}.handler"
        assert properties["FunctionName"] == {"Fn::Sub": f"${{AWS::StackName}}-{name}"}
        assert properties["Code"] == {"S3Bucket": {"Ref": "CodeBucket"}, "S3Key": f"{name}.zip"}
        assert (properties["Runtime"], properties["Architectures"]) == ("python3.13", ["arm64"])


def test_every_log_has_a_retention_period() -> None:
    for name, group in cfn.resources("AWS::Logs::LogGroup").items():
        assert group["RetentionInDays"] == {"Ref": "LogRetentionDays"}, name


def test_queues_wait_for_their_functions_and_failures_end_in_dead_letters() -> None:
    functions, queues = cfn.resources("AWS::Lambda::Function"), cfn.resources("AWS::SQS::Queue")
    mappings = cfn.resources("AWS::Lambda::EventSourceMapping")
    assert len(mappings) == 3
    for mapping in mappings.values():
        queue = queues[mapping["EventSourceArn"]["Fn::GetAtt"][0]]
        window = mapping.get("MaximumBatchingWindowInSeconds", 0)
        assert queue["VisibilityTimeout"] > functions[mapping["FunctionName"]["Ref"]]["Timeout"] + window
        assert mapping["FunctionResponseTypes"] == ["ReportBatchItemFailures"]
        assert int(cfn.ReferenceValues().resolve(mapping["ScalingConfig"]["MaximumConcurrency"])) >= 2
        assert mapping["BatchSize"] <= 10 or window >= 1
        assert queue["RedrivePolicy"]["deadLetterTargetArn"]["Fn::GetAtt"][0] in queues
    dead = {
        queue["RedrivePolicy"]["deadLetterTargetArn"]["Fn::GetAtt"][0]
        for queue in queues.values()
        if "RedrivePolicy" in queue
    }
    watched = {a["Dimensions"][0]["Value"]["Fn::GetAtt"][0] for a in alarms("ApproximateNumberOfMessagesVisible")}
    assert watched == dead


def test_only_the_function_that_calls_itself_may_do_so() -> None:
    """Lambda drops the invocation after about 16 of a chain of messages, unless it is told that the loop is meant."""
    allowed = {
        name
        for name, logical in cfn.functions().items()
        if cfn.resources("AWS::Lambda::Function")[logical].get("RecursiveLoop", "Terminate") == "Allow"
    }
    assert allowed == {"task_changed"}


def test_a_message_that_lambda_takes_for_a_loop_raises_an_alarm() -> None:
    """Every function that sends messages to a queue that it or its like read from."""
    watched = {alarm["Dimensions"][0]["Value"]["Ref"] for alarm in alarms("RecursiveInvocationsDropped")}
    fed = {mapping["FunctionName"]["Ref"] for mapping in cfn.resources("AWS::Lambda::EventSourceMapping").values()}
    assert watched == fed
    assert all(alarm["Namespace"] == "AWS/Lambda" for alarm in alarms("RecursiveInvocationsDropped"))


def test_every_alarm_reaches_the_topic_of_alarms() -> None:
    for name, alarm in cfn.resources("AWS::CloudWatch::Alarm").items():
        assert alarm["AlarmActions"] == [{"Ref": "Alarms"}], name
        assert alarm["AlarmDescription"], name


def alarms(metric: str) -> list[dict[str, Any]]:
    return [alarm for alarm in cfn.resources("AWS::CloudWatch::Alarm").values() if alarm["MetricName"] == metric]


def test_messages_come_as_they_were_published() -> None:
    found = [s for s in cfn.resources("AWS::SNS::Subscription").values() if s["Protocol"] == "sqs"]
    assert [s["RawMessageDelivery"] for s in found] == [True, True]
    assert set(TOPICS.values()) == {"START_SERVER_TOPIC_ARN", "STOP_SERVER_TOPIC_ARN"}


# HTTP


def test_the_api_has_the_routes_of_the_local_server_and_one_for_servers() -> None:
    """On one machine, servers write into the data folder."""
    functions = {logical: name for name, logical in cfn.functions().items()}
    integrations = {
        name: functions[i["IntegrationUri"]["Fn::GetAtt"][0]] for name, i in cfn.resources("AWS::ApiGatewayV2::Integration").items()
    }  # fmt: skip
    found = set()
    for route in cfn.resources("AWS::ApiGatewayV2::Route").values():
        target = re.fullmatch(r"integrations/\$\{(\w+)\}", route["Target"]["Fn::Sub"])
        assert target
        found.add((route["RouteKey"], integrations[target[1]]))
    local = {(f"{method} {route.path}", route.function) for route in ROUTES for method in route.methods}
    assert found == local | {("POST /sign", "sign_requests"), ("POST /certificate", "certify_server")}


@pytest.mark.parametrize(("variable", "function"), [("SIGN_URL", "SignRequests"), ("CERTIFICATE_URL", "CertifyServer")])
def test_servers_ask_at_the_apis_own_address_which_no_domain_changes(variable: str, function: str) -> None:
    account = cfn.ReferenceValues()
    start = cfn.template()["Resources"]["StartServer"]["Properties"]["Environment"]["Variables"]
    host, _, path = account.resolve(start)[variable].removeprefix("https://").partition("/")
    assert host == f"{account.ref('Api')}.execute-api.us-east-1.amazonaws.com"
    routes = {r["RouteKey"]: r["Target"] for r in cfn.resources("AWS::ApiGatewayV2::Route").values()}
    assert function in str(routes[f"POST /{path}"])


def test_without_a_domain_the_site_is_the_apis_own_address_and_nothing_needs_a_zone() -> None:
    account = cfn.ReferenceValues(parameters={})
    assert account.resolve(cfn.template()["Outputs"]["Site"]["Value"]) == (
        f"https://{account.ref('Api')}.execute-api.us-east-1.amazonaws.com"
    )
    there = {name: one for name, one in cfn.template()["Resources"].items() if one.get("Condition") != "HasDomain"}
    assert "route53" not in str(account.resolve([one.get("Properties", {}).get("Policies") for one in there.values()]))
    assert not [name for name, one in there.items() if one["Type"].startswith(("AWS::Route53", "AWS::Certificate"))]


def test_access_logs_hold_no_path_no_query_and_no_address() -> None:
    (stage,) = cfn.resources("AWS::ApiGatewayV2::Stage").values()
    form = stage["AccessLogSettings"]["Format"]
    logged = set(re.findall(r"\$context\.([A-Za-z.]+)", form))
    assert logged == {
        "requestTime", "requestId", "routeKey", "status", "responseLength", "responseLatency", "integrationLatency", "protocol",
    }  # fmt: skip
    json.loads(form)
    assert stage["DefaultRouteSettings"]["ThrottlingRateLimit"] == {"Ref": "RequestsPerSecond"}


# Data and network


def test_data_are_private_encrypted_versioned_and_outlive_the_stack() -> None:
    bucket = cfn.template()["Resources"]["Bucket"]
    assert bucket["DeletionPolicy"] == bucket["UpdateReplacePolicy"] == "Retain"
    properties = bucket["Properties"]
    assert set(properties["PublicAccessBlockConfiguration"].values()) == {True}
    assert properties["VersioningConfiguration"] == {"Status": "Enabled"}
    assert properties["BucketEncryption"]
    rules = {rule["Id"]: rule for rule in properties["LifecycleConfiguration"]["Rules"]}
    assert rules["OldVersions"]["NoncurrentVersionExpiration"]
    assert rules["IncompleteUploads"]["AbortIncompleteMultipartUpload"]
    expiring = [rule["Prefix"] for rule in rules.values() if "ExpirationInDays" in rule]
    assert sorted(expiring) == ["_lobby/", "_match/"], "no data expire"
    (policy,) = cfn.resources("AWS::S3::BucketPolicy").values()
    (statement,) = policy["PolicyDocument"]["Statement"]
    assert (statement["Effect"], statement["Condition"]) == ("Deny", {"Bool": {"aws:SecureTransport": "false"}})


def test_servers_are_reached_at_the_games_port_only() -> None:
    (group,) = cfn.resources("AWS::EC2::SecurityGroup").values()
    for parameters, ports in ((cfn.DOMAIN, PORTS), ({}, (*PORTS, 80))):  # 80: the authority asks there
        rules = cfn.ReferenceValues(parameters=parameters).resolve(group["SecurityGroupIngress"])
        assert [(rule["FromPort"], rule["ToPort"]) for rule in rules] == [(port, port) for port in ports]
    parameter = cfn.template()["Parameters"]["ServerPort"]
    assert (parameter["Default"], parameter["AllowedValues"]) == (443, [*PORTS])


def test_servers_reach_out_to_port_443_alone() -> None:
    """Whatever else the network holds: a database, a share, a mail server, other machines' shells."""
    (group,) = cfn.resources("AWS::EC2::SecurityGroup").values()
    ways_out = [(rule["IpProtocol"], rule["FromPort"], rule["ToPort"]) for rule in group["SecurityGroupEgress"]]
    assert ways_out == [("tcp", 443, 443)]
    assert cfn.resources("AWS::EC2::SecurityGroupEgress") == {}


def test_with_the_administrators_network_none_is_made() -> None:
    theirs = cfn.ReferenceValues(parameters={"VpcId": "vpc-01234567", "SubnetIds": "subnet-01234567,subnet-89abcdef"})
    assert not theirs.holds("OwnVpc")
    assert theirs.resolve(cfn.template()["Outputs"]["Subnets"]["Value"]) == "subnet-01234567,subnet-89abcdef"
    (group,) = cfn.resources("AWS::EC2::SecurityGroup").values()
    assert theirs.resolve(group["VpcId"]) == "vpc-01234567"
    kinds = ("VPC", "InternetGateway", "VPCGatewayAttachment", "RouteTable", "Route", "Subnet", "VPCEndpoint")
    kinds += ("SubnetRouteTableAssociation",)
    network = [one for one in cfn.template()["Resources"].values() if one["Type"].removeprefix("AWS::EC2::") in kinds]
    assert len(network) == 10
    assert {one["Condition"] for one in network} == {"OwnVpc"}


@pytest.mark.parametrize("payload", ["running", "spot_warning", "deprovisioning_spot", "stopped_spot"])
def test_only_events_of_our_tasks_reach_the_queue(payload: str) -> None:
    (rule,) = [r for r in cfn.resources("AWS::Events::Rule").values() if "EventPattern" in r]
    pattern = cfn.ReferenceValues().resolve(rule["EventPattern"])
    event = json.loads((ROOT / f"tests/events/sqs_task_{payload}.json").read_text())["Records"][0]
    body = json.loads(event["body"])
    assert body["source"] in pattern["source"]
    assert body["detail-type"] in pattern["detail-type"]
    detail = pattern["detail"]
    assert body["detail"]["lastStatus"] in detail["lastStatus"]
    assert body["detail"]["startedBy"].startswith(detail["startedBy"][0]["prefix"])
    ours, own = detail["clusterArn"]
    assert ours.endswith(":cluster/hippodrome")
    assert own["prefix"].endswith(":cluster/s")
