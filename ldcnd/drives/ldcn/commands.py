"""LDCN/NMC commands as the host sends them: for each a function from a destination and values to an `Exchange`.

A destination is one answering module (`Node`) or a silent `LeaderlessGroup`. No state of a module is kept here: its
default status items travel with its `Node`. The other direction is in received.py. Commands that not every dialect has
are refused for the others, and so is everything that could move a module which ldcnd only identifies.
Sources: LS-182AP manual, "Addressing", "Command Description"; PIC-SERVO manual, 4.1, 5.2; for PIC-SERVO SC later vendor
data sheets.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Generic, TypeVar

from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import (
    IoOption,
    LimitPins,
    StopControl,
    check_homing,
    check_stop,
)
from ldcnd.drives.ldcn.packet import (
    ADDRESS,
    GROUP_ADDRESS,
    GROUP_MEMBER,
    MOST_ADDRESS,
    POSITION,
    STATUS_BYTE_ONLY,
    CommandCode,
    Packet,
    StatusItem,
    StatusPacket,
    check_status,
    encode_packet,
    status_bytes,
    status_decoder,
)
from ldcnd.drives.ldcn.profiles import CLOCK_HZ, CYCLE_CLOCKS, HomingControl, Profile, Support
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S, BaudCodes, baud_divisor, encode_gains
from ldcnd.drives.ldcn.trajectory import PathPoint, Trajectory, encode_points, encode_trajectory
from ldcnd.line.exchange import Exchange, PacketEffect, ReplyVerdict
from ldcnd.line.settings import HOST_LATE_S

ReplyT = TypeVar("ReplyT")


class Destination(ABC, Generic[ReplyT]):
    """Who takes a packet, and with what type of reply.

    Attributes:
        address: the address byte.
        profile: the dialect of everyone concerned; None when it is not known.
    """

    __slots__ = ()

    address: int
    profile: Profile | None

    @abstractmethod
    def exchange(
        self, request: bytes, items: StatusItem | None, *, repeatable: bool, effect: PacketEffect = PacketEffect.CHANGES
    ) -> Exchange[ReplyT]:
        """Pair a request with its reply: these status items, or those sent by default when None."""


@dataclass(frozen=True, slots=True)
class Node(Destination[StatusPacket]):
    """One module, or a group whose leader answers as if it had been meant alone.

    Attributes:
        address: 0 (no address yet) to 127; 128 to 255 for a group with a leader.
        profile: the dialect of the answering module; in a group the others share it where the command depends on it.
        items: what it adds to every reply, that is, the mask of the last Define Status.
    """

    address: int
    profile: Profile
    items: StatusItem = STATUS_BYTE_ONLY

    def __post_init__(self) -> None:
        """Refuse an address that does not fit its byte."""
        if not 0 <= self.address <= MOST_ADDRESS:
            raise ValueOutOfRange(
                f"node address {self.address} is outside 0 to {MOST_ADDRESS}", value=self.address, limit=MOST_ADDRESS
            )

    def exchange(
        self, request: bytes, items: StatusItem | None, *, repeatable: bool, effect: PacketEffect = PacketEffect.CHANGES
    ) -> Exchange[StatusPacket]:
        """See `Destination`.

        Raises:
            NotSupported: of this module nothing but status byte and identity can be decoded.
        """
        # after Read Status, too, "subsequent status packets will include only the data bytes previously specified"
        # (PIC-SERVO manual, 5.2)
        asked = self.items if items is None else items
        if self.profile.support is Support.IDENTIFY and asked & ~StatusItem.IDENTITY:
            raise NotSupported(f"{self.profile.title}: only status byte and identity can be decoded, not {asked!r}")
        reply_bytes, total_bytes = status_bytes(self.profile, asked), None
        if asked != self.items:
            total_bytes = partial(_total_bytes, status_bytes(self.profile, self.items), reply_bytes)
        return Exchange(
            node=self.address,
            request=request,
            reply_bytes=reply_bytes,
            check=check_status,
            decode=status_decoder(self.profile, asked),
            # "stored in an internal buffer until the end of the current servo cycle (0.51 millisec. max.)" (ibid., 4.1)
            response_s=CYCLE_CLOCKS / self.profile.clock_hz,
            repeatable=repeatable,
            total_bytes=total_bytes,
            effect=effect,
        )


@dataclass(frozen=True, slots=True)
class LeaderlessGroup(Destination[None]):
    """All modules of a group without a leader: none answers, and the line rests until the command is executed.

    Attributes:
        address: 0x80 to 0xFF.
        profile: the dialect that all members share; needed only for what not every dialect has alike.
        cycle_s: their servo cycle.
    """

    address: int
    profile: Profile | None = None
    cycle_s: float = SERVO_CYCLE_S

    def __post_init__(self) -> None:
        """Refuse what is not a group address."""
        GROUP_ADDRESS.check(self.address)

    def exchange(
        self,
        request: bytes,
        items: StatusItem | None,  # noqa: ARG002 - no module answers
        *,
        repeatable: bool,
        effect: PacketEffect = PacketEffect.CHANGES,
    ) -> Exchange[None]:
        """See `Destination`; the manuals require 0.51 ms of quiet."""
        return unanswered(self.address, request, group_quiet_s(self.cycle_s), repeatable=repeatable, effect=effect)


def _total_bytes(rejected_bytes: int, reply_bytes: int, data: bytes) -> int:
    """A module that rejects a packet has not read its status mask: it answers with the default items."""
    return rejected_bytes if data[0] & 0x02 else reply_bytes  # StatusFlag.CHECKSUM_ERROR


def unanswered(
    address: int, request: bytes, quiet_s: float, *, repeatable: bool, effect: PacketEffect = PacketEffect.CHANGES
) -> Exchange[None]:
    """Return an exchange that draws no reply and keeps the line quiet for a while."""
    return Exchange(
        node=address,
        request=request,
        reply_bytes=0,
        check=_unexpected,
        decode=_nothing,
        response_s=quiet_s,
        repeatable=repeatable,
        effect=effect,
    )


def spaced(packets: Sequence[bytes], byte_s: float, cycle_s: float = SERVO_CYCLE_S) -> bytes:
    """Return group packets as one piece in which each is executed before the next one comes.

    "The host should wait for at least 0.51 milliseconds before sending another command to keep from overwriting the
    previous command" (PIC-SERVO manual, 4.1). Nulls fill the time: outside a packet modules skip them, and they keep
    the distance whatever an adapter does to the piece as a whole.
    """
    # "each module will ignore any incoming data until it sees a header byte" (PIC-SERVO manual, 4.1)
    gap = bytes(math.ceil(cycle_s / byte_s))
    return gap.join(packets)


def _unexpected(_data: bytes) -> ReplyVerdict:
    return ReplyVerdict.CORRUPT


def _nothing(_data: bytes) -> None:
    return None


def group_quiet_s(cycle_s: float = SERVO_CYCLE_S) -> float:
    """Return the pause behind a packet to a silent group.

    0.51 ms (PIC-SERVO manual, 4.1), which is a servo cycle, from when an adapter has sent it.
    """
    return cycle_s + HOST_LATE_S


RESET_SETTLE_S = 0.1
"""Time for a module to restart after Hard Reset, seconds; the manuals name no time."""
COMMON_TOP_BAUD = 125_000
"""The highest rate of any model but PIC-SERVO SC; which rates a model has is checked with the configuration."""
COMMON_COMMANDS = frozenset(
    {
        CommandCode.SET_ADDRESS,
        CommandCode.DEFINE_STATUS,
        CommandCode.READ_STATUS,
        CommandCode.SET_BAUD_RATE,
        CommandCode.NO_OPERATION,
        CommandCode.HARD_RESET,
    }
)
"""Commands of every module, servo or not."""
EFFECTS = {
    CommandCode.READ_STATUS: PacketEffect.READS,
    CommandCode.NO_OPERATION: PacketEffect.READS,
    CommandCode.SET_ADDRESS: PacketEffect.ARRANGES,
    CommandCode.DEFINE_STATUS: PacketEffect.ARRANGES,
    CommandCode.SET_BAUD_RATE: PacketEffect.ARRANGES,
    CommandCode.HARD_RESET: PacketEffect.ARRANGES,
}
"""All others change something; Stop Motor, which does not only stop, by its control byte."""
UNSEEN = frozenset(
    {CommandCode.LOAD_TRAJECTORY, CommandCode.SET_GAIN, CommandCode.SET_HOMING_MODE, CommandCode.IO_CONTROL}
)
"""What no status item reads back."""
RELIEVING = frozenset(
    {
        StopControl(0),
        StopControl.MOTOR_OFF,
        StopControl.ABRUPT,
        StopControl.SMOOTH,
        StopControl.AMP_ENABLE | StopControl.ABRUPT,
        StopControl.AMP_ENABLE | StopControl.SMOOTH,
    }
)
"""Control bytes of Stop Motor that stop a motor or switch it off, and do nothing else."""


def reset_position(to: Destination[ReplyT]) -> Exchange[ReplyT]:
    """Set position counter and command position to 0; not to be sent during a trapezoidal move."""
    # executed a second time, it would lose what the motor has turned meanwhile
    return _exchange(to, CommandCode.RESET_POSITION, repeatable=False)


def set_address(to: Destination[ReplyT], address: int, group: int, *, leader: bool = False) -> Exchange[ReplyT]:
    """Give a module its addresses; the first time, the next module in the chain wakes up at address 0.

    Args:
        to: the module, `Node(0, ...)` while it has no address. It answers, in the old layout, from its new address.
        address: individual address, 1 to 127.
        group: group address, 0x80 to 0xFF.
        leader: this module answers for its group.

    Raises:
        ValueOutOfRange: an address is outside its range.
    """
    GROUP_ADDRESS.check(group)
    # "if a PIC-SERVO is to be a group leader, clear bit 7 of the desired group address in the second data byte"
    # (PIC-SERVO manual, 5.2, "Set Address")
    data = ADDRESS.encode(address) + bytes((group & ~GROUP_MEMBER if leader else group,))
    # a second one would reach whoever waits at this address by then: the first one lets the next module receive
    return _exchange(to, CommandCode.SET_ADDRESS, data, repeatable=False)


def define_status(to: Destination[ReplyT], items: StatusItem) -> Exchange[ReplyT]:
    """Choose what the module adds to every reply, this one included; keep `Node.items` in step.

    Raises:
        NotSupported: the layout of these items is not known for this module.
    """
    # its own reply has them already: "the status packet returned in response to this command will include" them (ibid.)
    return _exchange(to, CommandCode.DEFINE_STATUS, bytes((items,)), items=items)


def read_status(to: Destination[ReplyT], items: StatusItem) -> Exchange[ReplyT]:
    """Request these items once instead of the default ones.

    Raises:
        NotSupported: the layout of these items is not known for this module.
    """
    return _exchange(to, CommandCode.READ_STATUS, bytes((items,)), items=items)


def load_trajectory(to: Destination[ReplyT], trajectory: Trajectory) -> Exchange[ReplyT]:
    """Load motion registers, and start at once if the trajectory says so; only then it must not be repeated.

    Raises:
        ValueOutOfRange: a value does not fit its register.
        NotSupported: see `encode_trajectory`.
    """
    data = encode_trajectory(_dialect(to), trajectory)
    # "if bit 7 is clear, the command data will be buffered" (PIC-SERVO manual, 5.2): the same bytes again do no harm
    return _exchange(to, CommandCode.LOAD_TRAJECTORY, data, repeatable=not trajectory.start_now)


def start_motion(to: Destination[ReplyT]) -> Exchange[ReplyT]:
    """Execute the trajectory loaded last."""
    # a second one would begin a motion again that has ended, or that was stopped meanwhile
    return _exchange(to, CommandCode.START_MOTION, repeatable=False)


def set_gain(to: Destination[ReplyT], gains: Gains) -> Exchange[ReplyT]:
    """Load the position loop, its limits and the servo rate; they act from the next servo tick on.

    Raises:
        ValueOutOfRange: a value does not fit its register.
        NotSupported: the module lacks a register that is not at its default.
    """
    return _exchange(to, CommandCode.SET_GAIN, encode_gains(_dialect(to), gains))


def stop_motor(to: Destination[ReplyT], control: StopControl, position: int | None = None) -> Exchange[ReplyT]:
    """Stop in one stop mode, or only switch the amplifier; always safe to repeat.

    With the loop open the modes that stop close it, for which there is `close_loop`.

    Args:
        to: who stops.
        control: amplifier enable and at most one stop mode.
        position: in counts, where HERE goes without a profile; absolute.

    Raises:
        ValueOutOfRange: a bad combination of bits, or the position is missing, superfluous or does not fit.
        NotSupported: the module lacks this stop mode.
    """
    check_stop(control, to.profile)
    if (position is not None) != bool(control & StopControl.HERE):
        raise ValueOutOfRange("Stop Motor takes a position exactly with the bit for stopping here", value=position)
    data = bytes((control,)) + (POSITION.encode(position) if position is not None else b"")
    # HERE moves the motor, and the bits of the lock and of the advanced features change more than a stop does
    effect = PacketEffect.RELIEVES if control in RELIEVING else PacketEffect.CHANGES
    return _exchange(to, CommandCode.STOP_MOTOR, data, effect=effect)


def close_loop(to: Destination[ReplyT]) -> Exchange[ReplyT]:
    """Close the loop at the present position: the bytes of an abrupt stop, which take energy out of a closed loop."""
    # "if the velocity servo was previously disabled, the motor will simply start servoing to its current position"
    # (PIC-SERVO manual, 5.2, "Stop Motor")
    control = StopControl.AMP_ENABLE | StopControl.ABRUPT
    return _exchange(to, CommandCode.STOP_MOTOR, bytes((control,)), effect=PacketEffect.CHANGES)


def io_control(to: Destination[ReplyT], pins: LimitPins, *, fast_path: bool = False) -> Exchange[ReplyT]:
    """Set direction and level of the limit switch pins, on PIC-SERVO CMC the path rate, too.

    Raises:
        NotSupported: the module is no PIC-SERVO version 4 or CMC; elsewhere the command is unused or means something
            else. Or it has no fast path.
    """
    profile = _dialect(to)
    if not profile.limit_outputs:
        raise NotSupported(f"{profile.title} has no limit pins that can be outputs")
    if fast_path and not profile.path_points:
        raise NotSupported(f"{profile.title} has no path mode")
    return _exchange(to, CommandCode.IO_CONTROL, bytes((pins | (IoOption.FAST_PATH if fast_path else 0),)))


def add_path_points(
    to: Destination[ReplyT], points: Sequence[PathPoint], *, fast_path: bool = False
) -> Exchange[ReplyT]:
    """Append 1 to 7 points to the path; the host sees to it that the buffer has room for them.

    Raises:
        NotSupported: the module has no path mode.
        ValueOutOfRange: a point does not fit, or there are too many.
    """
    data = encode_points(_dialect(to), points, fast_path=fast_path)
    # a point says how far to go from the one before: sent twice it moves the rest of the path
    return _exchange(to, CommandCode.ADD_PATH_POINTS, data, repeatable=False)


def start_path(to: Destination[ReplyT]) -> Exchange[ReplyT]:
    """Start the path through the points loaded until now.

    Raises:
        NotSupported: the module has no path mode.
    """
    if not _dialect(to).path_points:
        raise NotSupported(f"{_dialect(to).title} has no path mode")
    # without points the same command starts the path (PIC-SERVO SC data sheet, 5.2)
    return _exchange(to, CommandCode.ADD_PATH_POINTS, repeatable=False)


def set_homing(to: Destination[ReplyT], control: HomingControl) -> Exchange[ReplyT]:
    """Arm the capture of the home position on a change of any of the sources; 0 disarms.

    Raises:
        ValueOutOfRange: a bad combination of bits.
        NotSupported: the module lacks a source, or does not stop on home.
    """
    check_homing(control, to.profile)
    # every one captures anew: "the home_in_progress bit in the status byte is set when this command is issued"
    return _exchange(to, CommandCode.SET_HOMING_MODE, bytes((control,)))


def set_baud(
    to: LeaderlessGroup, baud: int, codes: BaudCodes = BaudCodes.MANUAL, clock_hz: int = CLOCK_HZ
) -> Exchange[None]:
    """Change the rate of all modules; the host changes its own before it sends anything else.

    Only for a group without a leader, as the manuals insist: a reply would come at the new rate.

    Raises:
        ValueOutOfRange: no code is known for this rate, or the modules do not reach it.
    """
    top = to.profile.top_baud if to.profile else COMMON_TOP_BAUD
    if baud > top:
        raise ValueOutOfRange(f"{baud} baud is above {top}", value=baud, limit=top, nearest=top)
    # once more at the old rate it is noise to those that have obeyed, and nothing tells whether any has not
    return _exchange(to, CommandCode.SET_BAUD_RATE, bytes((baud_divisor(baud, codes, clock_hz),)), repeatable=False)


def clear_sticky_bits(to: Destination[ReplyT]) -> Exchange[ReplyT]:
    """Clear position error, position wrap, servo overrun and current limiting as far as their causes are gone."""
    return _exchange(to, CommandCode.CLEAR_STICKY_BITS)


def save_home(to: Destination[ReplyT]) -> Exchange[ReplyT]:
    """Save the present position in the home register."""
    # a second one would save the place that the motor has reached by then
    return _exchange(to, CommandCode.SAVE_CURRENT_POSITION_AS_HOME, repeatable=False)


def no_operation(to: Destination[ReplyT]) -> Exchange[ReplyT]:
    """Do nothing but draw a reply."""
    return _exchange(to, CommandCode.NO_OPERATION)


def hard_reset(to: Node | LeaderlessGroup) -> Exchange[None]:
    """Put modules back into the state after power-up: 19200 baud, address 0, motor off; not answered."""
    # "no status will be returned" (PIC-SERVO manual, 5.2, "Hard Reset"): whether it was executed is seen by its effect
    request = encode_packet(Packet(to.address, CommandCode.HARD_RESET))
    return unanswered(to.address, request, RESET_SETTLE_S, repeatable=False, effect=EFFECTS[CommandCode.HARD_RESET])


def _exchange(
    to: Destination[ReplyT],
    command: CommandCode,
    data: bytes = b"",
    *,
    items: StatusItem | None = None,
    repeatable: bool = True,
    effect: PacketEffect | None = None,
) -> Exchange[ReplyT]:
    if to.profile and to.profile.support is Support.IDENTIFY and command not in COMMON_COMMANDS:
        raise NotSupported(f"{to.profile.title} is only identified: it takes no {command.name}")
    request = encode_packet(Packet(to.address, command, data))
    effect = effect or EFFECTS.get(command, PacketEffect.CHANGES)
    exchange = to.exchange(request, items, repeatable=repeatable, effect=effect)
    # a motion could begin towards the target of the one before or with its gains, and a home that nothing looks for
    # be found where the axis stands
    return replace(exchange, unseen=True) if command in UNSEEN else exchange


def _dialect(to: Destination[ReplyT]) -> Profile:
    """Return the profile that decides the layout.

    Raises:
        NotSupported: the destination is a group of unknown members.
    """
    if to.profile is None:
        raise NotSupported(f"group {to.address:02X}: this command differs between dialects, so the profile is needed")
    return to.profile
