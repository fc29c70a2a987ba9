"""Base of every simulated LDCN/NMC module: addresses, packets, status, rate, reset.

A packet is executed at the end of the servo cycle in which it became complete, and the status packet starts there;
every module has its own phase and drift of that grid. Decisions where the manuals leave room:

* A byte of the host that arrives before the status packet has been sent makes a module drop that packet. The command
  itself waits in the buffer into which the next packet is received, and is overwritten by the address byte of any.
* Data bytes that a packet lacks are those that the receive buffer holds from earlier packets, for this module or
  another; after a reset it holds zeros.
* Before a module has restarted after a reset it receives nothing.
* A framing error in the middle of a packet counts as a wrong checksum; outside of packets it is nothing.
* Nothing is received while the address input is high. It is a level, not a latch, unless a switch says otherwise: a
  module behind one that was reset is deaf until that one has an address again.

Sources: PIC-SERVO manual, 4.1, 5.2; LS-182AP manual, "Serial command interface", "Addressing".
"""

import math
from abc import abstractmethod

from ldcnd.drives.ldcn.packet import (
    FRAME_BYTES,
    HEADER,
    MOST_DATA_BYTES,
    CommandCode,
    Packet,
    PacketReader,
    StatusItem,
)
from ldcnd.drives.ldcn.profiles import Profile, at_clock
from ldcnd.drives.ldcn.received import (
    DefineStatus,
    HardReset,
    PlainCommand,
    ReadStatus,
    ReceivedCommand,
    SetAddress,
    SetBaudRate,
    received_command,
)
from ldcnd.drives.ldcn.registers import RESET_BAUD, RESET_BAUD_CODE, actual_baud, module_baud
from ldcnd.line.exchange import NEVER_S
from ldcnd.sim.chain import BITS_PER_BYTE, Module, ModuleReply
from ldcnd.sim.ldcn.quirks import CommandBuffer, ModuleSettings, UnknownBaud

EVERYBODY = 0xFF
_ROUNDING = 1e-6


