"""Bringing back modules that lost power, without a reset of the healthy ones.

Such a module comes back silent, at 19200 baud and address 0, and keeps those behind it in the chain from hearing the
host until it has an address again; they go on with what they were doing. So everybody who hears is taken down to 19200
baud, which is allowed while motors move, the newcomers get their addresses one after another, and everybody goes back
to the working rate. In between every exchange is an ordinary one: stops overtake, healthy drives are polled at the
lower rate. Whoever missed a change of rate is found at the other one by the next round.
"""

from collections.abc import Callable

from ldcnd.bus.bus import Bus
from ldcnd.drivers.ldcn.addressing import Addressing
from ldcnd.drivers.ldcn.identities import Expected, Identity
from ldcnd.drivers.ldcn.rates import RESET_BAUD, LineRate
from ldcnd.errors import LdcndError
from ldcnd.log import get_logger

log = get_logger("ldcn")


class Rejoin:
    """One line's search for newcomers."""

    def __init__(self, bus: Bus, rate: LineRate, addressing: Addressing) -> None:
        self._bus = bus
        self._rate = rate
        self._addressing = addressing
        self._foreign: Identity | None = None  # complained about already

    async def round(self, mute: tuple[Expected, ...], addressing: Callable[[int], None]) -> frozenset[int]:
        """Look for these modules once; return who answers again.

        Args:
            mute: modules that have stopped answering, in the order of the chain.
            addressing: told the address of a newcomer before it is given that address.

        Raises:
            BusError: the line failed meanwhile.
        """
        lost = [each for each in mute if await self._rate.who_is(each.address) is None]
        heard = frozenset(each.address for each in mute if each not in lost)
        if not lost or (self._bus.baud != RESET_BAUD and not self._rate.changeable):
            return heard  # nobody to look for, or a newcomer could not hear this port
        if not await self._at_reset_baud(lost, addressing):
            return heard
        # those behind a newcomer are heard again, too
        return heard.union([each.address for each in lost if await self._rate.who_is(each.address, patient=True)])

    async def _at_reset_baud(self, lost: list[Expected], addressing: Callable[[int], None]) -> bool:
        """Find some at the rate of power-up, or none; everybody who hears is at the working rate again afterwards."""
        await self._rate.everybody_to(RESET_BAUD)
        try:
            found = await self._address_newcomers(lost, addressing)
        except LdcndError:
            if self._bus.is_open:
                await self._rate.everybody_to(self._rate.working)
            raise
        await self._rate.everybody_to(self._rate.working)
        return found

    async def _address_newcomers(self, lost: list[Expected], addressing: Callable[[int], None]) -> bool:
        """Give the module at address 0 the first address that is missing, as long as there is one; tell if any was."""
        found_any = False
        for each in lost:
            if await self._rate.who_is(each.address):
                found_any = True  # it has its address, and had only missed a change of rate
                continue
            found = await self._rate.who_is(0)
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
            found_any = True
        return found_any
