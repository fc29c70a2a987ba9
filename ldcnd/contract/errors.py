"""Every error of ldcnd: its stable code, and whether the same request may be tried again.

Families: `BusError` (the line), `DriveFault` (the drive), `RequestRefused` (the request), `ConfigError` (the
configuration). A message says what happened, to whom, with which value and which limit, and what to do.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import ClassVar, Self

from ldcnd.contract.fault_pages import page_of
from ldcnd.printable import printable


class ErrorCode(StrEnum):
    """The closed list of codes that a caller may see; never renamed, only added to."""

    # the line
    REPLY_TIMEOUT = "reply_timeout"
    BAD_REPLY = "bad_reply"
    PACKET_REJECTED = "packet_rejected"
    OUTCOME_UNKNOWN = "outcome_unknown"
    BUS_DOWN = "bus_down"
    BUS_BUSY = "bus_busy"
    NETWORK_MISMATCH = "network_mismatch"
    # the drive
    DRIVE_FAULT = "drive_fault"
    TRACE_TIMED_OUT = "trace_timed_out"
    ADDRESS_ERROR = "address_error"
    DATA_ERROR = "data_error"
    BYTE_COUNT_ERROR = "byte_count_error"
    BUSY_TRACING = "busy_tracing"
    # the request
    MALFORMED_REQUEST = "malformed_request"
    PAYLOAD_TOO_LARGE = "payload_too_large"
    WILDCARD_REFUSED = "wildcard_refused"
    UNKNOWN_VERB = "unknown_verb"
    UNKNOWN_AXIS = "unknown_axis"
    NOT_SUPPORTED = "not_supported"
    EEPROM_BUDGET = "eeprom_budget"
    VALUE_OUT_OF_RANGE = "value_out_of_range"
    POSITION_LIMIT = "position_limit"
    VELOCITY_LIMIT = "velocity_limit"
    ACCELERATION_LIMIT = "acceleration_limit"
    WRONG_STATE = "wrong_state"
    REGISTER_UNKNOWN = "register_unknown"
    NOT_REFERENCED = "not_referenced"
    INTERLOCK_VIOLATED = "interlock_violated"
    STOP_LATCHED = "stop_latched"
    STOP_UNCONFIRMED = "stop_unconfirmed"
    ABORTED = "aborted"
    AXIS_UNREACHABLE = "axis_unreachable"
    NOT_IDENTIFIED = "not_identified"
    TOO_MANY_REQUESTS = "too_many_requests"
    DUPLICATE_DAEMON = "duplicate_daemon"
    SHUTTING_DOWN = "shutting_down"
    # authority
    LEASE_REQUIRED = "lease_required"
    LEASE_HELD = "lease_held"
    LEASE_EXPIRED = "lease_expired"
    LEASE_UNKNOWN = "lease_unknown"
    STALE_SEQUENCE = "stale_sequence"
    COMMAND_EXPIRED = "command_expired"
    COMMAND_ID_REUSED = "command_id_reused"
    UNKNOWN_COMMAND = "unknown_command"
    NOT_PERMITTED = "not_permitted"
    # the daemon
    CONFIG_INVALID = "config_invalid"
    SESSION_FAILED = "session_failed"
    INTERNAL = "internal"


Argument = bool | float | str | tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RemedyCommand:
    """A command that a remedy names; every face says it in its own way: to be typed, or to be pressed.

    Attributes:
        verb: the command.
        said: how the text of the remedy names it.
        arguments: what it is to carry.
    """

    verb: str
    said: str
    arguments: Mapping[str, Argument] = field(default_factory=dict)


def step(verb: str, said: str | None = None, **arguments: Argument) -> RemedyCommand:
    """Return a step; without words of its own a remedy says "send" and the verb."""
    return RemedyCommand(verb, said or f"send {verb}", arguments)


class Remedy(str):
    """The remedy of an error: a text that names commands.

    Args:
        text: with `{}` for each step.
        steps: the commands, in their order.
    """

    __slots__ = ("steps",)
    steps: tuple[RemedyCommand, ...]

    def __new__(cls, text: str, *steps: RemedyCommand) -> Self:
        """Return the text with what the steps are called."""
        said = []
        for each in steps:  # a stop makes a remedy: no generator, no call more
            said.append(each.said)  # noqa: PERF401
        made = super().__new__(cls, text.format(*said))
        made.steps = steps
        return made

    @classmethod
    def of(cls, text: str, steps: tuple[RemedyCommand, ...]) -> Self:
        """Return a text that names the steps already."""
        made = super().__new__(cls, text)
        made.steps = steps
        return made

    def phrased(self, words: Callable[[RemedyCommand], str]) -> str:
        """Return the text with other words for its steps."""
        text = str(self)
        for each in self.steps:
            text = text.replace(each.said, words(each), 1)
        return text


class LdcndError(Exception):
    """Root of all errors that ldcnd raises on purpose.

    Args:
        message: one sentence for a person: what, to whom, which value, which limit.
        axis: the axis or node concerned, if there is one.
        value: the offending value, in the unit the caller used.
        limit: the limit it broke.
        nearest: the closest value that would be accepted.
        remedy: what to do about it, if that is known.
    """

    code: ClassVar[ErrorCode] = ErrorCode.INTERNAL
    """The class's name on the wire."""
    retryable: ClassVar[bool] = False
    """The same request may be sent again without harm and may then succeed."""
    way_out: ClassVar[str] = "see the message"
    """The remedy for errors of this class; `remedy` is that for one error."""

    def __init__(
        self,
        message: str,
        *,
        axis: str | None = None,
        value: float | str | None = None,
        limit: float | str | None = None,
        nearest: float | None = None,
        remedy: str | None = None,
    ) -> None:
        # a message repeats untrusted text, and is printed on terminals and in logs
        self.message = printable(message, keep="\n")
        super().__init__(self.message)
        self.axis = axis if axis is None else printable(axis)
        self.value = printable(value) if isinstance(value, str) else value
        self.limit = printable(limit) if isinstance(limit, str) else limit
        self.nearest = nearest
        self.remedy: Remedy | None = None
        if remedy is not None:
            text = printable(remedy, keep="\n")
            if isinstance(remedy, Remedy):
                self.remedy = remedy if text == remedy else Remedy.of(text, remedy.steps)
            else:
                self.remedy = Remedy.of(text, ())

    def although(self, done: str) -> Self:
        """Return this error with other words before its message: what was carried out all the same, or what for."""
        return type(self)(
            f"{done} {self.message}",
            axis=self.axis,
            value=self.value,
            limit=self.limit,
            nearest=self.nearest,
            remedy=self.remedy,
        )

    @property
    def page(self) -> str | None:
        """Path of its page below a console or the documentation: what to check, how to clear it."""
        return page_of(self.code)


