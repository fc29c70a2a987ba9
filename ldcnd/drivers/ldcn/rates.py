"""The baud rate of an LDCN/NMC line: the host's, everybody's, and who answers at it.

Rates are changed by group commands without a leader, one burst for all groups, so that no other packet comes between
the modules' change and the host's (PIC-SERVO manual, 5.2 "Set Baud Rate"). What is sent at another rate than a module's
is noise to it: the bits of the header 0xAA alternate, which no slower sender's byte can look like to a faster receiver,
and what a faster sender's bytes look like has no header, length and checksum that fit.
"""

from collections.abc import Awaitable, Callable

from ldcnd.bus.bus import Bus
from ldcnd.drivers.ldcn import commands
from ldcnd.drivers.ldcn.destinations import Group, unanswered
from ldcnd.drivers.ldcn.identities import Identity, identity_in, once, read_identity
from ldcnd.drivers.ldcn.profiles import PIC_SERVO_SC
from ldcnd.drivers.ldcn.registers import SERVO_CYCLE_S, BaudCodes, actual_baud, baud_divisor
from ldcnd.drivers.ldcn.status import Status
from ldcnd.errors import BadReply, OutcomeUnknown, PacketRejected, ReplyTimeout, StopLatched
from ldcnd.exchange import Exchange

RESET_BAUD = 19_200
"""The rate after power-up and Hard Reset."""
COMMON_BAUDS = (115_200, 57_600, 9600, RESET_BAUD)
"""Where a crashed host may have left the drives; the last one is where a reset puts them."""
FASTEST_BAUD = 230_400
"""PIC-SERVO SC only. By the manuals' formula its code makes 208333 baud, which no receiver takes for 230400: a line
that tries this rate must be found at both.
"""
EVERYBODY = 0xFF
"""The group address after power-up."""
NULLS = bytes(16)
"""Fill up any half-received command buffer (PIC-SERVO manual, 4.1)."""
NULLS_SETTLE_S = 0.001
LEADER_REPLY_BYTES = 2


def nulls(quiet_s: float) -> Exchange[None]:
    """Return the exchange that fills up any half-received packet, and a pause."""
    return unanswered(EVERYBODY, NULLS, quiet_s, repeatable=True)


class LineRate:
    """Who is at which rate.

    Attributes:
        working: where all modules should be.
        candidates: where they may be, the most unlikely first, `RESET_BAUD` last.
        groups: the group addresses in use.
    """

    def __init__(self, bus: Bus, working: int, codes: BaudCodes, groups: tuple[int, ...], *, fastest: bool) -> None:
        self.working = working
        self.candidates: tuple[int, ...] = COMMON_BAUDS
        if fastest:
            self.candidates = (FASTEST_BAUD, *COMMON_BAUDS)
        if working == FASTEST_BAUD:
            self.candidates = (FASTEST_BAUD, round(actual_baud(baud_divisor(working, codes))), *COMMON_BAUDS)
        self.groups = groups
        self._bus = bus
        self._codes = codes

    @property
    def changeable(self) -> bool:
        """Whether the host's port can change its rate."""
        return not self._bus.fixed_baud

    async def host_to(self, baud: int) -> bool:
        """Clear the line at the present rate and change ours; tell whether it is the wanted one now."""
        if self._bus.baud == baud:
            await self._bus.execute(nulls(NULLS_SETTLE_S))
        elif self._bus.fixed_baud:
            return False
        else:
            await self._bus.change_baud(nulls(NULLS_SETTLE_S), baud)
        return True

    async def everybody_to(self, baud: int) -> None:
        """Move all modules that hear us, and the host; allowed while motors move.

        A group's leader answers at the new rate, which the host does not hear: it waits that reply out.
        """
        if self._bus.baud == baud:
            return
        profile = PIC_SERVO_SC if baud == FASTEST_BAUD else None
        burst = b"".join(
            commands.set_baud(Group(address, profile), baud, self._codes).request for address in self.groups
        )
        quiet_s = SERVO_CYCLE_S + LEADER_REPLY_BYTES * self._bus.settings.bits_per_byte / min(baud, self._bus.baud)
        await self._bus.change_baud(unanswered(EVERYBODY, burst, quiet_s, repeatable=False), baud)

    async def who_is(self, address: int, *, patient: bool = False) -> Identity | None:
        """Ask an address who it is at the host's rate; None when nobody answers.

        Args:
            address: 0 for a module without an address.
            patient: use all of the bus's attempts, for a module that is expected to be there.

        Raises:
            BusDown, BusBusy: the line failed; says nothing about the module.
        """
        exchange = read_identity(address)
        return await self._answer(lambda: self._bus.execute(exchange if patient else once(exchange)))

    async def who_is_at(self, baud: int, address: int) -> Identity | None:
        """Ask once at another rate than the others', who hear noise meanwhile; as `who_is` in everything else."""
        exchange = once(read_identity(address))
        if self._bus.baud == baud:
            return await self._answer(lambda: self._bus.execute(exchange))
        return await self._answer(lambda: self._bus.execute_at(baud, exchange))

    async def _answer(self, ask: Callable[[], Awaitable[Status]]) -> Identity | None:
        while True:
            try:
                return identity_in(await ask())
            except StopLatched:
                continue  # a stop of this axis took the question off the queue: it says nothing about the module
            except (ReplyTimeout, OutcomeUnknown, BadReply, PacketRejected):
                return None
