"""Each package that is installed has a pinned version: a clone gets the packages with which the tests have run."""

from __future__ import annotations

import importlib.metadata

from packaging.utils import canonicalize_name

from tests.dependencies import brought_along, constraints, named


def test_packages_that_the_requirements_name_are_pinned_and_installed() -> None:
    for each in named():
        assert str(each.specifier) == f"=={importlib.metadata.version(each.name)}"


def test_packages_that_others_bring_along_are_pinned() -> None:
    pinned = constraints()
    assert {name: pinned.get(name) for name in brought_along()} == brought_along()


def test_nothing_is_pinned_twice() -> None:
    assert not constraints().keys() & {canonicalize_name(each.name) for each in named()}
