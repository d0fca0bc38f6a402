"""Python as a newcomer's commands run it on the emulator: `python bridge.py -m deploy …`, with BRIDGE naming a JSON file.

What stands between the commands and the Internet, and is not there:

- Gap: the emulator has no name servers. A name server of the tests says what the Internet's would.
- Gap: Let's Encrypt is two Pebbles, one for its staging authority and one for the real one, and its challenges are told
  to Pebble's own DNS as well.
- Gap: the site's address leads to the emulator's gateway by its Host header alone.
- Gap: the emulator has no quotas. A new account's are answered: 6 vCPUs of Fargate, 10 executions of Lambda, one build.
- Gap: ECR's findings about an image are unknown to the emulator. There are none.
- No Docker: the image is built "at AWS", whatever runs on the machine of the tests.
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

TOLD = json.loads(Path(os.environ["BRIDGE"]).read_text())
EXECUTIONS = 10


def certificates() -> None:
    from hippodrome.certificates import rules as certificate

    certificate.STAGING, certificate.PRODUCTION = TOLD["staging"], TOLD["production"]  # before anybody imports them
    from hippodrome.aws.challenges import Route53Challenges
    from hippodrome.certificates import renewal

    order, put = renewal.Renewal.obtain, Route53Challenges.put

    def obtain(self: Any, wish: Any) -> Any:
        return order(self, renewal.RenewalRequest(**{**vars(wish), "trusted": TOLD["trusted"][wish.directory]}))

    def published(self: Any, name: str, values: Sequence[str], seconds: float) -> None:
        put(self, name, values, seconds)
        for management in TOLD["dns"]:
            for value in values:
                said = json.dumps({"host": f"{name}.", "value": value}).encode()
                urllib.request.urlopen(urllib.request.Request(f"{management}/set-txt", said), timeout=10).read()

    renewal.Renewal.obtain = obtain  # type: ignore[method-assign]
    Route53Challenges.put = published  # type: ignore[method-assign]


def internet() -> None:
    import dns.resolver

    from deploy.operate.doctor import addresses

    class Resolver(dns.resolver.Resolver):
        def __init__(self, *_: object, **__: object) -> None:
            super().__init__(configure=False)
            self.nameservers, self.port = ["127.0.0.1"], TOLD["nameserver"]

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
    import botocore.handlers
    from botocore.awsrequest import AWSResponse

    from deploy.aws import quotas
    from deploy.study.image import docker

    new = {quotas.SPOT: 6.0, quotas.ON_DEMAND: 6.0, quotas.BUILDS: 1.0, quotas.VPCS: 5.0}
    quotas.applied = lambda account, quota: new[quota]
    docker.available = lambda: False

    def settings(parsed: dict[str, Any], **_: Any) -> None:
        parsed["AccountLimit"] |= {"ConcurrentExecutions": EXECUTIONS, "UnreservedConcurrentExecutions": EXECUTIONS}

    def findings(params: Any, **_: Any) -> Any:
        answer = {"imageScanStatus": {"status": "COMPLETE"}, "imageScanFindings": {"findingSeverityCounts": {}}}
        return AWSResponse(params["url"], 200, {}, None), {**answer, "ResponseMetadata": {"HTTPStatusCode": 200}}

    botocore.handlers.BUILTIN_HANDLERS += [
        ("after-call.lambda.GetAccountSettings", settings),
        ("before-call.ecr.DescribeImageScanFindings", findings),
    ]


if __name__ == "__main__":
    sys.path[0] = os.getcwd()  # as `python -m` has it
    if sys.argv[1:3] == ["-m", "deploy"]:
        certificates()
        internet()
        account()
    if sys.argv[1] == "-m":
        module = sys.argv[2]
        del sys.argv[:2]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    else:
        os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
