"""Addresses on an LDCN/NMC line: everybody back to power-up, and one module after another out of address 0.

Source: LS-182AP manual, "Addressing", flow chart of the addressing procedure; PIC-SERVO manual, 4.1 "Network
initialization".
"""

from ldcnd.bus.bus import Bus
from ldcnd.drivers.ldcn import commands, destinations
from ldcnd.drivers.ldcn.destinations import Node, unanswered
from ldcnd.drivers.ldcn.group_plan import GroupPlan
from ldcnd.drivers.ldcn.identities import ANY_DIALECT, UNADDRESSED, Identity
from ldcnd.drivers.ldcn.rates import EVERYBODY, NULLS_SETTLE_S, RESET_BAUD, LineRate, nulls
from ldcnd.errors import BadReply, OutcomeUnknown, PacketRejected

MOST_MODULES = 32
ADDRESSING_ATTEMPTS = 3
END_ATTEMPTS = 2
"""The chain is expected to end here: each attempt to find one more module costs two time-outs."""
DRAIN_S = 0.05
"""Silence after which no reply to earlier traffic can come any more."""


class Addressing:
    """Gives modules their addresses; neither of the procedures moves a motor."""

    def __init__(self, bus: Bus, rate: LineRate, plan: GroupPlan) -> None:
        self._bus = bus
        self._rate = rate
        self._plan = plan

    async def reset_all(self) -> None:
        """Hard Reset at every rate the drives may be at, twice each, ending at the rate they restart with.

        Time to restart is given at that last rate only: whoever obeyed at another one restarts meanwhile, and hears
        nothing that it would have to obey.

        A module that is reset makes the next one deaf, so one that is left at a rate of its own would split the chain:
        all are called to one rate first, which leaves their address outputs as they are. PIC-SERVO version 4 obeys only
        a reset of the group it is in, so every known group address is reset.
        """
        for baud in self._rate.candidates:
            if baud != RESET_BAUD and await self._rate.host_to(baud):
                await self._rate.everybody_to(RESET_BAUD)
        for baud in self._rate.candidates:
            await self._reset_at(baud, commands.RESET_SETTLE_S if baud == RESET_BAUD else NULLS_SETTLE_S)
        await self._bus.execute(nulls(DRAIN_S))

    async def _reset_at(self, baud: int, settle_s: float) -> None:
        if not await self._rate.host_to(baud):
            return
        burst = b"".join(commands.hard_reset(destinations.Group(address)).request for address in self._plan.addresses)
        for _ in range(2):
            await self._bus.execute(unanswered(EVERYBODY, burst, settle_s, repeatable=False))

    async def address_all(self, expected: int) -> dict[int, Identity]:
        """Give the modules addresses 1, 2, ... in the order of the chain; return who is where.

        Args:
            expected: so many modules are configured; those behind them are looked for with less patience.
        """
        modules: dict[int, Identity] = {}
        for address in range(1, MOST_MODULES + 1):
            if not await (self.address_next(address) if address <= expected else self._address_unexpected(address)):
                break
            identity = await self._rate.who_is(address, patient=True)
            if identity is None:
                break
            modules[address] = identity
        return modules

    async def address_next(self, address: int) -> bool:
        """Address the module that is at 0 now; tell whether there was one.

        A lost reply leaves open whether the module took the address: then it answers there.
        """
        for _ in range(ADDRESSING_ATTEMPTS):
            if await self._set_address(UNADDRESSED, address):
                return True
            if await self._rate.who_is(address, patient=True):
                return True
        return False

    async def _address_unexpected(self, address: int) -> bool:
        """Address a module that nobody described; tell whether there was one."""
        for _ in range(END_ATTEMPTS):
            if await self._set_address(UNADDRESSED, address) or await self._rate.who_is(address):
                return True
        return False

    async def regroup(self, address: int) -> bool:
        """Tell an addressed module its group again, which keeps its address; tell whether it acknowledged that.

        Never repeated blindly: the same bytes once more are harmless, but only when the module is known to be there.
        """
        node = Node(address, ANY_DIALECT)
        for _ in range(ADDRESSING_ATTEMPTS):
            if await self._set_address(node, address):
                return True
            if not await self._rate.who_is(address, patient=True):
                return False
        return False

    async def _set_address(self, node: Node, address: int) -> bool:
        group = self._plan.place(address).address
        packet = commands.set_address(node, address, group, leader=self._plan.leads(address))
        try:
            await self._bus.execute(packet)
        except (OutcomeUnknown, BadReply, PacketRejected):
            return False
        return True
