"""A module as a guest sees it: addresses, groups, rate and status mask are the guest's, the readings are the drive's.

The guest talks to a chain of these instead of to the line. What only arranges (Hard Reset, Set Address, Set Baud Rate,
Define Status) is obeyed here, as `SimulatedModule` does, and never reaches the line. Nothing here sends: readings are
asked for with `ask`, a command that could concern a drive is handed to `command`, and a Hard Reset is told to `reset`.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from ldcnd.drives.ldcn.packet import CommandCode, Packet, StatusFlag, StatusItem
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.drives.ldcn.received import ReceivedCommand
from ldcnd.sim.ldcn.module import SimulatedModule
from ldcnd.sim.ldcn.quirks import ModuleSettings

CHECKSUM_ERROR = int(StatusFlag.CHECKSUM_ERROR)
"""The same bit in the status byte of every module (PIC-SERVO manual, 5.3)."""


class PendingReply(Protocol):
    """A reply that waits for its reading."""

    def wanted(self) -> bool:
        """Tell whether the host still waits: a module drops its reply as soon as the host sends."""

    def give(self, status: bytes, at_s: float) -> None:
        """Begin the reply at that instant with the drive's status packet, if it is still wanted."""


class GuestModule(SimulatedModule):
    """A module that answers with readings of the one on the line; without one it is silent: no value is invented.

    Attributes:
        neighbours: all modules of its chain.
    """

    def __init__(
        self,
        profile: Profile,
        settings: ModuleSettings,
        ask: Callable[[StatusItem, PendingReply], None],
        command: Callable[[ReceivedCommand], None],
        reset: Callable[[], None],
    ) -> None:
        self._ask, self._command, self._reset_here = ask, command, reset
        self._asked: _StatusReply | None = None
        self._powered_up = True  # and not reset since: it counts from where a program gives it its address
        self.neighbours: Sequence[GuestModule] = ()
        super().__init__(profile, settings)

    def restart(self) -> None:
        """A guest's Hard Reset reaches no drive; after a loss of power the guest has to begin."""
        if not self._powered_up:
            self._reset_here()

    def run(self, cycles: int) -> None:
        """The drive counts its own servo cycles."""

    def execute(self, command: ReceivedCommand) -> None:
        """Hand on what could concern the drive."""
        self._command(command)

    def status(self, items: StatusItem, *, checksum_error: bool) -> bytes:
        """Ask for the reading that the reply needs; the reply follows with it."""
        self._asked = _StatusReply(self, damaged=checksum_error)
        self._ask(items, self._asked)
        return b""

    def answers(self, answer: "_StatusReply") -> bool:
        """Tell whether this is the reply that the host waits for."""
        return self._asked is answer

    def reply(self, data: bytes, at_s: float) -> None:
        """Begin a reply at that instant."""
        self._asked = None
        self._reply, self.next_event_s = data, at_s

    def _obey(self, packet: Packet, at_s: float) -> bytes | None:
        # a program repeats Set Address because a module that restarts after a reset hears nothing (LS-182AP manual,
        # "Addressing"); here the first one is heard, and the second must not give the next module the same address
        if self.address == 0 and packet.command == CommandCode.SET_ADDRESS and packet.data:
            for named in self.neighbours:
                if named.address == packet.data[0]:
                    return named.obey_again(packet, self._due_cycle, at_s)
            if self._powered_up:  # modules behind the first do not hear the Hard Reset before it
                self._powered_up = False
                self._reset_here()
        return super()._obey(packet, at_s)

    def lose_power(self, at_s: float) -> None:
        """Its drive has restarted: this one is without an address too, and silent until the guest gives it one."""
        self._powered_up = True
        self.power(on=True, at_s=at_s)

    def drop_half_packets(self) -> None:
        """Take the next byte for the first one of a packet: another program sends it."""
        self._reader.reset()
        self._missed.reset()

    def obey_again(self, packet: Packet, due_cycle: int, at_s: float) -> bytes | None:
        """Obey a packet that came to the module behind this one and is for this one."""
        self._answers, self._intact, self._due_cycle = True, True, due_cycle
        return super()._obey(packet, at_s)

    def _fall_silent(self) -> None:
        self._asked = None
        super()._fall_silent()


class _StatusReply:
    """A reply of one module."""

    def __init__(self, module: GuestModule, *, damaged: bool) -> None:
        self._module, self._damaged = module, damaged

    def wanted(self) -> bool:
        return self._module.answers(self)

    def give(self, status: bytes, at_s: float) -> None:
        if not self.wanted():
            return
        flag = CHECKSUM_ERROR if self._damaged else 0  # the guest's own, not that of the daemon's packet
        body = bytes((status[0] & ~CHECKSUM_ERROR | flag,)) + status[1:-1]
        self._module.reply(body + bytes((sum(body) & 0xFF,)), at_s)
