"""Channels of a gateway: what Channel Access clients see of a value, and what happens when they put one.

A field without an action is read-only, and says so to its clients. An action raises what it refuses; its client then
gets a failed put.
"""

import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from caproto import (
    AccessRights,
    AlarmSeverity,
    AlarmStatus,
    ChannelChar,
    ChannelData,
    ChannelDouble,
    ChannelEnum,
    ChannelInteger,
    ChannelString,
)

from ldcnd.contract.number_text import read_number

LONGEST_TEXT = 512
"""Characters of a text that is longer than an EPICS string, which has 39."""
LONGEST_STRING = 39
DESCRIPTION = (*("units", "precision", "upper_ctrl_limit", "lower_ctrl_limit", "upper_disp_limit", "lower_disp_limit"),)
"""What a channel says about its values."""

Value = float | int | str


@dataclass(frozen=True, slots=True)
class Put:
    """The outcome of a put that was not refused.

    Attributes:
        value: what the field shows now; None to leave it as it is.
        end: awaited by a client that waits for the put's effect; None for no wait.
    """

    value: Value | None = None
    end: Awaitable[None] | None = None


Action = Callable[[Value], Awaitable[Put]]


@dataclass(frozen=True, slots=True)
class RecordAlarm:
    """The alarm of a field."""

    status: AlarmStatus = AlarmStatus.NO_ALARM
    severity: AlarmSeverity = AlarmSeverity.NO_ALARM


NO_ALARM = RecordAlarm()


class RecordField(ChannelData):  # type: ignore[misc] # caproto has no types
    """A caproto channel whose puts go to an action; clients put with `write`, the gateway shows values with `show`."""

    action: Action | None = None

    # Any: caproto has no types
    def check_access(self, hostname: str, username: str) -> Any:  # noqa: ANN401, ARG002
        """Say who may do what: puts need an action."""
        return AccessRights.READ | AccessRights.WRITE if self.action else AccessRights.READ

    async def write(self, value: Any, **_metadata: Any) -> None:  # noqa: ANN401
        """Take a put, and return when it has had its effect."""
        if self.action is None:
            raise PermissionError("this field is read-only")
        put = await self.action(self.native(self.preprocess_value(value)))
        if put.value is not None:
            await self.show(put.value)
        if put.end is not None:
            await put.end

    async def show(self, value: Value, alarm: RecordAlarm = NO_ALARM, at_s: float | None = None) -> None:
        """Publish a value.

        Args:
            value: the value.
            alarm: what it is worth.
            at_s: when it was true, in seconds since 1970; now when missing.
        """
        if at_s is None and (value, alarm) == (self.value, RecordAlarm(self.status, self.severity)):
            return
        stamp = {} if at_s is None else {"timestamp": at_s}
        await super().write(value, verify_value=False, status=alarm.status, severity=alarm.severity, **stamp)

    async def redescribe(self, like: "RecordField") -> None:
        """Take unit, precision and limits from another field, and tell those who monitor them."""
        said = {name: getattr(like, name) for name in DESCRIPTION if hasattr(like, name)}
        if any(getattr(self, name) != value for name, value in said.items()):
            await self.write_metadata(**said)

    def native(self, value: Any) -> Value:  # noqa: ANN401
        """Return a value as this channel has it."""
        return value.decode(self.string_encoding) if isinstance(value, bytes) else value


class Number(RecordField, ChannelDouble):  # type: ignore[misc]
    """A number with a unit; a client may put it as a text, read as everywhere a person types one."""

    def native(self, value: Any) -> Value:  # noqa: ANN401
        """Return a number or the number that a text stands for.

        Raises:
            ValueError: it is none, or not finite.
        """
        given = super().native(value)
        number = read_number(given, str(self.units)) if isinstance(given, str) else given
        if not math.isfinite(number):
            raise ValueError(f"{number} is not a finite number")
        return number


class Integer(RecordField, ChannelInteger):  # type: ignore[misc]
    """A whole number."""


class ChoiceField(RecordField, ChannelEnum):  # type: ignore[misc]
    """One of some words."""

    def native(self, value: Any) -> Value:  # noqa: ANN401
        """Return a number or a word as the word.

        Raises:
            ValueError: it is neither.
        """
        word = super().native(value)
        if isinstance(word, str):
            if word not in self.enum_strings:
                raise ValueError(f"{word!r} is none of {', '.join(self.enum_strings)}")
            return word
        if not 0 <= word < len(self.enum_strings):
            raise ValueError(f"{word} is none of 0 to {len(self.enum_strings) - 1}")
        return str(self.enum_strings[int(word)])


class String(RecordField, ChannelString):  # type: ignore[misc]
    """A short text."""

    async def show(self, value: Value, alarm: RecordAlarm = NO_ALARM, at_s: float | None = None) -> None:
        """Publish a text, cut to what an EPICS string holds."""
        await super().show(str(value)[:LONGEST_STRING], alarm, at_s)


class Text(RecordField, ChannelChar):  # type: ignore[misc]
    """A text longer than EPICS strings."""

    async def show(self, value: Value, alarm: RecordAlarm = NO_ALARM, at_s: float | None = None) -> None:
        """Publish a text, cut to what the channel holds."""
        await super().show(str(value)[:LONGEST_TEXT], alarm, at_s)


def number(
    value: float = 0.0, unit: str = "", *, precision: int = 4, limits: tuple[float, float] = (0.0, 0.0)
) -> Number:
    """Return a number; limits are those of puts, 0 and 0 for none."""
    low, high = limits
    return Number(
        value=value,
        units=unit,
        precision=precision,
        lower_ctrl_limit=low,
        upper_ctrl_limit=high,
        lower_disp_limit=low,
        upper_disp_limit=high,
    )


def integer(value: int = 0) -> Integer:
    """Return a whole number."""
    return Integer(value=value)


def choice(value: str, *words: str) -> ChoiceField:
    """Return one of some words."""
    return ChoiceField(value=value, enum_strings=words)


def string(value: str = "") -> String:
    """Return a short text."""
    return String(value=value[:LONGEST_STRING])


def text(value: str = "") -> Text:
    """Return a longer text."""
    return Text(value=value, max_length=LONGEST_TEXT, string_encoding="utf-8", report_as_string=True)
