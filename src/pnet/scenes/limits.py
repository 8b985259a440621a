"""Checks of settings' values: a number in its range, or one message that names the key."""

import math
from typing import Any


def require_number(key: str, value: Any, low: float, high: float = math.inf, above: bool = False) -> None:
    """Raise ValueError where a setting is no finite number from `low` (`above`: more than that) to `high`."""
    if not _is_within(value, low, high, above):
        raise ValueError(f"{key} is {value!r}, expected {_limits(low, high, above)}")


def require_range(key: str, values: Any, low: float, high: float = math.inf, above: bool = False) -> None:
    """Raise ValueError where a setting is no [smallest, largest] of such numbers."""
    pair = isinstance(values, list | tuple) and len(values) == 2
    if not pair or not all(_is_within(v, low, high, above) for v in values) or values[0] > values[1]:
        shown = list(values) if isinstance(values, tuple) else values
        wanted = _limits(low, high, above)
        raise ValueError(f"{key} is {shown!r}, expected [smallest, largest], both {wanted}")


def _is_within(value: Any, low: float, high: float, above: bool) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return False
    return bool((value > low if above else value >= low) and value <= high)


def _limits(low: float, high: float, above: bool) -> str:
    start = f"more than {low:g}" if above else f"at least {low:g}"
    return start if high == math.inf else f"{low:g} to {high:g}"
