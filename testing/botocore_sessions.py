"""Sessions of botocore for the tests: creating a client of one takes a tenth of the time that it takes otherwise."""

from __future__ import annotations

from typing import Any

import botocore.loaders
import botocore.session


class _Descriptions(botocore.loaders.Loader):  # type: ignore[misc]
    """The descriptions of services that this process has read."""

    @property
    def search_paths(self) -> list[str]:
        """Where descriptions are: botocore's own folder. Each session of boto3 adds one, which would count for all."""
        return list(super().search_paths)


_descriptions = _Descriptions()


def botocore_session() -> Any:
    """Return a new session, which takes the descriptions of services that this process has read before."""
    session = botocore.session.get_session()
    session.register_component("data_loader", _descriptions)
    return session
