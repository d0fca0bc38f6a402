"""Turns a human's keys and buttons into the action of each step. Pure; no clock."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import combinations, permutations

from hippodrome.protocol import keyboard
from hippodrome.trial.core.players import NOOP

ARROWS = ("up", "down", "left", "right")
"""The controls of `ui` that are names of actions."""
DIRECTIONS = frozenset({*ARROWS, "fire"})
"""Names that a client may press even if only combinations of them are actions ("up" + "right" = "upright")."""

KEY = "\0"
"""In a project with `keys`: the prefix of a key's name, so that it differs from every action's name."""
PRESSES = 4
"""With `input: single`, the most presses that may wait for a step; more are dropped."""
_COMBINED = 4  # the most held keys that are combined to an action; people do not hold more on purpose


class Controls:
    """The held keys and the presses of one player.

    `action_space` are the names of the player's actions in their order. `lifespan` is the number of steps for which a
    press acts. `default` is the number of the idle action; None: NOOP, or the first action. `keys` are the project's
    own: the name of an action for each combination of keys (`hippodrome.protocol.keyboard`). If the player has no
    action of this name, the combination does nothing. With `single`, each press is one action, for one step.
    """

    def __init__(
        self,
        action_space: Sequence[str],
        lifespan: int,
        default: int | None = None,
        *,
        keys: Mapping[str, str] | None = None,
        single: bool = False,
    ) -> None:
        self.names = tuple(action_space)
        self._index = {name: index for index, name in enumerate(self.names)}
        self._lifespan = lifespan
        self._held: list[str] = []  # newest first
        self._tapped: list[str] = []  # pressed and released again between two steps
        self._untaken: set[str] = set()  # went down since the last step
        self._press: int | None = None
        self._press_left = 0.0
        self._keys = {
            frozenset(KEY + key for key in keyboard.parts(combined)): self._index[action]
            for combined, action in (keys or {}).items()
            if action in self._index
        }
        self._key_names = frozenset().union(*self._keys) if self._keys else frozenset()
        self._combined: tuple[list[str], int | None] = [], None
        """The last keys that were combined, and their action. Kept because most keys are held for many steps."""
        self._single = single
        self._presses: deque[tuple[int, int | None]] = deque()  # with `single`: actions that wait, and their times
        self.time: int | None = None
        """The time of the message that is being read, in nanoseconds, if the caller sets it."""
        self.pressed_at: int | None = None
        """The time of the message that chose the last action taken, if the human chose it."""
        self.default = self._index.get(NOOP, 0) if default is None else default

    def knows(self, name: str) -> bool:
        """Whether `name` is an action, or a key that can be part of one."""
        return name in self._index or name in DIRECTIONS or name in self._key_names

    def keep(self, name: str) -> None:
        """Choose an action that acts until another is chosen. NOOP and unknown names only end the earlier action."""
        self._press = self._index.get(name) if name != NOOP else None
        self._press_left = math.inf

    def press(self, name: str) -> None:
        """Choose an action by one press. It acts for `lifespan` steps (`single`: one), or until another is chosen."""
        index = self._combined_with(name, ())
        if self._single:
            self._wait(index)
            return
        self.pressed_at = self.time
        self._press = index
        self._press_left = self._lifespan

    def hold(self, name: str) -> None:
        """Take a key that went down, and end a press that still acts."""
        if name in self._held:  # the keyboard repeats it: its place in the order stays
            return
        self._held.insert(0, name)
        if self._single:
            self._wait(self._combined_with(name, self._held[1:_COMBINED]))
            return
        self.pressed_at = self.time
        self._untaken.add(name)
        self._press_left = 0

    def _wait(self, index: int | None) -> None:
        """With `single`: let an action wait for its step. Drop None, and an action if PRESSES actions wait already."""
        if index is not None and len(self._presses) < PRESSES:
            self._presses.append((index, self.time))

    def release(self, name: str) -> None:
        """Release a key. A key that was pressed and released between two steps still acts on the next one."""
        if name not in self._held:
            return
        self._held.remove(name)
        if name not in self._untaken:
            self.pressed_at = self.time  # the other held keys choose the action from now on
        else:
            self._tapped.insert(0, name)

    def clear(self) -> None:
        """Release all keys and forget all presses, for instance when the player's connection is lost."""
        self._held.clear()
        self._tapped.clear()
        self._untaken.clear()
        self._presses.clear()
        self._press_left = 0

    def forget_taps(self) -> None:
        """Forget presses, and keys that were released before a step took them. Held keys and `keep`'s action stay."""
        self._tapped.clear()
        self._presses.clear()
        if self._press_left < math.inf:
            self._press_left = 0

    @property
    def held(self) -> tuple[str, ...]:
        """The names of the keys that are held down, newest first."""
        return tuple(self._held)

    def take(self) -> tuple[int, bool]:
        """Return the action for the step that begins now: its number, and whether the human chose it."""
        if self._presses:
            pressed, self.pressed_at = self._presses.popleft()
            return pressed, True
        if not self._held and not self._tapped and self._press_left <= 0:
            return self.default, False
        keys = self._held
        if self._tapped:
            keys = [*self._tapped, *(key for key in keys if key not in self._tapped)]
        self._tapped.clear()
        self._untaken.clear()
        if self._press_left > 0 and self._press is not None:
            self._press_left -= 1
            return self._press, True
        index = None if self._single else self._combine(keys)
        return (self.default, False) if index is None else (index, True)

    def choice(self, name: str, held: bool | None) -> int | None:
        """Turn by turn: return the action that a press (`held` is None), a key going down (True) or up (False) chooses.

        None if it chooses none: the key goes up, the keyboard repeats it, or it acts only together with others.
        """
        if held is None:
            return self._combined_with(name, ())
        if not held:
            self.release(name)
            return None
        if name in self._held:
            return None
        self._held.insert(0, name)
        return self._combined_with(name, self._held[1:_COMBINED])

    def _combine(self, keys: list[str]) -> int | None:
        """Return the action of the newest key combined with as many other held keys as possible.

        If it is part of no action, the next older key is tried. None if no key is.
        """
        keys = keys[:_COMBINED]
        if keys != self._combined[0]:
            found = (self._combined_with(newest, keys[start:]) for start, newest in enumerate(keys, 1))
            self._combined = keys, next((index for index in found if index is not None), None)
        return self._combined[1]

    def _combined_with(self, newest: str, others: Sequence[str]) -> int | None:
        for size in range(len(others), -1, -1):
            for rest in combinations(others, size):
                if newest in self._key_names:
                    index = self._keys.get(frozenset((newest, *rest)))
                    if index is not None:
                        return index
                    continue
                for order in permutations((newest, *rest)):
                    index = self._index.get("".join(order))
                    if index is not None:
                        return index
        return None
