"""docs/permissions.md says what the template does."""

from __future__ import annotations

from tests.infra import table


def test_the_tables_agree_with_the_template() -> None:
    assert table.written() == table.render(), "run: python -m tests.infra.table"
