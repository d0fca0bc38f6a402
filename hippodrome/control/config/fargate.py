"""The sizes of tasks that AWS Fargate offers, and the checks of `cpu` and `memory`."""

from __future__ import annotations

import re

from hippodrome.protocol.values import number_in, show


def _steps(first: int, last: int, by: int = 1) -> tuple[float, ...]:
    return tuple(float(size) for size in range(first, last + 1, by))


SIZES: dict[float, tuple[float, ...]] = {
    0.25: (0.5, 1.0, 2.0),
    0.5: _steps(1, 4),
    1.0: _steps(2, 8),
    2.0: _steps(4, 16),
    4.0: _steps(8, 30),
    8.0: _steps(16, 60, by=4),
    16.0: _steps(32, 120, by=8),
}
"""The possible amounts of memory, in GB, by vCPUs."""


def fits(cpu: float, memory: float) -> bool:
    """Return whether Fargate offers tasks with `cpu` vCPUs and `memory` GB."""
    return memory in SIZES.get(cpu, ())


def memory_choices(cpu: float) -> str:
    """Return the amounts of memory for `cpu` in words: "4 to 16" or "16 to 60 in steps of 4".

    Raises KeyError for a number of vCPUs that Fargate does not offer.
    """
    sizes = SIZES[cpu]
    if not float(sizes[0]).is_integer():
        return ", ".join(f"{size:g}" for size in sizes[:-1]) + f" or {sizes[-1]:g}"
    step = sizes[1] - sizes[0]
    span = f"{sizes[0]:g} to {sizes[-1]:g}"
    return span if step == 1 else f"{span} in steps of {step:g}"


def cpu_choices() -> str:
    """Return all numbers of vCPUs that Fargate offers, in words."""
    names = [f"{cpu:g}" for cpu in SIZES]
    return ", ".join(names[:-1]) + f" or {names[-1]}"


def cpu(value: object) -> float:
    """Check a number of vCPUs: Fargate must offer it. Raises ValueError with what to write instead."""
    size = _size(value, "vcpus?")
    if size is not None and size in SIZES:
        return size
    hint = f" ({size:g} CPU units are {size / 1024:g} vCPU)" if size and size / 1024 in SIZES else ""
    raise ValueError(f"must be a number of vCPUs: {cpu_choices()}, not {show(value)}{hint}")


def memory(value: object) -> float:
    """Check an amount of memory, in GB. Raises ValueError with what to write instead.

    Whether Fargate offers it with the number of vCPUs is checked by `fits`.
    """
    size = _size(value, "gi?b")
    if size is not None and 0.5 <= size <= 120:
        return size
    hint = f" ({size:g} MB are {size / 1024:g} GB)" if size and size >= 512 else ""
    raise ValueError(f"must be a number of GB from 0.5 to 120, not {show(value)}{hint}")


def _size(value: object, unit: str) -> float | None:
    """The number in a value that may have this unit; None if there is none."""
    if isinstance(value, str):
        # No `\s*` before the unit: long blanks would take quadratic time.
        value = re.sub(rf"(?i){unit}$", "", value.strip()).rstrip()
    number = number_in(value)
    return None if number is None else float(number)
