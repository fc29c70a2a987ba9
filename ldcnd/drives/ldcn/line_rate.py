"""The rates of an LDCN/NMC line: which modules hear what is sent at one, and how all of them come to another.

Rates are changed by group commands without a leader (PIC-SERVO manual, 5.2 "Set Baud Rate"). What is sent at another
rate than a module's is noise to it: the bits of the header 0xAA alternate, which no slower sender's byte can produce at
a faster receiver, and the bytes received from a faster sender have no header, length and checksum that fit. Nulls end
what a module has received in part before it is asked at another rate (ibid., 4.1).
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import TypeVar

from ldcnd.contract.errors import BadReply, CommandAborted, OutcomeUnknown, PacketRejected, ReplyTimeout, StopLatched
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import spaced, unanswered
from ldcnd.drives.ldcn.group_plan import EVERYBODY, WAITING_GROUP
from ldcnd.drives.ldcn.identity import Identity, identity_in, read_identity
from ldcnd.drives.ldcn.packet import StatusPacket, check_status
from ldcnd.drives.ldcn.profiles import CLOCK_HZ, CYCLE_CLOCKS, PIC_SERVO_SC
from ldcnd.drives.ldcn.registers import FASTEST_BAUD, BaudCodes, actual_baud, baud_at_reset, baud_divisor
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, PacketEffect, ReplyVerdict

ReplyT = TypeVar("ReplyT")

COMMON_CODES = (0x0A, 0x14, 0x81)
"""Of the rates at which a crashed host may have left the drives: 115200, 57600 and 9600 baud with the usual clock."""
COMMON_BAUDS = (115_200, 57_600, 9600)


def once(exchange: Exchange[ReplyT]) -> Exchange[ReplyT]:
    """Return the exchange for a node that may not be there: it is not worth the bus's further attempts."""
    return replace(exchange, repeatable=False)


NULLS = bytes(16)
"""Fill up any half-received command buffer (PIC-SERVO manual, 4.1)."""
NULLS_SETTLE_S = 0.001


def nulls(quiet_s: float) -> Exchange[None]:
    """Return the exchange that fills up any half-received packet, and a pause."""
    return unanswered(EVERYBODY, NULLS, quiet_s, repeatable=True, effect=PacketEffect.READS)


RESET_S = 2.0
"""Longest time that a module takes to restart, seconds. No manual has it; 2 s are recommended for one model."""


@dataclass(frozen=True, slots=True)
class Heard:
    """Bytes came back.

    Attributes:
        identity: what they say; None when they are damaged, as by two replies at once.
    """

    identity: Identity | None


LARGE_DEVIATION = 0.02
"""Share of a rate from which a divisor takes most of what a receiver bears: 57600 with the manual's."""


