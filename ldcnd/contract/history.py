"""Where an axis was at an instant: the answer to a query of `tele/<axis>/at`."""

from contextlib import suppress
from datetime import datetime
from typing import Final

from ldcnd.contract.commands import LATEST_NS
from ldcnd.contract.errors import MalformedRequest
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.samples import InputLevels, Quality

MOST_READINGS: Final = 1000
"""Readings of an axis in a range that are answered at most, with its first and last instant besides."""


class Within(Frozen):
    """A value that was not measured at its instant, and the bounds in which the true one lies."""

    value: float
    """The best estimate."""
    lower: float
    """The true value is not below this."""
    upper: float
    """The true value is not above this."""


class AxisInstant(Frozen):
    """Place and velocity of an axis at an instant, in the coordinates of then: `_time` of the selector names it.

    `_time` is ns since 1970 (UTC), RFC 3339, or `now(-2s)`. Readings of the last 600 s answer, from two polls ago on.
    A range `[T..T]` has an answer for its first instant, one for each of up to 1000 readings, and one for its last.
    """

    t: int
    """The instant, UTC in ns since 1970."""
    unit: str
    """The axis unit."""
    quality: Quality
    """How much it is worth; bad where nothing is known, uncertain where the place that the axis had was lost."""
    referenced: bool = False
    """Whether the position was a place: the axis had a reference."""
    position: Within | None = None
    """Position in axis units, counted through all turns; null where it is not known."""
    velocity: Within | None = None
    """Velocity in axis units a second; likewise."""
    inputs: InputLevels | None = None
    """The inputs, the same in the readings before and behind the instant; null where one of them changed meanwhile."""
    reason: str | None = None
    """Why nothing is known."""


def time_of(text: str, now_ns: int) -> tuple[int, int]:
    """Return the first and the last instant that `_time` of a selector names, UTC in ns since 1970.

    Raises:
        MalformedRequest: it names none, or the end of the range lies before its beginning.
    """
    first, dots, last = text.strip("[]").partition("..") if text[:1] + text[-1:] == "[]" else (text, "", "")
    t = _instant(first, now_ns)
    until = _instant(last, now_ns) if dots else t
    if until < t:
        raise MalformedRequest(f"_time={text!r}: its end lies before its beginning", value=text)
    return t, until


def refuse_more_than(axis: str, count: int) -> None:
    """Refuse a range with more readings than an answer may have.

    Raises:
        MalformedRequest: there are more.
    """
    if count > MOST_READINGS:
        raise MalformedRequest(
            f"axis {axis}: {count} readings lie in this range, and an answer has {MOST_READINGS} at most",
            axis=axis,
            value=count,
            limit=MOST_READINGS,
            remedy="ask for shorter ranges, one after another",
        )


def _instant(text: str, now_ns: int) -> int:
    t = -1
    with suppress(ValueError, OverflowError):
        if text.startswith("now(") and text.endswith("s)"):
            t = now_ns + round(float(text[4:-2]) * 1e9)
        elif text.isdecimal():
            t = int(text)
        else:
            moment = datetime.fromisoformat(text)
            # apart from the microseconds: a float holds no nanoseconds of an instant of today
            t = round(moment.replace(microsecond=0).timestamp()) * 1_000_000_000 + moment.microsecond * 1000
    if not 0 <= t <= LATEST_NS:
        raise MalformedRequest(
            f"_time={text!r} is no instant",
            value=text,
            remedy="_time=now(-2s), RFC 3339, or ns since 1970, UTC; _time=[now(-2s)..now(-1s)] for a range",
        )
    return t