class SimulatedModule(Module):
    """One address on the line.

    Attributes:
        address: individual address; 0 until one was set.
        group: group address, 128 to 255.
        leader: answers for its group.
        items: status items selected by Define Status.
        overwritten: how many commands were lost because another packet came before they were executed.
        unknown_bauds: number of unknown codes in Set Baud Rate.
    """

    def __init__(self, profile: Profile, settings: ModuleSettings) -> None:
        self.profile = at_clock(profile, settings.clock_hz)
        self.settings = settings
        self._reader = PacketReader()
        self._missed = PacketReader()  # what comes while it restarts
        self._buffer = bytearray(MOST_DATA_BYTES)
        self._cycle_s = self.profile.servo_cycle_s * (1.0 + settings.drift_ppm * 1e-6)
        self._cycles_done = 0
        self.address = 0
        self.group = EVERYBODY
        self.leader = False
        self.items = StatusItem(0)
        self.overwritten = 0
        self.unknown_bauds = 0
        self.yields_to_host = settings.yields_to_host
        self._loses_commands = settings.command_buffer is CommandBuffer.OVERWRITTEN
        self._powered = True
        self._deaf_until_s = -math.inf
        self._packet: Packet | None = None
        self._reply: bytes | None = None
        self._intact = True  # the packet came without errors
        self._damaged = False  # the packet being received has a framing error
        self._answers = False
        self._due_cycle = 0
        self._start_afresh()

    def hear(self, value: int | None, at_s: float) -> None:
        """Take a byte of the host; a complete packet for this module waits for the end of the servo cycle."""
        if not self._powered:
            return
        if at_s < self._deaf_until_s:
            began = self._missed.in_packet
            self._missed.feed(value or 0)
            if self._missed.in_packet and not began:
                self.remark("lost: the module is still resetting")
            return
        self._fall_silent()
        if self._reader.in_packet:
            self._overwrite()
        if value is None:
            self._damaged = self._reader.in_packet
            if not self._damaged:
                return
        received = self._reader.feed(value or 0)
        if received is None:
            return
        intact = received.checksum_ok and not self._damaged
        self._damaged = False
        packet = received.packet
        mine = self._is_for_me(packet.address, packet.command)
        if mine or self._loses_commands:
            self._buffer[: len(packet.data)] = packet.data
        if not mine:
            return
        self._answers = packet.address == self.address or (packet.address == self.group and self.leader)
        self._packet, self._intact = packet, intact
        self._due_cycle = math.floor((at_s - self.settings.phase_s) / self._cycle_s) + 1
        self.next_event_s = self.settings.phase_s + self._due_cycle * self._cycle_s

    def takes_whole(self, data: bytes) -> bool:
        """Exactly one packet, or no beginning of any."""
        if self._reader.in_packet or self._missed.in_packet:
            return False
        return HEADER not in data or _is_packet(data)

    def hear_all(self, data: bytes, starts_at_s: float, byte_s: float) -> None:
        """A packet for another module only ends what this one was about to do."""
        deaf = not self._powered or starts_at_s + byte_s < self._deaf_until_s
        if deaf or not _is_packet(data) or self._is_for_me(data[1], data[2] & 0x0F):
            super().hear_all(data, starts_at_s, byte_s)
        else:
            self._fall_silent()
            self._overwrite()
            if self._loses_commands:
                self._buffer[: len(data) - FRAME_BYTES] = data[FRAME_BYTES - 1 : -1]

    def advance(self, to_s: float) -> ModuleReply | None:
        """Execute the packet that waits, at the end of the servo cycle, and begin the reply."""
        at_s = self.next_event_s
        if at_s > to_s:
            return None
        self.next_event_s = NEVER_S
        packet, self._packet = self._packet, None
        reply, self._reply = self._reply, None
        if packet is not None:
            reply = self._obey(packet, at_s)
            if reply and self.settings.reply_latency_s > 0.0:
                self._reply = reply
                self.next_event_s = at_s + self.settings.reply_latency_s
                return None
        return ModuleReply(reply, at_s, BITS_PER_BYTE / self.baud) if reply else None

    @property
    def dialect(self) -> Profile:
        """Commands accepted at present; some devices accept more after a command."""
        return self.profile

    def power(self, *, on: bool, at_s: float) -> None:
        """Switch the module off, or on again: it then starts as after a reset, and restores what it has saved."""
        self.catch_up(at_s)
        self._reset(at_s)
        self._powered = on
        if on:
            self.restore()

    @property
    def powered(self) -> bool:
        """Whether it has its supply."""
        return self._powered

    def catch_up(self, to_s: float) -> None:
        """Let the servo cycles up to that instant pass; also before something is changed from outside."""
        self._pass_cycles(math.floor((to_s - self.settings.phase_s) / self._cycle_s + _ROUNDING))

    # -- what kinds of modules differ in -----------------------------------------------------------------------------

    @abstractmethod
    def restart(self) -> None:
        """Take the state of power-up."""

    def restore(self) -> None:
        """Restore what was saved, at power-up."""

    def save(self, start_up: int) -> None:
        """Save the configuration, as the control byte of Hard Reset requests."""

    def addressed(self) -> None:
        """Do what is due when an address has been set."""

    @abstractmethod
    def run(self, cycles: int) -> None:
        """Let servo cycles pass."""

    @abstractmethod
    def execute(self, command: ReceivedCommand) -> None:
        """Execute a command that is not common to all modules; ignore one that this module does not have."""

    @abstractmethod
    def status(self, items: StatusItem, *, checksum_error: bool) -> bytes:
        """Return a status packet."""

    # -- what all have in common -------------------------------------------------------------------------------------

    def _fall_silent(self) -> None:
        """Drop what was to be sent, because the host sends."""
        if not self.yields_to_host:
            return
        self._answers = False
        if self._reply is not None:
            self._reply = None
            self.next_event_s = NEVER_S

    def _overwrite(self) -> None:
        """Lose the command that waits, because its buffer takes the next packet."""
        if self._packet is not None and self._loses_commands:
            self._packet = None
            self.overwritten += 1
            self.next_event_s = NEVER_S

    def _is_for_me(self, address: int, command: int) -> bool:
        if address in {self.address, self.group}:
            return True
        return address == EVERYBODY and command == CommandCode.HARD_RESET and self.settings.always_obeys_global_reset

    def _pass_cycles(self, until: int) -> None:
        if until > self._cycles_done:
            self.run(until - self._cycles_done)
            self._cycles_done = until

    def _obey(self, packet: Packet, at_s: float) -> bytes | None:
        """Execute the packet at the end of the present servo cycle; return the status packet, if one is due."""
        self._pass_cycles(self._due_cycle)
        if not self._intact:
            return self.status(self.items, checksum_error=True) if self._answers else None
        items = self.items
        # seen on the line of an SK-2310g2: Define Status without its byte after Set Address 06 FF takes 06 for the mask
        match received_command(self.dialect, packet, bytes(self._buffer)):
            case SetAddress() as addresses:
                self.address, self.group, self.leader = addresses.address, addresses.group, addresses.leader
                self.address_out = True
                self.latched = self.settings.address_in_latched
                self.addressed()
            case DefineStatus(items):
                self.items = items
            case ReadStatus(items):
                pass
            case SetBaudRate(code):
                baud = module_baud(self.profile, code)
                if baud is None:
                    self.unknown_bauds += 1
                    if self.settings.unknown_baud is UnknownBaud.DIVIDED:
                        self._set_rate(actual_baud(code, self.profile.clock_hz))
                else:
                    self._set_rate(baud)
            case HardReset(start_up):
                if start_up is not None:
                    self.save(start_up)
                self._reset(at_s)
                return None
            case PlainCommand(CommandCode.NO_OPERATION):
                pass
            case command:
                self.execute(command)
        return self.status(items, checksum_error=False) if self._answers else None

    def _set_rate(self, nominal: float) -> None:
        # servo cycle and rate come from one clock: "any clock between 10 MHz and 20 MHz may be used, with the timing
        # specifications adjusted proportionally" (PIC-SERVO manual, 3.0)
        self.baud = nominal / (1.0 + self.settings.drift_ppm * 1e-6)

    def _reset(self, at_s: float) -> None:
        self._deaf_until_s = at_s + self.settings.reset_dead_s
        self._start_afresh()

    def _start_afresh(self) -> None:
        self.address = 0
        self.group = EVERYBODY
        self.leader = False
        self.items = StatusItem(0)
        self._set_rate(module_baud(self.profile, RESET_BAUD_CODE) or RESET_BAUD)
        self.address_out = self.latched = False
        self.next_event_s = NEVER_S
        self._reader.reset()
        self._missed.reset()
        self._buffer = bytearray(MOST_DATA_BYTES)
        self._packet = None
        self._reply = None
        self._damaged = False
        self.restart()


def _is_packet(data: bytes) -> bool:
    """Tell whether these bytes are one packet, nothing more or less; the checksum does not matter."""
    return data[0] == HEADER and len(data) >= FRAME_BYTES and len(data) == FRAME_BYTES + (data[2] >> 4)
