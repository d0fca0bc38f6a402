"""Lets botocore and moto compute once per process what they compute again for every session, client and call.

Half of the CPU time of the tests goes into botocore and moto. The kept results depend only on installed files and on
the arguments, so a test can see no difference except in time. `testing/moto_world.py` adds what moto lacks; this module
changes no answer.
"""

from __future__ import annotations

import copy
import functools
import json
import os
import re
import string
from collections.abc import Callable, Hashable
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import botocore.auth
import botocore.client
import botocore.endpoint
import botocore.endpoint_provider
import botocore.hooks
import botocore.httpsession
import botocore.regions
import botocore.session
import botocore.useragent
import botocore.utils
import moto.acm.models
import moto.backends
import moto.cloudformation.models
import moto.core.base_backend
import moto.core.botocore_stubber
import moto.core.errors
import moto.core.models
import moto.core.responses
import moto.core.serialize
import moto.s3.models
import moto.utilities.utils
from moto import backend_index
from moto.core.models import DEFAULT_ACCOUNT_ID
from moto.core.request import normalize_request
from moto.moto_api import recorder
from moto.moto_api._internal.moto_random import MotoRandom
from werkzeug.exceptions import HTTPException


@functools.cache
def keep() -> None:
    """Keep results from now on, in this process and in the processes that are forked from it. Once is enough."""
    # moto makes thousands of machine images for each region in which EC2 is called; no test needs one.
    os.environ["MOTO_EC2_LOAD_DEFAULT_AMIS"] = "false"
    # Nor does a test ask which types of instances there are: a million values in each process, 80 MB.
    load = moto.utilities.utils.load_resource
    setattr(moto.utilities.utils, "load_resource", lambda name: {} if "/instance_type" in name else load(name))  # noqa: B010
    _keep_clients()
    _keep_calls()
    _keep_moto()


def _keep_clients() -> None:
    """Keep what every session and client loads or builds: models, endpoint rules, methods."""
    # Every session parses the models of the services. A loader only reads files of the installed package.
    botocore.session.create_loader = functools.cache(botocore.session.create_loader)
    _keep(botocore.client.ClientCreator, "_load_service_model", lambda _, name, api_version=None: (name, api_version))
    # The loader returns the same objects each time, so their ids identify them.
    _keep(
        botocore.regions,
        "EndpointProvider",
        lambda ruleset_data, partition_data, excluded_params=None: (id(ruleset_data), id(partition_data)),
        hold=True,
    )
    # Handlers of the event for a new class add methods to this dictionary, so each class gets a copy of its own.
    _keep(
        botocore.client.ClientCreator,
        "_create_methods",
        lambda _, model: (model.service_name, model.api_version),
        given=dict,
    )
    setattr(botocore.hooks._PrefixTrie, "__copy__", _copy_of_handlers)  # noqa: B010
    make = botocore.httpsession.create_urllib3_context
    setattr(botocore.httpsession, "create_urllib3_context", _context(make))  # noqa: B010
    proxies = botocore.endpoint.get_environ_proxies
    setattr(botocore.endpoint, "get_environ_proxies", _proxies(proxies))  # noqa: B010


def _keep_calls() -> None:
    """Keep what botocore computes for every call."""
    _keep(botocore.hooks.EventAliaser, "_alias_event_name", lambda _, name: name)
    # The code object decides whether a function takes keywords; a bound method as the key would keep its object alive.
    _keep(botocore.hooks, "accepts_kwargs", lambda called: getattr(called, "__code__", called))
    agent = botocore.useragent.UserAgentString
    _keep(agent, "to_string", lambda agent: agent._client_config is None)  # no test reads it
    _keep(botocore.utils, "_parse_timestamp_with_tzinfo", lambda value, zone: (type(value), value, zone))
    setattr(botocore.auth.SigV4Auth, "add_auth", _sign(botocore.auth.SigV4Auth.add_auth))  # noqa: B010


