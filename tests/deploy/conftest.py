"""The fixtures that the tests of this folder share."""

from __future__ import annotations

from tests.deploy.installation import access_keys, account, installed  # noqa: F401 - fixtures
from tests.deploy.recipe import recipe  # noqa: F401 - a fixture
from tests.deploy.registering import folder, machine, register, register_world  # noqa: F401 - fixtures
from tests.deploy.stack_world import world  # noqa: F401 - a fixture
