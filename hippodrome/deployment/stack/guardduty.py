"""Removes what GuardDuty's Runtime Monitoring has put into the stack's own VPC, which would block its deletion.

With automated configuration GuardDuty makes an endpoint `com.amazonaws.<region>.guardduty-data` and a security group
`GuardDutyManagedSecurityGroup-<vpc>` in every VPC with tasks, and leaves both (GuardDuty User Guide, "Clean up Runtime
Monitoring resources"; hashicorp/terraform-provider-aws issue 46747). The administrator's own VPC is left alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hippodrome.console import screen

SERVICE = "guardduty-data"
GROUP = "GuardDutyManagedSecurityGroup-*"


def remove_endpoints(client: Any, vpcs: Sequence[str]) -> None:
    """Delete GuardDuty's endpoints in these VPCs. Their interfaces go some minutes later."""
    for vpc in vpcs:
        pages = client.get_paginator("describe_vpc_endpoints").paginate(Filters=[{"Name": "vpc-id", "Values": [vpc]}])
        endpoints = [
            endpoint["VpcEndpointId"]
            for page in pages
            for endpoint in page["VpcEndpoints"]
            if endpoint["ServiceName"].endswith(f".{SERVICE}")
            and endpoint["State"].lower() not in ("deleting", "deleted")
        ]
        if endpoints:
            client.delete_vpc_endpoints(VpcEndpointIds=endpoints)
            screen.info(f"GuardDuty's endpoint in the installation's network is deleted: {', '.join(endpoints)}.")


def remove_groups(client: Any, vpcs: Sequence[str]) -> None:
    """Delete GuardDuty's security groups in these VPCs, once nothing uses them."""
    for vpc in vpcs:
        filters = [{"Name": "vpc-id", "Values": [vpc]}, {"Name": "group-name", "Values": [GROUP]}]
        for group in client.describe_security_groups(Filters=filters)["SecurityGroups"]:
            client.delete_security_group(GroupId=group["GroupId"])