class BusError(LdcndError):
    """Something went wrong between the host and a node."""


class ReplyTimeout(BusError):
    """No complete reply within the exchange's time; the exchange was repeatable, so nothing moved twice."""

    code = ErrorCode.REPLY_TIMEOUT
    retryable = True
    way_out = "check power, address and cable of the drive"


class BadReply(BusError):
    """Bytes that cannot be the reply: impossible length, wrong checksum, wrong echo."""

    code = ErrorCode.BAD_REPLY
    retryable = True
    way_out = "check cable, termination and baud rate; another master on the line?"


class PacketRejected(BusError):
    """The node says that our packet was damaged and that it was not executed."""

    code = ErrorCode.PACKET_REJECTED
    retryable = True
    way_out = "check cable, termination and baud rate"


class OutcomeUnknown(BusError):
    """The reply to a packet that must not be repeated was lost: it may or may not have been executed."""

    code = ErrorCode.OUTCOME_UNKNOWN
    way_out = "look where the axis is before anything else is sent"


class BusDown(BusError):
    """The line is not open; nothing was sent."""

    code = ErrorCode.BUS_DOWN
    retryable = True
    way_out = "check the adapter and its cable; the line is opened again by itself"


class BusBusy(BusError):
    """The lane's queue is full; nothing was sent."""

    code = ErrorCode.BUS_BUSY
    retryable = True
    way_out = "send commands more slowly"


class NetworkMismatch(BusError):
    """The modules found on the line are not those of the configuration."""

    code = ErrorCode.NETWORK_MISMATCH
    way_out = "correct the wiring or the configuration; the message lists every difference"


class TransportLost(BusError):
    """The port disappeared or was never there."""

    code = ErrorCode.BUS_DOWN
    retryable = True
    way_out = "check the adapter and its cable; the line is opened again by itself"


class DriveFault(LdcndError):
    """The drive reports a fault that forbids the request."""

    code = ErrorCode.DRIVE_FAULT
    way_out = "remove the cause, then send `reset`"

    @property
    def page(self) -> str | None:
        """The page of the fault that `value` names, or that of the error."""
        return (page_of(self.value) if isinstance(self.value, str) else None) or super().page


