"""What botocore and moto would compute again for every session, client and call is computed once for all tests.

Everything here depends on installed files and on its arguments alone, so that no test can see a difference but in time.
The tests make a thousand clients; without this, half of the time of those on moto goes into them.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Hashable
from typing import Any

import botocore.client
import botocore.hooks
import botocore.session
import botocore.useragent
import moto.core.responses


def keep() -> None:
    """From here on, in this process and in those that it starts."""
    # moto makes thousands of machine images for every region that is asked anything of EC2; none of ours needs one.
    os.environ["MOTO_EC2_LOAD_DEFAULT_AMIS"] = "false"
    # Every session parses the models of the services. A loader only reads files of the installed package.
    botocore.session.create_loader = functools.cache(botocore.session.create_loader)
    # What is registered for a new class adds methods to this dictionary, so that each class gets its own.
    _keep(
        botocore.client.ClientCreator,
        "_create_methods",
        lambda _, model: (model.service_name, model.api_version),
        given=dict,
    )
    _keep(botocore.hooks.EventAliaser, "_alias_event_name", lambda _, name: name)
    # The code of a function says whether it takes keywords; a bound method would keep its object alive.
    _keep(botocore.hooks, "accepts_kwargs", lambda called: getattr(called, "__code__", called))
    _keep(
        botocore.useragent,
        "sanitize_user_agent_string_component",
        lambda raw_str, allow_hash: (raw_str, allow_hash),
    )
    # moto looks through the methods of a class at every call.
    _keep(moto.core.responses, "method_names_from_class", lambda kind: kind)


def _keep(
    owner: Any, name: str, key: Callable[..., Hashable], given: Callable[[Any], Any] = lambda found: found
) -> None:
    """Let `owner.name` be called once for each key of its arguments; `given` makes what callers get of the result."""
    wrapped = getattr(owner, name)
    kept: dict[Hashable, Any] = {}

    @functools.wraps(wrapped)
    def known(*arguments: Any, **more: Any) -> Any:
        which = key(*arguments, **more)
        if which not in kept:
            kept[which] = wrapped(*arguments, **more)
        return given(kept[which])

    setattr(owner, name, known)
