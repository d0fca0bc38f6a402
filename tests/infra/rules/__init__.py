"""What AWS accepts of the template beyond CloudFormation's schemas: one table, `RULES`.

Each rule says which type and property it is about, what AWS accepts, where that stands, and how a template would break
it: `tests/infra/test_rules.py` holds the template against every rule, and sees every broken template refused.
"""

from __future__ import annotations

from tests.infra.rules import data, functions, messages, network, policies, site, stack, watching
from tests.infra.rules.book import Rule

RULES: tuple[Rule, ...] = (
    *stack.RULES,
    *network.RULES,
    *messages.RULES,
    *functions.RULES,
    *policies.RULES,
    *data.RULES,
    *site.RULES,
    *watching.RULES,
)