class LineRate:
    """Who is at which rate.

    Attributes:
        working: where all modules should be.
        groups: the group addresses in use.
        at_reset: the rate after power-up and Hard Reset.
        missed_by: rates that divisors really make where these miss the working rate by much: a drive whose clock is off
            in the same direction does not receive the host at the working rate, but there.
        cycle_s: the servo cycle of the modules.
        reset_s: the longest time that a module takes to restart, seconds.
    """

    def __init__(
        self,
        bus: Bus,
        working: int,
        codes: BaudCodes,
        groups: tuple[int, ...],
        *,
        fastest: bool,
        clock_hz: int = CLOCK_HZ,
        reset_s: float = RESET_S,
    ) -> None:
        self.working = working
        self.reset_s = reset_s
        self.at_reset = baud_at_reset(clock_hz)
        self.cycle_s = CYCLE_CLOCKS / clock_hz
        # as the code 0x14, printed for 57600 baud in both manuals, makes 59524
        made = round(actual_baud(baud_divisor(working, codes, clock_hz), clock_hz))
        table = working == FASTEST_BAUD  # of PIC-SERVO SC, which sets exactly this rate
        self.missed_by = (made,) if not table and abs(made - working) > LARGE_DEVIATION * working else ()
        usual = clock_hz == CLOCK_HZ
        common = COMMON_BAUDS if usual else tuple(round(actual_baud(code, clock_hz)) for code in COMMON_CODES)
        top = (FASTEST_BAUD,) if fastest or working == FASTEST_BAUD else ()
        others = dict.fromkeys((*top, *common, working))
        # last, because every module answers there after a reset: what still answers elsewhere is found before
        others.pop(self.at_reset, None)
        self._possible = (*others, self.at_reset)
        self._clock_hz = clock_hz
        self.groups = groups
        self._bus = bus
        self._codes = codes

    @property
    def candidates(self) -> tuple[int, ...]:
        """Where they may be and the port can go, the most unlikely first, `at_reset` last."""
        return tuple(baud for baud in self._possible if self._bus.fixed_baud or self._bus.offers(baud))

    @property
    def changeable(self) -> bool:
        """Whether the host's port can change its rate."""
        return not self._bus.fixed_baud

    async def host_to(self, baud: int) -> bool:
        """Clear the line at the present rate and change ours; tell whether it is the wanted one now."""
        if self._bus.baud == baud:
            await self._bus.execute(nulls(NULLS_SETTLE_S))
        elif not self._bus.offers(baud):
            return False
        else:
            await self._bus.change_baud(nulls(NULLS_SETTLE_S), baud)
        return True

    async def everybody_to(self, baud: int) -> None:
        """Move all modules that receive the host, and the host; allowed while motors move.

        Only groups without a leader take Set Baud Rate (LS-182AP manual, "Addressing": "must be sent only as a group
        command with no group leader"): `Addressing.without_leaders` sees to that beforehand.
        """
        if self._bus.baud == baud:
            return
        # "all modules must have their baud rates changed at the same time" (ibid., 5.2): one left behind is deaf
        packets = [self.set_baud(address, baud).request for address in (*self.groups, WAITING_GROUP)]
        quiet_s = commands.group_quiet_s(self.cycle_s)
        burst = unanswered(EVERYBODY, self.spaced(packets), quiet_s, repeatable=False, effect=PacketEffect.ARRANGES)
        await self._bus.change_baud(burst, baud)

    def set_baud(self, group: int, baud: int) -> Exchange[None]:
        """Return the exchange that moves one group without a leader to a rate."""
        profile = PIC_SERVO_SC if baud == FASTEST_BAUD else None
        return commands.set_baud(
            commands.LeaderlessGroup(group, profile, self.cycle_s), baud, self._codes, self._clock_hz
        )

    def spaced(self, packets: list[bytes]) -> bytes:
        """Return group packets as one piece, a servo cycle apart at the present rate."""
        return spaced(packets, self._bus.settings.bits_per_byte / self._bus.baud, self.cycle_s)

    async def who_is(self, address: int, *, patient: bool = False) -> Identity | None:
        """Read the identity at an address at the host's rate; None when no module answers.

        Args:
            address: 0 for a module without an address.
            patient: use all of the bus's attempts, for a module that is expected to be there.

        Raises:
            BusDown, BusBusy: the line failed; says nothing about the module.
        """
        exchange = read_identity(address)
        return await self._answer(lambda: self._bus.execute(exchange if patient else once(exchange)))

    async def execute_at(self, baud: int | None, exchange: Exchange[ReplyT]) -> ReplyT:
        """Execute at another rate than the other modules', which receive noise; None for theirs."""
        if baud is None or baud == self._bus.baud:
            return await self._bus.execute(exchange)
        return await self._bus.execute_at(baud, exchange)

    async def _answer(self, ask: Callable[[], Awaitable[StatusPacket]]) -> Identity | None:
        while True:
            try:
                return identity_in(await ask())
            except (StopLatched, CommandAborted):
                continue  # a stop of this axis took the question off the queue: it says nothing about the module
            # silence, two replies at once, or noise: in none of them has a module said who it is
            except (ReplyTimeout, OutcomeUnknown, BadReply, PacketRejected):
                return None

    async def listen(self, address: int, baud: int | None = None) -> Heard | None:
        """Read an identity; None means silence. Replies that collide are no silence: their identity is None."""
        received = bytearray()
        exchange = read_identity(address)

        # called with every piece, so that bytes too few for a reply are no silence either
        def length(data: bytes) -> int:
            received[:] = data
            return exchange.reply_bytes

        def intact(data: bytes) -> ReplyVerdict:
            received[:] = data
            return check_status(data)

        asked = replace(once(exchange), check=intact, total_bytes=length)
        identity = await self._answer(lambda: self.execute_at(baud, asked))
        return Heard(identity) if identity or received else None
