"""Every error of ldcnd: its stable code, and whether the same request may be tried again.

Families: `BusError` (the line), `DriveFault` (the drive), `RequestRefused` (the request), `ConfigError` (the
configuration). A message says what happened, to whom, with which value and which limit, and what to do.
"""

from enum import StrEnum
from typing import ClassVar


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
    NOT_REFERENCED = "not_referenced"
    STOP_LATCHED = "stop_latched"
    AXIS_UNREACHABLE = "axis_unreachable"
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
    REPLAY_DEVIATION = "replay_deviation"
    INTERNAL = "internal"


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
    retryable: ClassVar[bool] = False

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
        super().__init__(message)
        self.message = message
        self.axis = axis
        self.value = value
        self.limit = limit
        self.nearest = nearest
        self.remedy = remedy


class BusError(LdcndError):
    """Something went wrong between the host and a node."""


class ReplyTimeout(BusError):
    """No complete reply within the exchange's time; the exchange was repeatable, so nothing moved twice."""

    code = ErrorCode.REPLY_TIMEOUT
    retryable = True


class BadReply(BusError):
    """Bytes that cannot be the reply: impossible length, wrong checksum, wrong echo."""

    code = ErrorCode.BAD_REPLY
    retryable = True


class PacketRejected(BusError):
    """The node says that our packet was damaged and that it was not executed."""

    code = ErrorCode.PACKET_REJECTED
    retryable = True


class OutcomeUnknown(BusError):
    """The reply to a packet that must not be repeated was lost: it may or may not have been executed."""

    code = ErrorCode.OUTCOME_UNKNOWN


class BusDown(BusError):
    """The line is not open; nothing was sent."""

    code = ErrorCode.BUS_DOWN
    retryable = True


class BusBusy(BusError):
    """The lane's queue is full; nothing was sent."""

    code = ErrorCode.BUS_BUSY
    retryable = True


class NetworkMismatch(BusError):
    """The modules found on the line are not those of the configuration."""

    code = ErrorCode.NETWORK_MISMATCH


class TransportLost(BusError):
    """The port disappeared or was never there."""

    code = ErrorCode.BUS_DOWN
    retryable = True


class DriveFault(LdcndError):
    """The drive reports a fault that forbids the request."""

    code = ErrorCode.DRIVE_FAULT


class AddressRefused(DriveFault):
    """The drive answers with an address error: it has nothing there, or nothing that can be set."""

    code = ErrorCode.ADDRESS_ERROR


class DataRefused(DriveFault):
    """The drive answers with a data error: it does not take this value there."""

    code = ErrorCode.DATA_ERROR


class ByteCountRefused(DriveFault):
    """The drive answers with an error in the number of bytes."""

    code = ErrorCode.BYTE_COUNT_ERROR


class BusyTracing(DriveFault):
    """The drive is in Data Trace Mode and takes no setting until the trace has ended."""

    code = ErrorCode.BUSY_TRACING
    retryable = True


class RequestRefused(LdcndError):
    """The request cannot be carried out; nothing was sent to any drive."""


class MalformedRequest(RequestRefused):
    """The payload is not what the verb takes."""

    code = ErrorCode.MALFORMED_REQUEST


class PayloadTooLarge(RequestRefused):
    """The payload is larger than any request can be."""

    code = ErrorCode.PAYLOAD_TOO_LARGE


class WildcardRefused(RequestRefused):
    """A command names exactly one axis and one verb."""

    code = ErrorCode.WILDCARD_REFUSED


class UnknownVerb(RequestRefused):
    """There is no such command."""

    code = ErrorCode.UNKNOWN_VERB


class UnknownAxis(RequestRefused):
    """There is no such axis on this rig."""

    code = ErrorCode.UNKNOWN_AXIS


class NotSupported(RequestRefused):
    """This drive family or model cannot do that."""

    code = ErrorCode.NOT_SUPPORTED


class EepromBudgetSpent(RequestRefused):
    """The parameter was written to EEPROM so often that further writes are refused."""

    code = ErrorCode.EEPROM_BUDGET


class ValueOutOfRange(RequestRefused):
    """A value does not fit its register or its documented range."""

    code = ErrorCode.VALUE_OUT_OF_RANGE


class PositionLimit(RequestRefused):
    """The target is outside the software limits."""

    code = ErrorCode.POSITION_LIMIT


class VelocityLimit(RequestRefused):
    """The velocity is above the axis limit."""

    code = ErrorCode.VELOCITY_LIMIT


class AccelerationLimit(RequestRefused):
    """The acceleration is above the axis limit."""

    code = ErrorCode.ACCELERATION_LIMIT


class WrongState(RequestRefused):
    """The axis state does not allow the command."""

    code = ErrorCode.WRONG_STATE


class NotReferenced(RequestRefused):
    """The axis does not know where it is."""

    code = ErrorCode.NOT_REFERENCED


class StopLatched(RequestRefused):
    """A stop is latched; `reset` clears it."""

    code = ErrorCode.STOP_LATCHED


class AxisUnreachable(RequestRefused):
    """The drive does not answer."""

    code = ErrorCode.AXIS_UNREACHABLE
    retryable = True


class TooManyRequests(RequestRefused):
    """More requests are pending than the daemon keeps; nothing was done."""

    code = ErrorCode.TOO_MANY_REQUESTS
    retryable = True


class DuplicateDaemon(RequestRefused):
    """Two daemons serve one rig: motion is refused until one of them goes."""

    code = ErrorCode.DUPLICATE_DAEMON
    retryable = True


class ShuttingDown(RequestRefused):
    """The daemon is stopping."""

    code = ErrorCode.SHUTTING_DOWN
    retryable = True


class LeaseRequired(RequestRefused):
    """This rig moves only for those who hold a lease, and the command carries none."""

    code = ErrorCode.LEASE_REQUIRED


class LeaseHeld(RequestRefused):
    """Somebody else controls the axis."""

    code = ErrorCode.LEASE_HELD
    retryable = True


class LeaseExpired(RequestRefused):
    """The lease has ended; what was sent under it is stale."""

    code = ErrorCode.LEASE_EXPIRED


class LeaseUnknown(RequestRefused):
    """There was never such a lease."""

    code = ErrorCode.LEASE_UNKNOWN


class StaleSequence(RequestRefused):
    """The command is not newer than the last one under its lease."""

    code = ErrorCode.STALE_SEQUENCE


class CommandExpired(RequestRefused):
    """The command arrived after the instant until which its sender wanted it."""

    code = ErrorCode.COMMAND_EXPIRED


class CommandIdReused(RequestRefused):
    """The command id belongs to another command."""

    code = ErrorCode.COMMAND_ID_REUSED


class UnknownCommand(RequestRefused):
    """No such command is remembered."""

    code = ErrorCode.UNKNOWN_COMMAND


class NotPermitted(RequestRefused):
    """Whoever asks is not known, or asks from where nobody may; the console says so to browsers."""

    code = ErrorCode.NOT_PERMITTED


class ConfigError(LdcndError):
    """The configuration cannot work; nothing was opened."""

    code = ErrorCode.CONFIG_INVALID


class SessionError(LdcndError):
    """The Zenoh session could not be opened or was lost."""

    code = ErrorCode.SESSION_FAILED
    retryable = True


class ReplayDeviation(LdcndError):
    """The daemon that a capture is played to does not send what was sent when the capture was made."""

    code = ErrorCode.REPLAY_DEVIATION


class InternalError(LdcndError):
    """A bug in ldcnd; the log has the traceback."""

    code = ErrorCode.INTERNAL