def _keep_moto() -> None:
    """Keep what moto computes for every call and every world."""
    _keep(moto.core.responses, "method_names_from_class", lambda kind: kind)
    errors = moto.core.errors.ErrorLookupFactory()  # it keeps the errors of each service, but moto makes one per error
    setattr(moto.core.errors, "ErrorLookupFactory", lambda: errors)  # noqa: B010
    # S3 loads its module of URLs anew twice per call, since an environment variable may change them; here none does.
    backend = moto.core.base_backend.BaseBackend
    setattr(moto.s3.models.S3Backend, "_url_module", vars(backend)["_url_module"])  # noqa: B010 - a property for mypy
    addresses = _Addresses(vars(backend)["urls"].fget)
    setattr(backend, "urls", property(addresses))  # noqa: B010
    # A world that ends drops its backends right after it has reset them, and a reset fills them anew (EC2: with
    # networks).
    setattr(backend, "reset", lambda backend: None)  # noqa: B010
    # The callbacks are for programs that use `requests`; no test adds one of its own.
    mock = moto.core.models.MockAWS
    setattr(mock, "_enable_patching", _intercept(mock._enable_patching))  # noqa: B010
    stubber = moto.core.botocore_stubber.BotocoreStubber
    setattr(stubber, "process_request", _route(stubber.process_request))  # noqa: B010
    setattr(MotoRandom, "get_random_string", _random_string)  # noqa: B010 - two for each call of AWS
    # A listing of versions copies the objects of the bucket to mark the latest ones. A deep copy would copy their
    # bodies, too.
    setattr(moto.s3.models, "copy", SimpleNamespace(copy=copy.copy, deepcopy=_copies))  # noqa: B010
    _keep(
        moto.core.base_backend.AccountSpecificBackend,
        "_generate_regions",
        lambda _, service_name: service_name,
        given=list,
    )
    # moto makes an RSA key for each certificate that is requested.
    setattr(moto.acm.models.CertBundle, "generate_cert", classmethod(_requested_certificate))  # noqa: B010
    # moto reads JSON as YAML, too, which takes a hundred times as long.
    stack = moto.cloudformation.models.Stack
    setattr(stack, "parse_template", staticmethod(_template(stack.parse_template)))  # noqa: B010
    _keep(moto.acm.models.CertBundle, "validate_pk", lambda bundle: bundle.key)
    _keep(
        moto.core.serialize.XFormedAttributePicker, "get_possible_keys", _looked_for, given=iter, made=list, hold=True
    )


