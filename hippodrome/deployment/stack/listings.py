"""A table of resource types: how AWS lists them, what one costs a month unused, and how to remove one by hand."""

from __future__ import annotations

import shlex
from typing import NamedTuple

from hippodrome.deployment.cost import prices


class Listing(NamedTuple):
    """A kind of resource: how AWS lists all of them, what one costs a month, and how to remove one by hand."""

    kind: str
    service: str
    operation: str
    path: str  # the key of the list in the answer, and of the id in each item
    remove: str  # the AWS CLI's command and option that remove one
    cost: str = "nothing"  # what one unused resource costs a month

    def removal(self, name: str, region: str) -> str:
        """Return the AWS CLI command that removes the resource of this name."""
        return f"aws {self.service} {self.remove} {shlex.quote(name)} --region {region}"


_COSTS = {
    "alarm": f"${prices.ALARM_MONTH:.2f}",
    "dashboard": f"${prices.DASHBOARD_MONTH:.2f}",
    "image repository": f"${prices.ECR_GB_MONTH:.2f} a GB",
    "log group": f"${prices.LOG_GB_MONTH:.2f} a GB",
    "S3 bucket": f"${prices.S3_GB_MONTH:.2f} a GB",
}

# type | kind | service
#     operation that lists them | where its answer has the ids | AWS CLI command that removes one
_TABLE = """
AWS::ApiGatewayV2::Api | HTTP API | apigatewayv2
    get_apis | Items.ApiId | delete-api --api-id
AWS::ApiGatewayV2::DomainName | API address | apigatewayv2
    get_domain_names | Items.DomainName | delete-domain-name --domain-name
AWS::Budgets::Budget | budget | budgets
    describe_budgets | Budgets.BudgetName | delete-budget --budget-name
AWS::CertificateManager::Certificate | certificate | acm
    list_certificates | CertificateSummaryList.CertificateArn | delete-certificate --certificate-arn
AWS::CloudWatch::Alarm | alarm | cloudwatch
    describe_alarms | MetricAlarms.AlarmName | delete-alarms --alarm-names
AWS::CloudWatch::Dashboard | dashboard | cloudwatch
    list_dashboards | DashboardEntries.DashboardName | delete-dashboards --dashboard-names
AWS::EC2::InternetGateway | internet gateway | ec2
    describe_internet_gateways | InternetGateways.InternetGatewayId | delete-internet-gateway --internet-gateway-id
AWS::EC2::RouteTable | route table | ec2
    describe_route_tables | RouteTables.RouteTableId | delete-route-table --route-table-id
AWS::EC2::SecurityGroup | security group | ec2
    describe_security_groups | SecurityGroups.GroupId | delete-security-group --group-id
AWS::EC2::Subnet | subnet | ec2
    describe_subnets | Subnets.SubnetId | delete-subnet --subnet-id
AWS::EC2::VPC | VPC | ec2
    describe_vpcs | Vpcs.VpcId | delete-vpc --vpc-id
AWS::EC2::VPCEndpoint | VPC endpoint | ec2
    describe_vpc_endpoints | VpcEndpoints.VpcEndpointId | delete-vpc-endpoints --vpc-endpoint-ids
AWS::ECR::Repository | image repository | ecr
    describe_repositories | repositories.repositoryName | delete-repository --force --repository-name
AWS::ECS::Cluster | ECS cluster | ecs
    list_clusters | clusterArns | delete-cluster --cluster
AWS::Events::Rule | event rule | events
    list_rules | Rules.Name | delete-rule --name
AWS::IAM::ManagedPolicy | IAM policy | iam
    list_policies | Policies.Arn | delete-policy --policy-arn
AWS::IAM::Role | IAM role | iam
    list_roles | Roles.RoleName | delete-role --role-name
AWS::Lambda::EventSourceMapping | event source mapping | lambda
    list_event_source_mappings | EventSourceMappings.UUID | delete-event-source-mapping --uuid
AWS::Lambda::Function | function | lambda
    list_functions | Functions.FunctionName | delete-function --function-name
AWS::Logs::LogGroup | log group | logs
    describe_log_groups | logGroups.logGroupName | delete-log-group --log-group-name
AWS::S3::Bucket | S3 bucket | s3api
    list_buckets | Buckets.Name | delete-bucket --bucket
AWS::SNS::Topic | topic | sns
    list_topics | Topics.TopicArn | delete-topic --topic-arn
AWS::SQS::Queue | queue | sqs
    list_queues | QueueUrls | delete-queue --queue-url
AWS::Scheduler::ScheduleGroup | schedule group | scheduler
    list_schedule_groups | ScheduleGroups.Name | delete-schedule-group --name
AWS::ECS::TaskDefinition | ECS task definition | ecs
    list_task_definitions | taskDefinitionArns | deregister-task-definition --task-definition
"""


def _read(table: str) -> dict[str, Listing]:
    listings, lines = {}, table.strip().splitlines()
    for first, second in zip(lines[::2], lines[1::2], strict=True):
        type_, kind, service = first.split(" | ")
        operation, path, remove = second.strip().split(" | ")
        listings[type_] = Listing(kind, service, operation, path, remove, _COSTS.get(kind, "nothing"))
    return listings


_ALL = _read(_TABLE)
BY_KIND = {listing.kind: listing for listing in _ALL.values()}
LISTINGS = {type_: one for type_, one in _ALL.items() if type_ != "AWS::ECS::TaskDefinition"}  # `register` makes those
KEY_TYPES = ("RSA_1024", "RSA_2048", "RSA_3072", "RSA_4096", "EC_prime256v1", "EC_secp384r1", "EC_secp521r1")
"""The key types for ListCertificates, which lists only RSA_1024 and RSA_2048 without them (ACM API reference)."""
