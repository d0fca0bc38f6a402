"""Interactive Gym's `RemoteConfig`: the settings of an experiment, which methods set."""

from __future__ import annotations

from typing import Any, Self

from protocol.similar import did_you_mean
from trial.interactive_gym import options


class RemoteConfig:
    """The settings of an experiment. docs/interactive-gym.md has a table of them.

    Each method takes the options of its group by name, or in the table's order, and returns the config itself, so that
    calls can be chained. None leaves an option as it is. A method raises TypeError for an unknown option, and, as in
    Interactive Gym, AssertionError for some values.
    """

    def __init__(self) -> None:
        self.given: set[str] = set()
        """The options that the experiment has set."""
        for option in options.OPTIONS:
            object.__setattr__(self, option.name, option.new_default())

    def __setattr__(self, name: str, value: Any) -> None:
        if name in options.BY_NAME:
            self.given.add(name)
            value = options.BY_NAME[name].read(value)
        object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"RemoteConfig has no option {name}{did_you_mean(name, options.BY_NAME)}")

    def environment(self, *values: Any, **named: Any) -> Self:
        """Set options of the environment."""
        return self._set("environment", values, named)

    def policies(self, *values: Any, **named: Any) -> Self:
        """Set who or which policy plays each player."""
        return self._set("policies", values, named)

    def gameplay(self, *values: Any, **named: Any) -> Self:
        """Set options of actions, keys and episodes, and the callback."""
        return self._set("gameplay", values, named)

    def rendering(self, *values: Any, **named: Any) -> Self:
        """Set how the game is drawn."""
        return self._set("rendering", values, named)

    def hosting(self, *values: Any, **named: Any) -> Self:
        """Set options of the server."""
        return self._set("hosting", values, named)

    def user_experience(self, *values: Any, **named: Any) -> Self:
        """Set texts, pages, and the sites to which participants go afterwards."""
        return self._set("user_experience", values, named)

    def logging(self, *values: Any, **named: Any) -> Self:
        """Set options of the log."""
        return self._set("logging", values, named)

    def pyodide(self, *values: Any, **named: Any) -> Self:
        """Set options of environments that Interactive Gym runs in the browser."""
        return self._set("pyodide", values, named)

    @property
    def simulate_waiting_room(self) -> bool:
        """Whether the experiment wants a waiting room, even for participants who play alone."""
        return bool(max(self.waitroom_time_randomization_interval_s) > 0)

    def to_dict(self, serializable: bool = False) -> dict[str, Any]:
        """Return the values by the options' names; with `serializable`, only the values that JSON can hold."""
        import json  # noqa: PLC0415 - rarely used

        all_values = {name: getattr(self, name) for name in options.BY_NAME}
        if not serializable:
            return all_values
        in_json = {}
        for name, value in all_values.items():
            try:
                json.dumps(value)
            except (TypeError, ValueError, OverflowError):
                continue
            in_json[name] = value
        return in_json

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
            problem = options.problem_of(name, value)
            if problem:
                raise AssertionError(problem)
            setattr(self, name, value)
        if "action_mapping" in given:
            self.__dict__["game_has_composite_actions"] = any(isinstance(key, tuple) for key in self.action_mapping)
        return self
