"""Checks on the fields of a plant's declaration: each value is normalised, or refused with the field's name.

A NumPy scalar or 0-dimensional array becomes a number, a list a tuple, 120.0 the count 120.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

FAMILIES = ("steps", "staircase", "ramps", "sines", "doublets", "days")  # of `jaxouter.loop.references`


class Kind(NamedTuple):
    """A kind of value that a field may have."""

    allowed: str
    of: Callable[[Any], Any]
    """Normalises a value; raises TypeError or ValueError if it is not of this kind."""
    function: bool = False


def number(value: Any) -> float:
    """A number as a float with the digits it prints: np.float32(0.02) gives 0.02.

    Raises:
        TypeError: it is not a number; bools and strings are not.
    """
    array = None if isinstance(value, str | bytes | list | tuple) else np.asarray(value)
    if array is None or array.ndim or not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise TypeError(value)
    short = array.dtype.itemsize < 8 and np.issubdtype(array.dtype, np.floating)
    return float(str(array[()])) if short else float(array)


def plain(value: Any) -> Any:
    """A configuration value with Python numbers instead of 0-dimensional arrays, and tuples instead of lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(value, **{name: plain(part) for name, part in vars(value).items()})
    if isinstance(value, tuple | list):
        return tuple(map(plain, value))
    if getattr(value, "ndim", None) == 0:  # NumPy's scalars have it too
        array = np.asarray(value)
        return number(array) if np.issubdtype(array.dtype, np.floating) else array.item()
    return value


def _number(holds: Callable[[float], bool]) -> Callable[[Any], float]:
    def of(value: Any) -> float:
        found = number(value)
        if not holds(found):
            raise ValueError(value)
        return found

    return of


def _count(value: Any) -> int:
    found = number(value)
    if not (found >= 1 and found == int(found)):  # neither nan nor inf
        raise ValueError(value)
    return int(found)


def _range(value: Any) -> tuple[float, float]:
    low, high = map(number, value)
    if not (low < high and math.isfinite(low) and math.isfinite(high)):
        raise ValueError(value)
    return low, high


def _text(value: Any) -> str:
    if not (isinstance(value, str) and value.strip()):
        raise TypeError(value)
    return str(value)


def _flag(value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise TypeError(value)
    return bool(value)


def _function(value: Any) -> Any:
    if not callable(value):
        raise TypeError(value)
    return value


def _families(value: Any) -> tuple[str, ...]:
    found = tuple(value)
    if isinstance(value, str) or not found or not set(found) <= set(FAMILIES) or len(set(found)) < len(found):
        raise ValueError(value)
    return found


def _terms(value: Any) -> tuple[Any, ...]:
    found = (value,) if callable(value) else tuple(value)
    names = [getattr(each, "__name__", "") for each in found]
    if not all(map(callable, found)) or not all(map(str.isidentifier, names)) or len(set(names)) < len(names):
        raise ValueError(value)
    return found


def _or_none(kind: Kind) -> Kind:
    """The same kind, or None."""
    return Kind(f"{kind.allowed}, or None", lambda value: None if value is None else kind.of(value), kind.function)


TEXT = Kind("a text", _text)
POSITIVE = Kind("a positive finite number", _number(lambda value: 0.0 < value < math.inf))
NOT_NEGATIVE = Kind("a number that is not negative", _number(lambda value: value >= 0.0))
COUNT = Kind("a whole number, at least 1", _count)
RANGE = Kind("two finite numbers, the first below the second", _range)
FLAG = Kind("True or False", _flag)
FUNCTION = Kind("a function", _function, True)

PLANT: Mapping[str, Kind] = {
    "name": TEXT,
    "init": FUNCTION,
    "step": FUNCTION,
    "output": FUNCTION,
    "y_unit": TEXT,
    "time_unit": TEXT,
    "control_step": POSITIVE,
    "episode_steps": COUNT,
    "r_tilde_bounds": RANGE,
    "setpoint_range": RANGE,
    "evaluation_range": RANGE,
    "divergence_bounds": RANGE,
    "output_limit": _or_none(POSITIVE),
    "rate_limit": _or_none(POSITIVE),
    "move_threshold": NOT_NEGATIVE,
    "error_scale": POSITIVE,
    "history": _or_none(COUNT),
    "families": Kind(f"a tuple of some of {', '.join(FAMILIES)}", _families),
    "family_steps": COUNT,
    "differentiable": FLAG,
    "affine": FLAG,
    "start": _or_none(FUNCTION),
    "draw": _or_none(FUNCTION),
    "identified": FLAG,
    "reuse": FUNCTION,
    "reward_terms": Kind("a tuple of functions with different names", _terms),
    "members": _or_none(FUNCTION),
    "variables": FUNCTION,
    "settled": FUNCTION,
    "noise_free": FUNCTION,
    "smallest": FUNCTION,
    "widened": FUNCTION,
}


def checked(kind: Kind, what: str, value: Any) -> Any:
    """The normalised value.

    Args:
        kind: what is allowed.
        what: the field, as the message names it.
        value: as given.

    Raises:
        ValueError: it is not allowed; names the field, the value, and what is allowed.
    """
    try:
        return kind.of(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} is {shown(value)}; it must be {kind.allowed}") from None


def shown(value: Any) -> str:
    """A value as text for a message, at most one line."""
    text = repr(value).partition("\n")[0]
    return text if len(text) <= 100 else text[:97] + "..."
