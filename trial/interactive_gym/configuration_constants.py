"""Interactive Gym's constants."""

from __future__ import annotations


class InputModes:
    """Whether a key acts once at each press, or as long as it is held."""

    SingleKeystroke = "single_keystroke"
    PressedKeys = "pressed_keys"


class PolicyTypes:
    """The values of `policy_mapping` for players without a policy of the researcher's."""

    Human = "human"
    Random = "random"


class ActionSettings:
    """The action of a player who has chosen none."""

    PreviousSubmittedAction = "previous_submitted_action"
    DefaultAction = "default_action"
