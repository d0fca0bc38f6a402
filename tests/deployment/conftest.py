"""The fixtures that the tests of this folder share."""

from __future__ import annotations

from tests.deployment.installation import access_keys, account, installed  # noqa: F401 - fixtures
from tests.deployment.recipe import recipe  # noqa: F401 - a fixture
from tests.deployment.registering import folder, machine, register, register_world  # noqa: F401 - fixtures
from tests.deployment.stack_world import world  # noqa: F401 - a fixture
