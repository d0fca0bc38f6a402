"""Interactive Gym's `RemoteConfig`: an experiment's settings, set by methods that can be called one after the other."""

from __future__ import annotations

from typing import Any, Self

from protocol.similar import did_you_mean
from trial.interactive_gym import options


class RemoteConfig:
    """The settings of an experiment; docs/interactive-gym.md has a table of all of them.

    Each method takes the options of its group by name (or in the table's order), and returns the config itself. None
    leaves an option as it is. Raises TypeError for an option that there is not, and AssertionError, as Interactive
    Gym does, for some values.
    """

    def __init__(self) -> None:
        self.given: set[str] = set()
        """The options that the experiment has set."""
        for option in options.OPTIONS:
            object.__setattr__(self, option.name, option.fresh())

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)
        if name in options.BY_NAME:
            self.given.add(name)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"RemoteConfig has no option {name}{did_you_mean(name, options.BY_NAME)}")

    def environment(self, *values: Any, **named: Any) -> Self:
        """The environment."""
        return self._set("environment", values, named)

    def policies(self, *values: Any, **named: Any) -> Self:
        """Who plays whom."""
        return self._set("policies", values, named)

    def gameplay(self, *values: Any, **named: Any) -> Self:
        """Actions, keys, episodes, the callback."""
        return self._set("gameplay", values, named)

    def rendering(self, *values: Any, **named: Any) -> Self:
        """What participants see of the game."""
        return self._set("rendering", values, named)

    def hosting(self, *values: Any, **named: Any) -> Self:
        """Where the experiment is held."""
        return self._set("hosting", values, named)

    def user_experience(self, *values: Any, **named: Any) -> Self:
        """Texts, pages, and where participants go afterwards."""
        return self._set("user_experience", values, named)

    def logging(self, *values: Any, **named: Any) -> Self:
        """The log."""
        return self._set("logging", values, named)

    def pyodide(self, *values: Any, **named: Any) -> Self:
        """Interactive Gym's way of running an environment in the browser."""
        return self._set("pyodide", values, named)

    @property
    def simulate_waiting_room(self) -> bool:
        """Whether a waiting room is asked for, even for those who play alone."""
        return bool(max(self.waitroom_time_randomization_interval_s) > 0)

    def to_dict(self, serializable: bool = False) -> dict[str, Any]:
        """The options and their values; with `serializable` only those that JSON can hold."""
        import json  # noqa: PLC0415 - rarely used

        found = {name: getattr(self, name) for name in options.BY_NAME}
        if not serializable:
            return found
        kept = {}
        for name, value in found.items():
            try:
                json.dumps(value)
            except (TypeError, ValueError, OverflowError):
                continue
            kept[name] = value
        return kept

    def _set(self, method: str, values: tuple[Any, ...], named: dict[str, Any]) -> Self:
        known = options.of_method(method)
        if len(values) > len(known):
            raise TypeError(f"{method}() takes at most {len(known)} options: {', '.join(known)}")
        given = dict(zip(known, values, strict=False))
        for name, value in named.items():
            if name not in known:
                raise TypeError(f"{method}() has no option {name}{did_you_mean(name, known)}")
            given[name] = value
        for name, value in given.items():
            if value is None:
                continue
            problem = options.wrong(name, value)
            if problem:
                raise AssertionError(problem)
            setattr(self, name, value)
        if "action_mapping" in given:
            self.__dict__["game_has_composite_actions"] = any(isinstance(key, tuple) for key in self.action_mapping)
        return self
