"""Runs a command of a new user's first hour on the emulator: `python bridge.py -m deploy …`.

The environment variable BRIDGE names a JSON file with the addresses of the tests' name server and certificate
authorities. These bridges take the place of the Internet and of parts of AWS that the emulator lacks:

- Gap: the emulator has no name servers. Bridge: a name server of the tests answers.
- Gap: Let's Encrypt is not reachable. Bridge: one Pebble for its staging authority and another for the real one; the DNS
  challenges are also given to Pebble's own DNS servers.
- Gap: the site's domain name leads nowhere. Bridge: requests go to the emulator's gateway, with the domain name as Host
  header.
- Gap: the emulator has no quotas. Bridge: those of a new account: 6 vCPUs of Fargate, 10 executions of Lambda, 5 VPCs.
- Gap: the emulator does not know VPC Block Public Access. Bridge: it is off.
- Gap: the emulator has no scan findings of ECR images. Bridge: a complete scan without findings.
- `images.py` puts images into the emulator's ECR.
"""

from __future__ import annotations

import json
import os
import runpy
import ssl
import sys
import urllib.request
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SETTINGS = json.loads(Path(os.environ["BRIDGE"]).read_text())
EXECUTIONS = 10


def certificates() -> None:
    """Put Pebble in the place of Let's Encrypt's authorities, and its DNS beside the zone."""
    from hippodrome.control.certificates import rules as certificate

    # Changed here, before any module imports them.
    certificate.STAGING, certificate.PRODUCTION = SETTINGS["staging"], SETTINGS["production"]
    from hippodrome.control.aws.challenges import Route53Challenges
    from hippodrome.control.certificates import renewal

    order, put = renewal.Renewal.obtain, Route53Challenges.put

    def obtain(self: Any, wish: Any) -> Any:
        return order(self, certificate.RenewalRequest(**{**vars(wish), "trusted": SETTINGS["trusted"][wish.directory]}))

    def published(self: Any, name: str, values: Sequence[str], seconds: float) -> None:
        put(self, name, values, seconds)
        for management in SETTINGS["dns"]:
            for value in values:
                record = json.dumps({"host": f"{name}.", "value": value}).encode()
                urllib.request.urlopen(urllib.request.Request(f"{management}/set-txt", record), timeout=10).read()

    renewal.Renewal.obtain = obtain  # type: ignore[method-assign]
    Route53Challenges.put = published  # type: ignore[method-assign]


def internet() -> None:
    """Put the tests' name server in the place of the Internet's DNS, and the emulator in that of the site."""
    import dns.resolver

    from hippodrome.deployment.operate.doctor import addresses

    class Resolver(dns.resolver.Resolver):
        def __init__(self, *_: object, **__: object) -> None:
            super().__init__(configure=False)
            self.nameservers, self.port = ["127.0.0.1"], SETTINGS["nameserver"]

    dns.resolver.Resolver = Resolver  # type: ignore[misc]

    def fetch(address: str) -> int:
        host, _, path = address.removeprefix("https://").partition("/")
        request = urllib.request.Request(f"{os.environ['AWS_ENDPOINT_URL']}/{path}", headers={"Host": host})
        context = ssl.create_default_context(cafile=os.environ["AWS_CA_BUNDLE"])
        try:
            with urllib.request.urlopen(request, context=context, timeout=30) as answer:
                return int(answer.status)
        except urllib.error.HTTPError as error:
            return error.code

    addresses.fetch = fetch


def account() -> None:
    """Give the account the quotas of a new account, and images without findings."""
    import botocore.handlers
    from botocore.awsrequest import AWSResponse

    from hippodrome.deployment.aws import quotas

    new = {quotas.SPOT: 6.0, quotas.ON_DEMAND: 6.0, quotas.VPCS: 5.0}
    quotas.applied = lambda account, quota: new[quota]

    def settings(parsed: dict[str, Any], **_: Any) -> None:
        parsed["AccountLimit"] |= {"ConcurrentExecutions": EXECUTIONS, "UnreservedConcurrentExecutions": EXECUTIONS}

    def findings(params: Any, **_: Any) -> Any:
        answer = {"imageScanStatus": {"status": "COMPLETE"}, "imageScanFindings": {"findingSeverityCounts": {}}}
        return AWSResponse(params["url"], 200, {}, None), {**answer, "ResponseMetadata": {"HTTPStatusCode": 200}}

    def networks(params: Any, **_: Any) -> Any:
        answer = {"VpcBlockPublicAccessOptions": {"InternetGatewayBlockMode": "off"}}
        return AWSResponse(params["url"], 200, {}, None), {**answer, "ResponseMetadata": {"HTTPStatusCode": 200}}

    botocore.handlers.BUILTIN_HANDLERS += [
        ("before-call.ec2.DescribeVpcBlockPublicAccessOptions", networks),
        ("after-call.lambda.GetAccountSettings", settings),
        ("before-call.ecr.DescribeImageScanFindings", findings),
    ]


if __name__ == "__main__":
    sys.path[0] = os.getcwd()  # as with `python -m`
    if sys.argv[1:3] == ["-m", "hippodrome"]:
        certificates()
        internet()
        account()
        runpy.run_path(str(Path(__file__).with_name("images.py")))
    if sys.argv[1] == "-m":
        module = sys.argv[2]
        del sys.argv[:2]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    else:
        os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
