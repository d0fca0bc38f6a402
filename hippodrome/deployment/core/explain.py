"""Turns errors of AWS and of the network into sentences with advice."""

from __future__ import annotations

import re

import botocore.exceptions as boto

from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors

_EXPIRED = {"ExpiredToken", "ExpiredTokenException", "RequestExpired"}
_WRONG_KEYS = {
    "InvalidClientTokenId",
    "UnrecognizedClientException",
    "SignatureDoesNotMatch",
    "AuthFailure",
    "InvalidAccessKeyId",
}
DENIED = {
    "AccessDenied",
    "AccessDeniedException",
    "AuthorizationError",  # SNS's code for a call that is not allowed
    "UnauthorizedOperation",
    "403",
}
_NOT_ACTIVE = {"OptInRequired", "SubscriptionRequiredException", "NotSignedUp"}
"""The error codes for an account whose sign-up is not complete or not known everywhere (re:Post,
"error-access-service")."""
NOT_ACTIVE = (
    "AWS has not activated this account yet.",
    "Finish the sign-up in AWS's console (credit card, telephone), and wait for AWS's mail, which takes minutes, or "
    "a day at most. Then run the same command again.",
)
_SLOW_DOWN = {"Throttling", "ThrottlingException", "TooManyRequestsException", "SlowDown", "RequestLimitExceeded"}


def problem_from(error: BaseException) -> Problem | None:
    """Explain an error of AWS or the network by a problem with advice; None for other errors."""
    if isinstance(error, Problem):
        return error
    if isinstance(error, boto.ClientError):
        return _refusal(error)
    if isinstance(error, (boto.NoCredentialsError, boto.PartialCredentialsError, boto.CredentialRetrievalError)):
        return Problem(
            "There are no usable AWS credentials on this machine.",
            "Run `aws configure`, `aws sso login` or `aws login`, or set both AWS_ACCESS_KEY_ID and "
            "AWS_SECRET_ACCESS_KEY.",
        )
    if isinstance(error, (boto.SSOTokenLoadError, boto.UnauthorizedSSOTokenError, boto.TokenRetrievalError)):
        return Problem("The AWS login has expired.", "Run `aws sso login` and try again.")
    if isinstance(error, (boto.HTTPClientError, boto.EndpointConnectionError)):
        return Problem("AWS could not be reached.", "Check the network and the region's name, and try again.")
    if isinstance(error, boto.BotoCoreError):
        return Problem(
            f"The AWS library refused: {error}.",
            "If that names an option or a setting of ~/.aws/config, correct it. Otherwise run the command again with "
            "HIPPODROME_DEBUG=1 and send us what it prints.",
        )
    return None


def _refusal(error: boto.ClientError) -> Problem:
    code = errors.code(error)
    message = errors.message(error).strip()
    action = _words(error.operation_name)
    if code in _EXPIRED:
        return Problem("The AWS credentials have expired.", "Get new ones (`aws sso login`) and try again.")
    if code in _WRONG_KEYS:
        return Problem(
            "AWS does not accept these credentials.",
            "Check the access key and its secret, and the region: a region that is not enabled accepts none.",
        )
    if code in _NOT_ACTIVE:
        return Problem(*NOT_ACTIVE, [message] if message else [])
    if code in DENIED:
        return Problem(
            f"These credentials may not {action}.",
            "Ask the administrator for that permission; researchers need the stack's ResearcherPolicy.",
            [message] if message else [],
        )
    if code in _SLOW_DOWN:
        return Problem(f"AWS is busy and would not {action} now.", "Wait a minute and try again.")
    return Problem(f"AWS would not {action}: {(message or code).rstrip('.')}.")


def _words(operation: str) -> str:
    """Write the name of an API operation in words: `PutObject` becomes `put object`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", operation).lower()