class TraceTimedOut(DriveFault):
    """The trigger of a trace did not come, or its samples did not, in the time allowed."""

    code = ErrorCode.TRACE_TIMED_OUT
    way_out = "look whether the channel reaches the level of the trigger, or wait longer for it"


class AddressRefused(DriveFault):
    """The drive answers with an address error: it has nothing there, or nothing that can be set."""

    code = ErrorCode.ADDRESS_ERROR
    way_out = "use a number that the manual of the drive lists"


class DataRefused(DriveFault):
    """The drive answers with a data error: it does not take this value there."""

    code = ErrorCode.DATA_ERROR
    way_out = "use a value of the range that the manual of the drive gives"


class ByteCountRefused(DriveFault):
    """The drive answers with an error in the number of bytes."""

    code = ErrorCode.BYTE_COUNT_ERROR
    way_out = "report it, with the log: the drive does not know this form of request"


class BusyTracing(DriveFault):
    """The drive is in Data Trace Mode and takes no setting until the trace has ended."""

    code = ErrorCode.BUSY_TRACING
    retryable = True
    way_out = "wait for the end of the trace, or send `trace_abort`"


class RequestRefused(LdcndError):
    """The request cannot be carried out; nothing was sent to any drive."""


class MalformedRequest(RequestRefused):
    """The payload is not what the verb takes."""

    code = ErrorCode.MALFORMED_REQUEST
    way_out = "correct the payload; the message names the field and what is allowed"


class PayloadTooLarge(RequestRefused):
    """The payload is larger than any request can be."""

    code = ErrorCode.PAYLOAD_TOO_LARGE
    way_out = "send less than 16 KiB"


class WildcardRefused(RequestRefused):
    """A command names exactly one axis and one verb."""

    code = ErrorCode.WILDCARD_REFUSED
    way_out = "send one command for each axis"


class UnknownVerb(RequestRefused):
    """There is no such command."""

    code = ErrorCode.UNKNOWN_VERB
    way_out = "see `meta/commands`"


class UnknownAxis(RequestRefused):
    """There is no such axis on this rig."""

    code = ErrorCode.UNKNOWN_AXIS
    way_out = "see `meta/daemon`"


class NotSupported(RequestRefused):
    """This drive family or model cannot do that."""

    code = ErrorCode.NOT_SUPPORTED
    way_out = "see the capabilities in `meta/axes/<axis>`"


class EepromBudgetSpent(RequestRefused):
    """The EEPROM of the drive was written so often that further writes are refused."""

    code = ErrorCode.EEPROM_BUDGET
    way_out = "write to RAM, or raise the budget in the configuration"


class ValueOutOfRange(RequestRefused):
    """A value does not fit its register or its documented range."""

    code = ErrorCode.VALUE_OUT_OF_RANGE
    way_out = "use the nearest value of the reply"


class PositionLimit(RequestRefused):
    """The target is outside the software limits."""

    code = ErrorCode.POSITION_LIMIT
    way_out = "use the nearest value of the reply, or change the limits"


class VelocityLimit(RequestRefused):
    """The velocity is above the axis limit."""

    code = ErrorCode.VELOCITY_LIMIT
    way_out = "use the nearest value of the reply, or change the limits"


class AccelerationLimit(RequestRefused):
    """The acceleration is above the axis limit."""

    code = ErrorCode.ACCELERATION_LIMIT
    way_out = "use the nearest value of the reply, or change the limits"


class WrongState(RequestRefused):
    """The axis state does not allow the command."""

    code = ErrorCode.WRONG_STATE
    way_out = "the reply says which command leads out of the state"


class RegisterUnknown(WrongState):
    """What a register of the drive holds is not known, and the command depends on it; nothing was sent."""

    code = ErrorCode.REGISTER_UNKNOWN
    way_out = "send what writes the register; the message names it"


class InterlockViolated(RequestRefused):
    """A requirement that the configuration puts on this motion or output does not hold, or is not known to."""

    code = ErrorCode.INTERLOCK_VIOLATED
    retryable = True
    way_out = "see to it that the requirement holds; the message names it"
    may_wait = False
    """Whether a refused level may be written later: every lack is only not known yet, or the line is no output yet."""


class NotReferenced(RequestRefused):
    """The axis does not know where it is."""

    code = ErrorCode.NOT_REFERENCED
    way_out = "send `home` or `set_position`"


