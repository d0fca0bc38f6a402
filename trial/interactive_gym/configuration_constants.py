"""Interactive Gym's constants."""

from __future__ import annotations


class InputModes:
    """How keys act: each press once, or as long as it is held."""

    SingleKeystroke = "single_keystroke"
    PressedKeys = "pressed_keys"


class PolicyTypes:
    """Players that need no policy of the researcher's."""

    Human = "human"
    Random = "random"


class ActionSettings:
    """Which action a player takes who has chosen none."""

    PreviousSubmittedAction = "previous_submitted_action"
    DefaultAction = "default_action"
