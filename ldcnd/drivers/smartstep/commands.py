"""Every command as an exchange: what to send, how to know its answer, whether it may be sent again.

Bytes that do not pass the checks are not the answer: they are FOREIGN, and reading goes on until the deadline. An error
reply is an answer and becomes a `Refusal`. There is no way to set an arbitrary address: each kind of setting has its
function, and the operating mode is an enumeration.
Repeating: reading, RAM and trace registers always; EEPROM never (each write costs life: read back first); 2000H and
2001H never (read 2000H and decide by the mode).
Source: manual 2.1, 2.2, 3, 4.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from ldcnd.drivers.smartstep.addresses import NEVER_VALID, Register, TraceRegister
from ldcnd.drivers.smartstep.operating_modes import OperatingMode, operating_mode
from ldcnd.drivers.smartstep.packet import (
    END,
    PACKET_CHARACTERS,
    Command,
    Function,
    Reply,
    ResponseStatus,
    decode_reply,
    is_upper_hex,
    sums_to_zero,
)
from ldcnd.drivers.smartstep.parameters import Parameter
from ldcnd.drivers.smartstep.profiles import RESPONSE_S, SmartStepProfile
from ldcnd.drivers.smartstep.refusals import Refusal
from ldcnd.drivers.smartstep.reply_reader import piece_bytes
from ldcnd.drivers.smartstep.status import Monitor
from ldcnd.errors import BadReply
from ldcnd.exchange import Exchange, ReplyVerdict

FLUSH = END
"""Ends whatever is in a drive's line buffer and, not being 14 characters, draws no reply."""
EXECUTE = 0x0001

ValueT = TypeVar("ValueT")


def reference(unit: int, address: int) -> Exchange[int | Refusal]:
    """Read one word, 0 to FFFFH; harmless at any address.

    Raises:
        ValueOutOfRange: unit or address does not fit.

    Source: manual 2.2, data reference command.
    """
    return _exchange(Command(unit, Function.REFERENCE, address), _word, repeatable=True)


def read_monitor(unit: int, monitor: Monitor) -> Exchange[int | Refusal]:
    """Read a status display in its own unit, with its sign.

    Source: manual 3.
    """
    return _exchange(
        Command(unit, Function.REFERENCE, monitor.address),
        lambda reply: monitor.value_of(reply.data),
        repeatable=True,
    )


def read_operating_mode(unit: int) -> Exchange[OperatingMode | int | Refusal]:
    """Read 2000H; the way to learn that a trace or a clear has finished.

    Source: manual 4, settings 1 and 2.
    """
    return _exchange(
        Command(unit, Function.REFERENCE, Register.OPERATING_MODE),
        lambda reply: operating_mode(reply.data),
        repeatable=True,
    )


def write_ram(unit: int, parameter: Parameter, value: int) -> Exchange[int | Refusal]:
    """Change a parameter until power-off; the drive itself refuses a value out of the parameter's range.

    Raises:
        ValueOutOfRange: the value does not fit 16 bits.

    Source: manual 2.2, note; 3.
    """
    return _exchange(Command(unit, Function.SETTING, parameter.ram_address, value), _word, repeatable=True)


def write_eeprom(unit: int, parameter: Parameter, value: int) -> Exchange[int | Refusal]:
    """Change a parameter for good; costs one of 10,000 writes even when the value stays the same.

    Read first and skip if equal; when the reply is lost, read back before sending again. Whether the value in use
    changes too is not known: read both addresses afterwards.

    Raises:
        ValueOutOfRange: the value does not fit 16 bits.

    Source: manual 2.2, note.
    """
    return _exchange(Command(unit, Function.SETTING, parameter.eeprom_address, value), _word, repeatable=False)


def write_trace_register(unit: int, register: TraceRegister, value: int) -> Exchange[int | Refusal]:
    """Set up the trace; refused with an address error while the drive is in Data Trace Mode.

    Raises:
        ValueOutOfRange: the value does not fit 16 bits.

    Source: manual 4, "Data setting limit" and settings 3 to 8.
    """
    return _exchange(Command(unit, Function.SETTING, register, value), _word, repeatable=True)


