"""Implements the ports of `hippodrome.control.ports` on S3, ECS and EC2, Route 53, EventBridge Scheduler, SNS and SQS.

Importing this package is cheap: botocore is loaded when the first port is used.
"""

from hippodrome.control.aws.platform import AwsPlatform

__all__ = ["AwsPlatform"]
