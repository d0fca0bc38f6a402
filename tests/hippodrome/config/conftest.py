"""The fixture that the tests of this folder share."""

from __future__ import annotations

from tests.hippodrome.config.folder import folder  # noqa: F401 - a fixture
