"""Compute once per process what botocore and moto compute again for every session, client and call.

Half of the CPU time of the tests goes into botocore and moto. What is kept here depends only on installed files and on the arguments,
so a test can see no difference except in time. `testing/moto_world.py` has what moto lacks; this module changes no answer.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Hashable
from typing import Any

import botocore.client
import botocore.endpoint_provider
import botocore.hooks
import botocore.regions
import botocore.session
import botocore.useragent
import moto.core.base_backend
import moto.core.models
import moto.core.responses
import moto.core.serialize
import moto.s3.models


def keep() -> None:
    """Start keeping results, in this process and in the processes that it starts."""
    # moto makes thousands of machine images for every region that is asked anything of EC2; no test needs one.
    os.environ["MOTO_EC2_LOAD_DEFAULT_AMIS"] = "false"
    _keep_clients()
    _keep_calls()
    _keep_moto()


def _keep_clients() -> None:
    """What every session and client loads or builds: models, endpoint rules, methods."""
    # Every session parses the models of the services. A loader only reads files of the installed package.
    botocore.session.create_loader = functools.cache(botocore.session.create_loader)
    _keep(botocore.client.ClientCreator, "_load_service_model", lambda _, name, api_version=None: (name, api_version))
    # The loader returns the same objects each time, so their ids name them.
    _keep(
        botocore.regions,
        "EndpointProvider",
        lambda ruleset_data, partition_data, excluded_params=None: (id(ruleset_data), id(partition_data)),
        hold=True,
    )
    # What is registered for a new class adds methods to this dictionary, so that each class gets its own.
    _keep(
        botocore.client.ClientCreator,
        "_create_methods",
        lambda _, model: (model.service_name, model.api_version),
        given=dict,
    )
    setattr(botocore.hooks._PrefixTrie, "__copy__", _copy_of_handlers)  # noqa: B010


def _keep_calls() -> None:
    """What botocore computes for every call."""
    _keep(botocore.hooks.EventAliaser, "_alias_event_name", lambda _, name: name)
    # The code of a function says whether it takes keywords; a bound method would keep its object alive.
    _keep(botocore.hooks, "accepts_kwargs", lambda called: getattr(called, "__code__", called))
    _keep(
        botocore.useragent.UserAgentString, "to_string", lambda agent: agent._client_config is None
    )  # no test reads it


def _keep_moto() -> None:
    """What moto computes for every call and every world."""
    _keep(moto.core.responses, "method_names_from_class", lambda kind: kind)
    # S3 loads its module of addresses anew, twice per call, since a variable may change them; here nothing sets it.
    backend = moto.core.base_backend.BaseBackend
    setattr(moto.s3.models.S3Backend, "_url_module", vars(backend)["_url_module"])  # noqa: B010 - a property for mypy
    addresses = _Addresses(vars(backend)["urls"].fget)
    setattr(backend, "urls", property(addresses))  # noqa: B010
    # A world that ends drops its backends right after their reset, which would fill them anew (EC2: with networks).
    setattr(backend, "reset", lambda backend: None)  # noqa: B010
    # 1,288 of them for every world, for programs that use `requests`.
    _keep(moto.core.models, "CallbackResponse", lambda method, url, callback: (method, url, callback))
    _keep(
        moto.core.serialize.XFormedAttributePicker, "get_possible_keys", _looked_for, given=iter, made=list, hold=True
    )


class _Addresses(dict[type, Any]):
    """The addresses of a backend's service, by its class."""

    def __init__(self, made: Callable[[Any], Any]) -> None:
        super().__init__()
        self._made = made

    def __call__(self, backend: Any) -> Any:
        if type(backend) not in self:
            self[type(backend)] = self._made(backend)
        return self[type(backend)]


def _looked_for(_: Any, context: Any) -> Hashable:
    """What decides under which names moto looks for a value in an object (the alias providers in moto/core/serialize.py)."""
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
    """A copy of all nodes and their lists of handlers, but not of the handlers: what botocore's own copy gives."""
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
    """Call `owner.name` once for each key of its arguments.

    `made` turns the result into what is kept, `given` turns that into what callers get. `hold` keeps the arguments alive, for
    keys that are made of their ids.
    """
    wrapped = getattr(owner, name)
    kept: dict[Hashable, tuple[Any, Any]] = {}

    @functools.wraps(wrapped)
    def known(*arguments: Any, **more: Any) -> Any:
        which = key(*arguments, **more)
        if which not in kept:
            kept[which] = made(wrapped(*arguments, **more)), (arguments, more) if hold else None
        return given(kept[which][0])

    setattr(owner, name, known)
