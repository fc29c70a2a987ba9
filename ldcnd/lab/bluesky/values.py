"""Readings and their descriptions, as event-model has them."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, TypeVar

from ldcnd.client.axis import Axis
from ldcnd.client.rig import Rig
from ldcnd.contract.condition import Condition, assess
from ldcnd.contract.errors import AxisUnreachable, LdcndError, SessionError, WrongState
from ldcnd.contract.samples import PositionSample, Quality

if TYPE_CHECKING:
    from bluesky.protocols import Reading
    from event_model.documents import DataKey

ValueT = TypeVar("ValueT")
PATIENCE_S = 10.0
"""Longest wait for a new value, and for an axis to come to rest after a motion that failed, in seconds."""
SEVERITIES = {Quality.GOOD: 0, Quality.UNCERTAIN: 1, Quality.BAD: 2}


def reading(
    value: ValueT, at_s: float, quality: Quality = Quality.GOOD, condition: Condition | None = None
) -> "Reading[ValueT]":
    """Return a value with the instant at which it was true, in seconds since 1970, and the condition of its axis."""
    said = ", ".join(dict.fromkeys(filter(None, (condition.mark, *condition.notes)))) if condition else ""
    if condition and condition.alarm > SEVERITIES[quality]:
        return {"value": value, "timestamp": at_s, "alarm_severity": condition.alarm.value, "message": said}
    if quality is Quality.GOOD:
        plain: Reading[ValueT] = {"value": value, "timestamp": at_s}
        if said:
            plain["message"] = said
        return plain
    message = f"quality {quality.value}"
    return {"value": value, "timestamp": at_s, "alarm_severity": SEVERITIES[quality], "message": message}


def number_reading(
    name: str, value: float | str, at_s: float, quality: Quality, condition: Condition | None = None
) -> "dict[str, Reading[float | str]]":
    """Return the readings of a number and of its quality: of a reading, events keep no more than value and time.

    The quality is "good", or the words that other faces have behind a number in brackets.
    """
    told = (condition.mark if condition else "") or quality.value
    return {name: reading(value, at_s, quality, condition), f"{name}_quality": reading(told, at_s)}


def condition_of(axis: Axis) -> Condition:
    """Return the condition of an axis now; where nothing comes any more, its position gets old."""
    with suppress(SessionError):  # none has come yet
        return axis.position.condition
    with suppress(SessionError):
        return assess(axis.state.sample)
    return assess(None)


def quality_now(sample: PositionSample, axis: Axis) -> Quality | None:
    """Return the quality of a position; None for "uncertain" if a newer position has come since.

    State and position arrive apart, so an uncertain state may be older than the position.
    """
    with suppress(SessionError):  # none has come yet
        if sample.quality is Quality.UNCERTAIN and sample.t < axis.position.sample.t:
            return None
    return sample.quality


def not_known(axis: str, what: str, why: str) -> LdcndError:
    """Return the error of a value that is not known."""
    return AxisUnreachable(f"axis {axis}: its {what} is not known: {why}", axis=axis, remedy="see `ldcnd top`")


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


@asynccontextmanager
async def within(seconds: float, problem: str, remedy: str = "see `ldcnd top`") -> AsyncIterator[None]:
    """Bound what happens in a context.

    Raises:
        SessionError: it has taken longer.
    """
    try:
        async with asyncio.timeout(seconds):
            yield
    except TimeoutError:
        raise SessionError(problem, remedy=remedy) from None


async def instant(rig: Rig) -> int:
    """Return an instant of the daemon's clock, UTC in ns since 1970, at or after the end of every motion that is over.

    Clocks of two machines may differ, so that of this one does not tell what was measured after a trigger.
    """
    return max((state.t for state in (await rig.states()).values()), default=0)


def number_key(source: str, unit: str, *, limits: tuple[float | None, float | None] = (None, None)) -> "DataKey":
    """Return the description of a number; limits are those of commands, None where there is none."""
    key: DataKey = {"source": source, "dtype": "number", "shape": [], "units": unit}
    if limits != (None, None):
        key["limits"] = {"control": {"low": limits[0], "high": limits[1]}}
    return key


def number_keys(name: str, number: "DataKey") -> "dict[str, DataKey]":
    """Return the descriptions of a number and of its quality, see `number_reading`."""
    return {name: number, f"{name}_quality": text_key(f"{number['source']}/quality")}


def array_key(source: str, unit: str, length: int) -> "DataKey":
    """Return the description of a row of numbers."""
    return {"source": source, "dtype": "array", "shape": [length], "units": unit, "dtype_numpy": "<f8"}


def text_key(source: str) -> "DataKey":
    """Return the description of a text."""
    return {"source": source, "dtype": "string", "shape": []}