def _template(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return a `parse_template` that reads a template of JSON as JSON."""

    def parsed(template: str) -> Any:
        try:
            return json.loads(template)
        except ValueError:
            return parse(template)

    return parsed


def _context(make: Callable[..., Any]) -> Callable[..., Any]:
    """Return a `create_urllib3_context` that gives all clients of moto, which connect to nothing, the same TLS context."""
    shared = functools.cache(make)

    def made(*arguments: Any, **more: Any) -> Any:
        return (shared if moto.core.models.botocore_stubber.enabled else make)(*arguments, **more)

    return made


def _proxies(find: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return a `get_environ_proxies` that gives no proxies while moto answers: its clients connect to nothing."""
    return lambda url: {} if moto.core.models.botocore_stubber.enabled else find(url)


def _sign(sign: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
    """Return an `add_auth` that gives requests to moto a signature of zeros: moto reads everything but the signature."""

    def signed(auth: Any, request: Any) -> None:
        by_headers = type(auth) in (botocore.auth.SigV4Auth, botocore.auth.S3SigV4Auth)  # not in a presigned address
        if not (by_headers and auth.credentials and moto.core.models.botocore_stubber.enabled):
            sign(auth, request)
            return
        request.context["timestamp"] = botocore.auth.get_current_datetime().strftime(botocore.auth.SIGV4_TIMESTAMP)
        auth._modify_request_before_signing(request)
        auth._inject_signature_to_request(request, "0" * 64)

    return signed


def _intercept(enable: Callable[..., None]) -> Callable[..., None]:
    """Return an `_enable_patching` that registers the callbacks once, and not again for each world."""
    registered: list[Any] = []

    def enabled(mock: Any, reset: bool = True) -> None:
        if registered:
            moto.core.models.botocore_stubber.enabled = True
            if reset:
                mock.reset()
            moto.core.models.responses_mock.start()
        else:
            enable(mock, reset)
            registered.append(mock)
            setattr(moto.core.models, "reset_responses_mock", lambda responses: responses.calls.reset())  # noqa: B010

    return enabled


def _route(process: Callable[..., Any]) -> Callable[..., Any]:
    """Return a `process_request` that looks for the method of an address once. moto's tries 200 patterns for every call."""
    method_of = functools.cache(_method_of)

    def processed(stubber: Any, request: Any) -> Any:
        answer = method_of(_address(request.url))
        if answer is None:
            return process(stubber, request)
        normalized = normalize_request(request)
        recorder._record_request(normalized)
        try:
            return answer(normalized, normalized.raw_url, normalized.headers)
        except HTTPException as error:
            return error.code, error.get_headers(), error.get_body()

    return processed


def _method_of(address: str) -> Callable[..., Any] | None:
    """Return moto's method that answers requests to this address; None if there is none."""
    for service, pattern in backend_index.backend_url_patterns:
        if pattern.match(address):
            regions: Any = moto.backends.get_backend(service)[DEFAULT_ACCOUNT_ID]  # type: ignore[call-overload]
            urls = regions["us-east-1" if "us-east-1" in regions else "aws"].urls
            if found := next((method for url, method in urls.items() if re.match(url, address)), None):
                return found  # type: ignore[no-any-return]
    return None


def _address(url: str) -> str:
    """Return the part of a URL that decides which pattern matches; of an S3 path, whether it has bucket and key."""
    scheme, host, path, *_ = urlsplit(url)
    if host.startswith("s3.") or ".s3." in host:
        path = "/".join("x" if part else "" for part in path.split("/", 2))
    return f"{scheme}://{host}{path}"


def _requested_certificate(cls: Any, /, domain_name: str, **more: Any) -> Any:
    """Do what `CertBundle.generate_cert` does, but with one RSA key for each name instead of each request."""
    made = _certificate(domain_name, tuple(more.get("sans") or ()), more.get("cert_authority_arn"))
    account = {name: more[name] for name in ("account_id", "region", "cert_authority_arn")}
    return cls(certificate=made.cert, private_key=made.key, cert_type=made.type, cert_status=made.status, **account)


_generate = moto.acm.models.CertBundle.generate_cert


@functools.cache
def _certificate(domain_name: str, sans: tuple[str, ...], authority: str | None) -> Any:
    return _generate(domain_name, DEFAULT_ACCOUNT_ID, "us-east-1", [*sans], authority)


def _random_string(chance: MotoRandom, length: int = 20, include_digits: bool = True, lower_case: bool = False) -> str:
    made = "".join(chance.choices(string.ascii_letters + (string.digits if include_digits else ""), k=length))
    return made.lower() if lower_case else made


def _copies(versions: list[Any]) -> list[Any]:
    return [copy.copy(version) for version in versions]


class _Addresses(dict[type, Any]):
    """The URLs of each service, by the class of its backend."""

    def __init__(self, urls_of: Callable[[Any], Any]) -> None:
        super().__init__()
        self._urls_of = urls_of

    def __call__(self, backend: Any) -> Any:
        if type(backend) not in self:
            self[type(backend)] = self._urls_of(backend)
        return self[type(backend)]


def _looked_for(_: Any, context: Any) -> Hashable:
    """Return the key of the names under which moto looks for a value (the alias providers in moto/core/serialize.py)."""
    shape = context.shape
    parent = getattr(shape, "parent", None)
    return (
        context.key,
        type(context.obj),
        id(getattr(getattr(context.obj, "Meta", None), "serialization_aliases", None)),
        id(shape),
        id(parent),
    )


def _copy_of_handlers(trie: Any) -> Any:
    """Copy all nodes and their lists of handlers, but not the handlers, as botocore's own copy does."""
    new = type(trie)()
    new.__dict__ = {name: _copy_of_node(node) if isinstance(node, dict) else node for name, node in vars(trie).items()}
    return new


def _copy_of_node(node: dict[str, Any]) -> dict[str, Any]:
    values = node["values"]
    return {
        "chunk": node["chunk"],
        "children": {name: _copy_of_node(child) for name, child in node["children"].items()},
        "values": values and botocore.hooks.NodeList(values.first[:], values.middle[:], values.last[:]),
    }


def _keep(
    owner: Any,
    name: str,
    key: Callable[..., Hashable],
    given: Callable[[Any], Any] = lambda found: found,
    made: Callable[[Any], Any] = lambda found: found,
    hold: bool = False,
) -> None:
    """Replace `owner.name` with a function that calls it once for each key of its arguments, and keeps the result.

    `made` converts the result before it is kept, and `given` converts the kept result for each caller. `hold` keeps the
    arguments alive, for keys that consist of their ids.
    """
    wrapped = getattr(owner, name)
    results: dict[Hashable, tuple[Any, Any]] = {}

    @functools.wraps(wrapped)
    def known(*arguments: Any, **more: Any) -> Any:
        found = key(*arguments, **more)
        if found not in results:
            results[found] = made(wrapped(*arguments, **more)), (arguments, more) if hold else None
        return given(results[found][0])

    setattr(owner, name, known)
