"""The nearest value that would be accepted, in the unit in which the refused one was typed."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal

from ldcnd.cli.typed import TypedNumber
from ldcnd.contract.errors import ErrorCode, LdcndError
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.number_text import behind_number
from ldcnd.contract.units import DIMENSIONS, Dimension, quantity_in, units_of

DIGITS = 6
_OF_LIMIT: Mapping[str, Dimension] = {
    ErrorCode.POSITION_LIMIT: Dimension.POSITION,
    ErrorCode.VELOCITY_LIMIT: Dimension.VELOCITY,
    ErrorCode.ACCELERATION_LIMIT: Dimension.ACCELERATION,
}
Typed = tuple[Frozen, Mapping[str, object], AxisInfo]
"""A command as it is sent, what was typed for its fields, and the axis."""


@contextmanager
def naming_nearest(*typed: Typed) -> Iterator[None]:
    """Have a refusal name the nearest value that would be accepted, as it would be typed instead of the refused one."""
    try:
        yield
    except LdcndError as error:
        for line in nearest_lines(error.code, error.value, error.nearest, [t for t in typed if _is_of(error, t[2])]):
            error.add_note(line)
        raise


def _is_of(error: LdcndError, info: AxisInfo) -> bool:
    return error.axis in (None, info.axis)


def nearest_lines(code: str, value: float | str | None, nearest: float | None, typed: Sequence[Typed]) -> list[str]:
    """Return the line that names the nearest value; none where there is none.

    Args:
        code: of the refusal.
        value: the refused one.
        nearest: the one that would be accepted.
        typed: the commands that it can be of.
    """
    if nearest is None:
        return []
    text = f"{nearest:g}"
    for command, given, info in typed[:1]:
        field = next((name for name, each in command if each is not None and each == value), "")
        dimension = _OF_LIMIT.get(code) or DIMENSIONS.get(field)
        if dimension is not None:
            text = _in_unit(nearest, value, _unit(given, dimension, info), info, dimension)
        elif field.endswith("_s"):
            text = f"{nearest:g} s"
    return [f"  the nearest value that would be accepted is {text}"]


def _unit(given: Mapping[str, object], dimension: Dimension, info: AxisInfo) -> str:
    """Return the unit in which a number of this dimension was typed; the one that is shown where none was."""
    texts = [
        each.text for name, each in given.items() if DIMENSIONS.get(name) is dimension and isinstance(each, TypedNumber)
    ]
    return next(filter(None, map(behind_number, texts)), units_of(info, dimension)[0])


def _in_unit(nearest: float, value: float | str | None, unit: str, info: AxisInfo, dimension: Dimension) -> str:
    """Return a number that is accepted also as it is rounded here: away from the refused one."""
    shown = quantity_in(nearest, unit, info, dimension)
    above = isinstance(value, (int, float)) and nearest > value
    exact = Decimal(f"{shown:.12g}")
    if exact:
        step = Decimal(1).scaleb(math.floor(math.log10(abs(shown))) + 1 - DIGITS)
        exact = exact.quantize(step, ROUND_CEILING if above else ROUND_FLOOR)
    return f"{float(exact):.{DIGITS + 3}g} {unit}"