class StopLatched(RequestRefused):
    """A stop is latched; `reset` clears it."""

    code = ErrorCode.STOP_LATCHED
    way_out = "send `reset`"


class StopNotConfirmed(StopLatched):
    """The drive has not confirmed a stop, latched or not."""

    code = ErrorCode.STOP_UNCONFIRMED
    way_out = "give the drive power and look after its line: the stop is sent again until the drive confirms it"


class CommandAborted(RequestRefused):
    """Another command, a halt, a stop or a loss policy ended the command early, or came before it began."""

    code = ErrorCode.ABORTED
    way_out = "look at the events: they tell what ended it"


class AxisUnreachable(RequestRefused):
    """The drive does not answer."""

    code = ErrorCode.AXIS_UNREACHABLE
    retryable = True
    way_out = "check power of the drive and the line"


class NotIdentified(RequestRefused):
    """What answers is not proven to be what is configured, on a line that is taken over; it may only be stopped."""

    code = ErrorCode.NOT_IDENTIFIED
    retryable = True
    way_out = "correct the wiring or the configuration; the message says what was expected and what answers"


class TooManyRequests(RequestRefused):
    """More requests are pending than the daemon keeps; nothing was done."""

    code = ErrorCode.TOO_MANY_REQUESTS
    retryable = True
    way_out = "wait for replies before sending more"


class DuplicateDaemon(RequestRefused):
    """Two daemons serve one rig: motion is refused until one of them goes."""

    code = ErrorCode.DUPLICATE_DAEMON
    retryable = True
    way_out = "end one of the two daemons"


class ShuttingDown(RequestRefused):
    """The daemon is stopping."""

    code = ErrorCode.SHUTTING_DOWN
    retryable = True
    way_out = "wait until the daemon is back"


class LeaseRequired(RequestRefused):
    """This rig moves only for those who hold a lease, and the command carries none."""

    code = ErrorCode.LEASE_REQUIRED
    way_out = "send `acquire` first"


class LeaseHeld(RequestRefused):
    """Another client controls the axis."""

    code = ErrorCode.LEASE_HELD
    retryable = True
    way_out = "wait until it is released, or acquire it with `force`"


class LeaseExpired(RequestRefused):
    """The lease has ended; what was sent under it is stale."""

    code = ErrorCode.LEASE_EXPIRED
    way_out = "acquire a new lease; do not send the old command again unless it is still wanted"


class LeaseUnknown(RequestRefused):
    """There was never such a lease."""

    code = ErrorCode.LEASE_UNKNOWN
    way_out = "send `acquire` first"


class StaleSequence(RequestRefused):
    """The command is not newer than the last one under its lease."""

    code = ErrorCode.STALE_SEQUENCE
    way_out = "number commands upwards"


class CommandExpired(RequestRefused):
    """The command comes later, or behind another stop, than its sender wanted."""

    code = ErrorCode.COMMAND_EXPIRED
    way_out = "send it again, with a new id, if it is still wanted"


class CommandIdReused(RequestRefused):
    """The command id belongs to another command."""

    code = ErrorCode.COMMAND_ID_REUSED
    way_out = "give every command an id of its own"


class UnknownCommand(RequestRefused):
    """No such command is remembered."""

    code = ErrorCode.UNKNOWN_COMMAND
    way_out = "look at the events"


class NotPermitted(RequestRefused):
    """The sender is unknown, or its origin is not permitted; the console says so to browsers."""

    code = ErrorCode.NOT_PERMITTED
    way_out = "open the console with the link that it prints"


class ConfigError(LdcndError):
    """The configuration cannot work; nothing was opened."""

    code = ErrorCode.CONFIG_INVALID
    way_out = "correct the configuration; the message names file, key and what is allowed"


class SessionError(LdcndError):
    """The Zenoh session could not be opened or was lost."""

    code = ErrorCode.SESSION_FAILED
    retryable = True
    way_out = "check the endpoint, and that the daemon runs"


class InternalError(LdcndError):
    """A bug in ldcnd; the log has the traceback."""

    code = ErrorCode.INTERNAL
    way_out = "report it, with the log"


def _classes(root: type[LdcndError] = LdcndError) -> Iterator[type[LdcndError]]:
    for derived in root.__subclasses__():
        yield derived
        yield from _classes(derived)


ERRORS: Mapping[str, type[LdcndError]] = MappingProxyType(
    {code: next(error for error in _classes() if vars(error).get("code") is code) for code in ErrorCode}
)
"""The class that an error reply is rebuilt to, by code; the first one where two share a code."""
