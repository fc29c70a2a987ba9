"""Channels of a gateway: what Channel Access clients see of a value, and what happens when they put one.

What each field of a motor record is, caproto's `MotorFields` says: its type, its words, whether it is a long string. A
field without an action is read-only, and says so to its clients. An action raises what it refuses; its client then gets
a failed put.
"""

import functools
import math
import operator
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from caproto import (
    AccessRights,
    AlarmSeverity,
    AlarmStatus,
    ChannelAlarm,
    ChannelChar,
    ChannelData,
    ChannelDouble,
    ChannelEnum,
    ChannelInteger,
    ChannelShort,
    ChannelString,
    ChannelType,
    SubscriptionType,
    native_type,
)
from caproto.server.records import MotorFields

from ldcnd.contract.number_text import behind_number, read_number

LONGEST_TEXT = 512
"""Bytes of a text that is an array of characters."""
LONGEST_STRING = 39
"""Bytes of an EPICS string."""
LONGEST_UNIT = 7
"""Bytes of a unit in what describes a number to its clients; a longer one would fail the read."""
ALL_EVENTS = functools.reduce(operator.or_, SubscriptionType)
UTF_8 = "utf-8"

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
    """A caproto channel whose puts go to an action; clients put with `write`, the gateway shows values with `show`.

    Attributes:
        action: what a put does; None when it is refused.
        explain: told why a put has no value that the channel can have.
        followers: called after each change, for those who serve the channel by another protocol.
        of_record: the alarm of the record of which it is a field, which a client may ask any of them for: it has no
            lower one (dbGet of EPICS base, options DBR_STATUS).
    """

    action: Action | None = None
    explain: Callable[[str], Awaitable[None]] | None = None

    def __init__(self, **given: Any) -> None:  # noqa: ANN401
        super().__init__(**given)
        self.followers: list[Callable[[], None]] = []
        self.of_record = self._own = NO_ALARM

    def get_field(self, name: str) -> "RecordField":
        """Return the channel for what a client names behind a dot: a variable beside a record has only its value."""
        if name not in ("", "VAL"):
            raise KeyError(name)
        return self

    # Any: caproto has no types
    def check_access(self, hostname: str, username: str) -> Any:  # noqa: ANN401, ARG002
        """Say who may do what: puts need an action."""
        return AccessRights.READ | AccessRights.WRITE if self.action else AccessRights.READ

    async def write(self, value: Any, *, wait: bool = True, **_metadata: Any) -> None:  # noqa: ANN401
        """Take a put, and return when it has had its effect, or has begun to have it; a value of None is none."""
        if self.action is None:
            raise PermissionError("this field is read-only")
        if value is None:
            raise ValueError("the put names no value")
        try:
            asked = self.native(self.preprocess_value(value))
        except ValueError as error:
            if self.explain:
                await self.explain(str(error))
            raise
        put = await self.action(asked)
        if put.value is not None:
            await self.show(put.value)
        if put.end is not None and wait:
            await put.end

    async def publish(self, flags: Any) -> None:  # noqa: ANN401
        """Send the value to those who monitor it."""
        await super().publish(flags)
        for follower in self.followers:
            follower()

    async def show(self, value: Value, alarm: RecordAlarm = NO_ALARM, at_s: float | None = None) -> None:
        """Publish a value.

        Args:
            value: the value.
            alarm: what it is worth.
            at_s: when it was true, in seconds since 1970; now when missing.
        """
        self._own = alarm
        alarm = max(alarm, self.of_record, key=lambda each: each.severity)
        if at_s is None and (value, alarm) == (self.value, RecordAlarm(self.status, self.severity)):
            return
        stamp = {} if at_s is None else {"timestamp": at_s}
        await super().write(value, verify_value=False, status=alarm.status, severity=alarm.severity, **stamp)

    async def take_alarm(self, alarm: RecordAlarm) -> None:
        """Publish the value again with the alarm that its record has now."""
        self.of_record = alarm
        await self.show(self.value, self._own)

    def begin(self, value: Value) -> None:
        """Take the first value, before there are clients."""
        self._data["value"] = value

    def begin_in_alarm(self, alarm: RecordAlarm) -> None:
        """Take the alarm of a record of which nothing is known yet, before there are clients."""
        self.of_record = alarm
        self.alarm = ChannelAlarm(status=alarm.status, severity=alarm.severity)

    def native(self, value: Any) -> Value:  # noqa: ANN401
        """Return a value as this channel has it."""
        return value.decode(self.string_encoding) if isinstance(value, bytes) else value


