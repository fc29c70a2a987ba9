"""Bringing back modules that lost power, without a reset of the healthy ones.

Such a module comes back silent, at 19200 baud and address 0, and keeps those behind it in the chain from hearing the
host until it has an address again; they go on with what they were doing. A look is a single question at 19200 baud, on
a line that stays at its working rate: whoever works at that rate hears noise.

When somebody answers, everybody who hears is taken down to 19200 baud, which is allowed while motors move, the
newcomers get their addresses one after another, and everybody goes back to the working rate. In between every exchange
is an ordinary one: stops overtake, healthy drives are polled at the lower rate. Some may have missed a change of rate,
or have taken part in one before they had an address: while somebody is missing afterwards, they are looked for, too.
"""

from collections import deque
from collections.abc import Callable, Iterable

from ldcnd.bus.bus import Bus
from ldcnd.drivers.ldcn.addressing import Addressing
from ldcnd.drivers.ldcn.identities import Expected, Identity
from ldcnd.drivers.ldcn.rates import RESET_BAUD, LineRate
from ldcnd.errors import LdcndError
from ldcnd.log import get_logger

log = get_logger("ldcn")

UNADDRESSED = 0
LOOKS_FOR_STRAYS = 3
"""How often each that may be where it should not be is looked for there."""


class Rejoin:
    """One line's search for newcomers."""

    def __init__(self, bus: Bus, rate: LineRate, addressing: Addressing, expected: tuple[Expected, ...]) -> None:
        self._bus = bus
        self._rate = rate
        self._addressing = addressing
        self._expected = expected
        self._strays: deque[tuple[int, int]] = deque()  # rates and addresses at which somebody may be
        self._foreign: Identity | None = None  # complained about already

    async def look(self, mute: tuple[Expected, ...], addressing: Callable[[int], None]) -> frozenset[int]:
        """Look for these modules once, and bring back those that are found; return who is known to answer.

        Args:
            mute: modules that have stopped answering, in the order of the chain.
            addressing: told the address of a newcomer before it is given that address.

        Raises:
            BusError: the line failed meanwhile.
        """
        if self._bus.baud != RESET_BAUD and not self._rate.changeable:
            return frozenset()  # a newcomer could not hear this port
        if not mute or not await self._anybody_there(mute):
            return frozenset()
        lost = [each for each in mute if await self._rate.who_is(each.address) is None]
        if lost:
            await self._at_reset_baud(lost, addressing)
        heard = [each.address for each in self._expected if await self._rate.who_is(each.address, patient=True)]
        # those behind a newcomer are heard again, too
        self._suspect(each.address for each in self._expected if each.address not in heard)
        return frozenset(each.address for each in mute if each.address in heard)

    async def _anybody_there(self, mute: tuple[Expected, ...]) -> bool:
        """Ask for a newcomer at 19200 baud, and for one of those that may have strayed."""
        found = await self._rate.who_is_at(RESET_BAUD, UNADDRESSED)
        if found and (found != self._foreign or mute[0].accepts(found)):
            return True
        if self._strays:
            baud, address = self._strays.popleft()
            awaited = address == UNADDRESSED or address in {each.address for each in mute}
            return awaited and await self._rate.who_is_at(baud, address) is not None
        return False

    def _suspect(self, missing: Iterable[int]) -> None:
        strays = [(RESET_BAUD, address) for address in missing]
        self._strays = deque([(self._rate.working, UNADDRESSED), *strays] * LOOKS_FOR_STRAYS if strays else [])

    async def _at_reset_baud(self, lost: list[Expected], addressing: Callable[[int], None]) -> None:
        """Address newcomers at the rate of power-up; everybody who hears is at the working rate again afterwards."""
        self._suspect(each.address for each in self._expected)
        await self._rate.everybody_to(RESET_BAUD)
        try:
            await self._address_newcomers(lost, addressing)
        except LdcndError:
            if self._bus.is_open:
                await self._rate.everybody_to(self._rate.working)
            raise
        await self._rate.everybody_to(self._rate.working)

    async def _address_newcomers(self, lost: list[Expected], addressing: Callable[[int], None]) -> None:
        """Give the module at address 0 the first address that is missing, as long as there is one."""
        for each in lost:
            if await self._rate.who_is(each.address):
                continue  # it has its address, and had only missed a change of rate
            found = await self._rate.who_is(UNADDRESSED)
            if found is None:
                break  # whoever comes next is dark, or keeps those behind it from hearing
            if not each.accepts(found):
                if found != self._foreign:
                    log.error("foreign newcomer", bus=self._bus.settings.name, place=each.what, found=str(found))
                self._foreign = found
                break
            log.info("newcomer", bus=self._bus.settings.name, address=each.address, identity=str(found))
            addressing(each.address)
            if not await self._addressing.address_next(each.address):
                break
