"""The action that the human asks for at each step: keys held down and single presses. Pure; no clock."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import combinations, permutations

from protocol import keyboard
from trial.core.players import NOOP

ARROWS = ("up", "down", "left", "right")
"""The controls of `ui` that show actions."""
DIRECTIONS = frozenset({*ARROWS, "fire"})
"""Keys that may be pressed even if they act only together with others ("up" + "right" = "upright")."""

KEY = "\0"
"""Stands before the name of a key, where the project says what each key does: no action is called so."""
PRESSES = 4
"""Presses that wait for their step where each press is one action; more are dropped."""
_COMBINED = 4  # keys that are combined at most; people do not hold more on purpose


class Controls:
    """Held keys and the press buffer of one player.

    `action_space` are the names of the environment's actions in their order; `lifespan` is the number of steps
    that a single press acts for. `default` is the action of no key: NOOP or the first, if it is not given.
    `keys` are the project's own, an action for each combination (`protocol.keyboard`); those of actions that do not
    exist do nothing. With `single` each press of a key is one action, for one step.
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
        self._unseen: set[str] = set()  # held, but no step has acted on them yet
        self._press: int | None = None
        self._press_left = 0.0
        self._keys = {
            frozenset(KEY + key for key in keyboard.parts(combined)): self._index[action]
            for combined, action in (keys or {}).items()
            if action in self._index
        }
        self._key_names = frozenset().union(*self._keys) if self._keys else frozenset()
        self._combined: tuple[list[str], int | None] = [], None
        """The keys that acted last, and their action: most keys are held for many steps."""
        self._single = single
        self._presses: deque[tuple[int, int | None]] = deque()  # with `single`, those that wait for their step
        self.time: int | None = None
        """The time of the message that is being read, if the caller says it."""
        self.pressed_at: int | None = None
        """The time of the message that chose the action which was taken last, if a human asked for it."""
        self.default = self._index.get(NOOP, 0) if default is None else default

    def knows(self, name: str) -> bool:
        """Whether the name is that of an action, or of a key that can be part of one."""
        return name in self._index or name in DIRECTIONS or name in self._key_names

    def keep(self, name: str) -> None:
        """Let this action act until another one is chosen. NOOP and unknown names end the action that acts."""
        self._press = self._index.get(name) if name != NOOP else None
        self._press_left = math.inf if self._press is not None else 0

    def press(self, name: str) -> None:
        """Choose an action by one press. It acts for `lifespan` steps (`single`: for one), or until another action."""
        index = self._combined_with(name, ())
        if self._single:
            self._wait(index)
            return
        self.pressed_at = self.time
        self._press = index
        self._press_left = self._lifespan if self._press is not None else 0

    def hold(self, name: str) -> None:
        """A key went down. It takes over from a press that is still acting."""
        if name in self._held:  # the keyboard repeats; the key is no newer for it
            return
        self._held.insert(0, name)
        if self._single:
            self._wait(self._combined_with(name, self._held[1:_COMBINED]))
            return
        self.pressed_at = self.time
        self._unseen.add(name)
        self._press_left = 0

    def _wait(self, index: int | None) -> None:
        """With `single`: the action waits for its step."""
        if index is not None and len(self._presses) < PRESSES:
            self._presses.append((index, self.time))

    def release(self, name: str) -> None:
        """A key went up. A key that was pressed and released between two steps still acts on the next one."""
        if name not in self._held:
            return
        self._held.remove(name)
        if name not in self._unseen:
            self.pressed_at = self.time  # what is held besides acts from now on
        else:
            self._unseen.discard(name)
            self._tapped.insert(0, name)

    def clear(self) -> None:
        """Let go of all keys and presses, as when the player's connection is lost."""
        self._held.clear()
        self._tapped.clear()
        self._unseen.clear()
        self._presses.clear()
        self._press_left = 0

    def forget_taps(self) -> None:
        """Forget the press, and keys released before a step acted on them; not held keys, nor `keep`'s action."""
        self._tapped.clear()
        self._presses.clear()
        if self._press_left < math.inf:
            self._press_left = 0

    @property
    def held(self) -> tuple[str, ...]:
        """The names of the keys that are held down, newest first."""
        return tuple(self._held)

    def take(self) -> tuple[int, bool]:
        """The action of the step that begins now: its index, and whether a human asked for it."""
        if self._presses:
            pressed, self.pressed_at = self._presses.popleft()
            return pressed, True
        if not self._held and not self._tapped and self._press_left <= 0:
            return self.default, False
        keys = self._held
        if self._tapped:
            keys = [*self._tapped, *(key for key in keys if key not in self._tapped)]
        self._tapped.clear()
        self._unseen.clear()
        if self._press_left > 0 and self._press is not None:
            self._press_left -= 1
            return self._press, True
        index = None if self._single else self._combine(keys)
        return (self.default, False) if index is None else (index, True)

    def choice(self, name: str, held: bool | None) -> int | None:
        """What a press (`held` is None), or a key that goes down (True) or up (False), chooses turn by turn.

        None if that is no action: keys that go up, that the keyboard repeats, or that act only together with others.
        """
        if held is None:
            return self._combined_with(name, ())
        if not held:
            self.release(name)
            self._tapped.clear()
            return None
        if name in self._held:
            return None
        self._held.insert(0, name)
        return self._combined_with(name, self._held[1:_COMBINED])

    def _combine(self, keys: list[str]) -> int | None:
        """The action named by the newest key and as many other held keys as possible.

        If there is none, try the next older key. None if no key is part of an action.
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
