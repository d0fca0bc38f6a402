"""The fixture that the tests of this folder share."""

from __future__ import annotations

from tests.control.config.folder import folder  # noqa: F401 - a fixture