class Number(RecordField, ChannelDouble):  # type: ignore[misc]
    """A number with a unit; a client may put it as a text, read as everywhere a person types one.

    Attributes:
        deadbands: who monitors for one of these events is sent no value that differs by no more from the one before,
            unless its alarm does.
        convert: reads a number with a unit; None where only `units` may stand behind it.
    """

    convert: Callable[[str], float] | None = None

    def __init__(self, **given: Any) -> None:  # noqa: ANN401
        super().__init__(**given)
        self.deadbands = {SubscriptionType.DBE_VALUE: 0.0, SubscriptionType.DBE_LOG: 0.0}
        self._sent: dict[SubscriptionType, tuple[float, RecordAlarm]] = {}
        self._due = ALL_EVENTS

    def mean(self, unit: str, precision: int, limits: tuple[float, float]) -> bool:
        """Say what the value means, and tell whether that is new.

        Args:
            unit: as clients show it.
            precision: digits behind the point.
            limits: lowest and highest value that can be put; both 0 for none.
        """
        low, high = limits
        said = {"units": cut(unit, LONGEST_UNIT), "precision": precision}
        said |= {"lower_ctrl_limit": low, "lower_disp_limit": low, "upper_ctrl_limit": high, "upper_disp_limit": high}
        is_new = any(self._data[name] != value for name, value in said.items())
        self._data.update(said)
        return is_new

    async def write_from_dbr(self, data: Any, data_type: Any, metadata: Any, *, flags: int = 0) -> Any:  # noqa: ANN401
        """Take a put; a text as it is, which caproto would read by the rule of Python."""
        if native_type(data_type) is ChannelType.STRING:
            return await self.write(bytes(data[0]).rstrip(b"\0"))
        return await super().write_from_dbr(data, data_type, metadata, flags=flags)

    async def publish(self, flags: Any) -> None:  # noqa: ANN401
        """Send the value to those who monitor it, if it has left their deadband or its description is new."""
        alarm, due = RecordAlarm(self.status, self.severity), flags & SubscriptionType.DBE_PROPERTY
        for event, deadband in self.deadbands.items():
            before, its_alarm = self._sent.get(event, (math.nan, None))
            if due & SubscriptionType.DBE_PROPERTY or alarm != its_alarm or not abs(self.value - before) <= deadband:
                due |= event
                self._sent[event] = self.value, alarm
        if not due:
            self._content.clear()  # of the value before, which a read would return
            return
        self._due = due | (flags & SubscriptionType.DBE_ALARM)
        try:
            await super().publish(self._due)
        finally:
            self._due = ALL_EVENTS  # a monitor begins with the value of then

    def _is_eligible(self, ss: Any) -> bool:  # noqa: ANN401 - caproto's hook asks no mask
        return bool(ss.mask & self._due) and bool(super()._is_eligible(ss))

    def native(self, value: Any) -> Value:  # noqa: ANN401
        """Return a number or the number that a text stands for.

        Raises:
            ValueError: it is none, or not finite.
        """
        given = super().native(value)
        number = self._number_of(given) if isinstance(given, str) else given
        if not math.isfinite(number):
            raise ValueError(f"{number} is not a finite number")
        return number

    def _number_of(self, text: str) -> float:
        return self.convert(text) if self.convert and behind_number(text) else read_number(text, str(self.units))


class Integer(RecordField, ChannelInteger):  # type: ignore[misc]
    """A whole number."""


class Short(RecordField, ChannelShort):  # type: ignore[misc]
    """A small whole number."""


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
        await super().show(cut(str(value), LONGEST_STRING), alarm, at_s)


class Text(RecordField, ChannelChar):  # type: ignore[misc]
    """A text longer than EPICS strings: an array of characters, of a record's field only when its name ends in `$`."""

    async def show(self, value: Value, alarm: RecordAlarm = NO_ALARM, at_s: float | None = None) -> None:
        """Publish a text, cut to what the channel holds."""
        await super().show(cut(str(value), self.long_string_max_length), alarm, at_s)


def cut(text: str, size: int) -> str:
    """Return as much of a text as fits into some bytes."""
    return text.encode()[:size].decode(errors="ignore")


def number(value: float = 0.0, unit: str = "", *, precision: int = 4) -> Number:
    """Return a number."""
    return Number(value=value, units=cut(unit, LONGEST_UNIT), precision=precision, string_encoding=UTF_8)


def choice(value: str, *words: str) -> ChoiceField:
    """Return one of some words."""
    return ChoiceField(value=value, enum_strings=words)


def string(value: str = "") -> String:
    """Return a short text."""
    return String(value=cut(value, LONGEST_STRING), string_encoding=UTF_8)


def text(value: str = "", *, size: int = LONGEST_TEXT, is_field: bool = False) -> Text:
    """Return a longer text, of a field of a record or beside one."""
    return Text(value=cut(value, size), max_length=size, string_encoding=UTF_8, report_as_string=is_field)


def motor_fields() -> dict[str, RecordField]:
    """Return the fields of a motor record, as caproto has them and without what they are worth, by their names."""
    return {spec.name: _made(spec) for spec in (each.pvspec for each in MotorFields._pvs_.values())}


def _made(spec: Any) -> RecordField:  # noqa: ANN401
    """Return the channel that caproto describes; what is a byte there is a small number: many clients print bytes."""
    kind = ChannelType(getattr(spec.dtype, "data_type", spec.dtype))
    is_text = kind is ChannelType.CHAR and "report_as_string" in (spec.cls_kwargs or {})
    match kind:
        case ChannelType.ENUM:
            words = spec.cls_kwargs["enum_strings"]
            return choice(spec.value if spec.value in words else words[spec.value or 0], *words)
        case ChannelType.DOUBLE | ChannelType.FLOAT:
            return number(float(spec.value or 0) if isinstance(spec.value, float | int) else 0.0)
        case ChannelType.LONG:
            return Integer(value=0)
        case ChannelType.STRING:
            return string()
        case _:
            return text(size=spec.max_length, is_field=True) if is_text else Short(value=0)
