"""Readings and their descriptions, as event-model has them."""

from typing import TYPE_CHECKING, TypeVar

from ldcnd.errors import WrongState
from ldcnd.model.condition import Condition
from ldcnd.model.samples import Quality

if TYPE_CHECKING:
    from bluesky.protocols import Reading
    from event_model.documents import DataKey

ValueT = TypeVar("ValueT")
SEVERITIES = {Quality.GOOD: 0, Quality.UNCERTAIN: 1, Quality.BAD: 2}


def reading(
    value: ValueT, at_s: float, quality: Quality = Quality.GOOD, condition: Condition | None = None
) -> "Reading[ValueT]":
    """Return a value with the instant at which it was true, in seconds since 1970, and the condition of its axis."""
    if condition and condition.alarm > SEVERITIES[quality]:
        said = ", ".join(dict.fromkeys((*([condition.mark] if condition.mark else []), *condition.notes)))
        return {"value": value, "timestamp": at_s, "alarm_severity": condition.alarm.value, "message": said}
    if quality is Quality.GOOD:
        return {"value": value, "timestamp": at_s}
    message = f"quality {quality.value}"
    return {"value": value, "timestamp": at_s, "alarm_severity": SEVERITIES[quality], "message": message}


def refuse_other_unit(axis: str, described: str, measured: str) -> None:
    """Refuse a value whose unit is not the one that documents say.

    Raises:
        WrongState: the daemon was restarted with another unit.
    """
    if measured != described:
        raise WrongState(
            f"axis {axis}: its values are in {measured} now and were described in {described}",
            axis=axis,
            value=measured,
            remedy="begin a new run, which describes it anew",
        )


def number_key(source: str, unit: str, *, limits: tuple[float | None, float | None] = (None, None)) -> "DataKey":
    """Return the description of a number; limits are those of commands, None where there is none."""
    key: DataKey = {"source": source, "dtype": "number", "shape": [], "units": unit}
    if limits != (None, None):
        key["limits"] = {"control": {"low": limits[0], "high": limits[1]}}
    return key


def array_key(source: str, unit: str, length: int) -> "DataKey":
    """Return the description of a row of numbers."""
    return {"source": source, "dtype": "array", "shape": [length], "units": unit, "dtype_numpy": "<f8"}


def text_key(source: str) -> "DataKey":
    """Return the description of a text."""
    return {"source": source, "dtype": "string", "shape": []}
