"""Sessions of botocore for the tests: creating a client of one takes a tenth of the time that it takes otherwise."""

from __future__ import annotations

from typing import Any

import botocore.loaders
import botocore.session

_descriptions = botocore.loaders.create_loader()


def botocore_session() -> Any:
    """Return a new session, which takes the descriptions of services that this process has read before."""
    session = botocore.session.get_session()
    session.register_component("data_loader", _descriptions)
    return session