def set_operating_mode(unit: int, mode: OperatingMode) -> Exchange[int | Refusal]:
    """Enter a mode, or leave the present one without executing it (`NORMAL`).

    Source: manual 4, settings 1; 5 (2); 6 (2).
    """
    # Membership, not the type: an IntEnum parameter accepts a bare number at run time.
    command = Command(unit, Function.SETTING, Register.OPERATING_MODE, OperatingMode(mode))
    return _exchange(command, _word, repeatable=False)


def execute(unit: int) -> Exchange[int | Refusal]:
    """Start what the operating mode stands for; ask 2000H, not 2001H, when it has finished.

    Source: manual 4, settings 2; 5 (2); 6 (2).
    """
    return _exchange(Command(unit, Function.SETTING, Register.OPERATION, EXECUTE), _word, repeatable=False)


def probe(unit: int) -> Exchange[None]:
    """Ask for an address that never exists: the error reply proves that the unit is alive and the line in step.

    Safe on any wiring: a drive that hears an error reply does not take it for a command. No other command's reply
    carries this address, so none can pass for it. `decode` raises `BadReply` for any other answer.

    Source: manual 2.2, example 3.
    """
    command = Command(unit, Function.REFERENCE, NEVER_VALID)
    known = Reply(unit, ResponseStatus.REFERENCE_ADDRESS_ERROR, NEVER_VALID, 0).encode()

    def decode(packet: bytes) -> None:
        if packet != known:
            raise BadReply(f"unit {unit}: {packet!r} is not the known answer {known!r}")

    return Exchange(
        unit,
        command.encode(),
        PACKET_CHARACTERS,
        _checker(command),
        decode,
        RESPONSE_S,
        repeatable=True,
        total_bytes=_packet_total,
    )


def with_response_time(exchange: Exchange[ValueT], profile: SmartStepProfile) -> Exchange[ValueT]:
    """Return the exchange with the response time of a profile instead of the manual's."""
    return replace(exchange, response_s=profile.first_character_s)


def is_self_hearing(unit: int, stray: bytes) -> bool:
    """Tell whether bytes that follow a good reply show a drive that took its own reply for a command.

    On two wires a non-zero word sent by a drive is, to itself, a reference with data: it answers with a data error. A
    zero word, or a setting, would make it answer itself without end, so nothing may be written on such a line.
    """
    try:
        reply = decode_reply(stray)
    except BadReply:
        return False
    return reply.unit == unit and reply.status is ResponseStatus.REFERENCE_DATA_ERROR


def _word(reply: Reply) -> int:
    return reply.data


def _packet_total(data: bytes) -> int | None:
    return piece_bytes(data, PACKET_CHARACTERS)


def _exchange(command: Command, value_of: Callable[[Reply], ValueT], *, repeatable: bool) -> Exchange[ValueT | Refusal]:
    check = _checker(command)

    def decode(packet: bytes) -> ValueT | Refusal:
        if check(packet) is not ReplyVerdict.INTACT:
            raise BadReply(f"unit {command.unit}: {packet!r} does not answer {command.encode()!r}")
        reply = decode_reply(packet)
        if reply.status.normal:
            return value_of(reply)
        return Refusal(reply.unit, reply.status, reply.address, reply.data)

    return Exchange(
        command.unit,
        command.encode(),
        PACKET_CHARACTERS,
        check,
        decode,
        RESPONSE_S,
        repeatable,
        total_bytes=_packet_total,
    )


def _checker(command: Command) -> Callable[[bytes], ReplyVerdict]:
    """Return the judge of 14-character replies to a command: everything that is not an answer is foreign."""
    request = command.encode()
    start, address = request[:2], request[3:7]
    # A setting's reply repeats the data, good or bad (manual, examples 2, 4 and 6).
    data = request[7:11] if command.function is Function.SETTING else b""
    statuses = b"".join(b"%X" % status for status in ResponseStatus if status.function is command.function)

    def check(packet: bytes) -> ReplyVerdict:
        if (
            len(packet) == PACKET_CHARACTERS
            and packet[:2] == start
            and packet[2] in statuses
            and packet[3:7] == address
            and packet[7 : 7 + len(data)] == data
            and packet[13:] == END
            and is_upper_hex(packet[1:13])
            and sums_to_zero(packet[1:13])
        ):
            return ReplyVerdict.INTACT
        return ReplyVerdict.FOREIGN

    return check
