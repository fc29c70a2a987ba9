"""Addresses of an LDCN/NMC line: all modules are reset to address 0, and leave it one after the other.

Sources: LS-182AP manual, "Addressing" with the flow chart of the procedure; PIC-SERVO manual, 4.1 "Network
initialization", 5.2.
"""

import asyncio
from collections.abc import Iterable, Iterator

from ldcnd.contract.errors import BadReply, NetworkMismatch, OutcomeUnknown, PacketRejected
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node, unanswered
from ldcnd.drives.ldcn.group_plan import EVERYBODY, WAITING_GROUP, GroupPlan
from ldcnd.drives.ldcn.identity import ANY_DIALECT, UNADDRESSED, Identity
from ldcnd.drives.ldcn.line_rate import NULLS_SETTLE_S, LineRate, nulls
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import PacketEffect

WAITING_ADDRESSES = tuple(range(127, 63, -1))
"""Given to what waits at address 0 until its place is proven; nothing that could move is ever sent there."""

MOST_MODULES = 32
ADDRESSING_ATTEMPTS = 3
END_ATTEMPTS = 2
"""Where perhaps no module waits: each attempt to find one costs a time-out."""
RESTART_PAUSE_S = 0.02
"""From one question to a module that may be restarting to the next, seconds."""
DRAIN_S = 0.005
"""Silence after which no reply can come to a half-received packet that nulls have filled up."""


class Addressing:
    """Gives modules their addresses; neither of the procedures moves a motor.

    Attributes:
        rate: who is at which rate.
        had_address: addresses of modules that may have had theirs already, as they did not acknowledge getting it.
        untold: addresses of modules that may not have heard in which group they are, and whether they lead it, since
            they were given their addresses.
    """

    def __init__(self, bus: Bus, rate: LineRate, plan: GroupPlan) -> None:
        self.had_address: set[int] = set()
        self.untold: set[int] = set()
        self._bus = bus
        self.rate = rate
        self._plan = plan

    async def reset_all(self) -> None:
        """Hard Reset at every rate the drives may be at, twice each, ending at the rate they restart with.

        Time to restart is given at that last rate only: a module that obeyed at another one restarts meanwhile, and
        receives nothing that it would have to obey. The line is silent then for longer than any late reply takes.
        """
        await self.call_all()
        await self.reset_called()

    async def call_all(self) -> None:
        """Call all modules to the rate of power-up, at every rate they may be at; they keep their addresses.

        A module that is reset makes the next one deaf, so one that is left at a rate of its own would split the chain:
        this leaves their address outputs as they are.
        """
        for baud in (*self.rate.missed_by, *self.rate.candidates):
            if baud != self.rate.at_reset and await self.rate.host_to(baud):
                await self.without_leaders()
                await self.rate.everybody_to(self.rate.at_reset)

    async def reset_called(self) -> None:
        """See `reset_all`, for modules that were called to one rate before.

        PIC-SERVO version 4 obeys only a reset of the group it is in, so every known group address is reset; `EVERYBODY`
        last, because Logosol drives obey that one in any group, and would make those behind them deaf to their own.
        """
        for baud in self.rate.candidates:
            await self._reset_at(baud, commands.RESET_SETTLE_S if baud == self.rate.at_reset else NULLS_SETTLE_S)
        await self._bus.execute(nulls(DRAIN_S))

    async def _reset_at(self, baud: int, settle_s: float) -> None:
        if not await self.rate.host_to(baud):
            return
        groups = (*(address for address in self._plan.addresses if address != EVERYBODY), WAITING_GROUP, EVERYBODY)
        # no reply tells which have obeyed, so each group is reset, whether it has members at present or not
        burst = self.rate.spaced([commands.hard_reset(commands.LeaderlessGroup(address)).request for address in groups])
        reset = unanswered(EVERYBODY, burst, settle_s, repeatable=False, effect=PacketEffect.ARRANGES)
        # nothing tells whether a packet without a reply was damaged on its way
        for _ in range(2):
            await self._bus.execute(reset)

    async def address_all(self, expected: int) -> dict[int, Identity]:
        """Give the modules addresses 1, 2, ... in the order of the chain, after a reset; return who is where.

        Each first gets a waiting address. Only when all of these answer after the last of them was given out, each is
        held by one module, in the order of the chain: one that has restarted meanwhile left its waiting address.

        Args:
            expected: number of configured modules, 0 where that is not known; they are waited for as long as they may
                take to restart. Fewer keep their waiting addresses: behind one without power the next one that
                receives is not the next place, and one that is not heard keeps those behind it from receiving. Where
                there is one more, all are reset again, and it is returned with them: only the right number shows that
                none is without power, and in a chain without any address those that receive are the first ones.

        Raises:
            NetworkMismatch: the configured number answers, and no reset is proven that all of them heard.
        """
        parked = await self._park_behind_one_reset(expected)
        surplus: Identity | None = None
        if expected and len(parked) == expected:
            # what has the address of a place before that was given to any module was deaf to the reset, behind a module
            # without power, and receives now: those that did not wait for it are not in the places that they seem to be
            # in. Reset, it shows as one more that waits at address 0, or by making the next one deaf
            await self._reset_each(range(1, expected + 1))
            surplus = await self._newcomer()
        modules: dict[int, Identity] = {}
        for number, waiting in enumerate(parked, 1):
            # "the host can also use this mechanism to verify that the proper number of modules are present" (ibid.)
            identity = await self.rate.who_is(waiting, patient=True)
            if identity is None:
                return modules
            modules[number] = identity
        if surplus:
            await self._reset_at(self.rate.at_reset, commands.RESET_SETTLE_S)
            return modules | {len(parked) + 1: surplus}
        if len(parked) < expected:
            return modules
        for number, waiting in enumerate(parked, 1):
            if not await self.move(waiting, number):
                return {address: modules[address] for address in range(1, number)}
        return modules

    async def _reset_each(self, addresses: Iterable[int]) -> None:
        """Reset what has one of these addresses; nothing tells whether there is anything."""
        nodes = [Node(address, ANY_DIALECT) for address in addresses]
        burst = self.rate.spaced([commands.hard_reset(node).request for node in nodes])
        await self._bus.execute(
            unanswered(EVERYBODY, burst, NULLS_SETTLE_S, repeatable=False, effect=PacketEffect.ARRANGES)
        )

    async def _park_behind_one_reset(self, expected: int) -> list[int]:
        """Park what waits at address 0, and all of them again where one came late; return their addresses.

        One that came late may have had no power: then it had kept the next one deaf to the reset, and what receives
        behind that was parked before it, out of its turn. All of them hear now, so that behind another reset none has
        an address. Or it restarts more slowly than the first one: so after that reset all are given the time that the
        slowest of them has needed, and one that comes late even then was not reset with the others.

        Raises:
            NetworkMismatch: one came late each time.
        """
        now_s = asyncio.get_running_loop().time
        restart_s = 0.0
        for attempt in range(ADDRESSING_ATTEMPTS):
            if attempt:
                await self._reset_at(self.rate.at_reset, commands.RESET_SETTLE_S)
                await asyncio.sleep(restart_s)
                await self._bus.execute(nulls(DRAIN_S))
            began_s = now_s()
            parked, late = await self._park_in_order(expected)
            if not (late and len(parked) == expected):
                return parked
            restart_s = min(restart_s + now_s() - began_s, self.rate.reset_s)
        raise NetworkMismatch(
            f"bus {self._bus.settings.name}: {expected} module(s) answer, as configured, but behind each of"
            f" {ADDRESSING_ATTEMPTS} resets one came later than the others: their order is not proven",
            remedy="look for a supply or a plug of one of them that comes and goes, and for noise on the line",
        )

    async def _park_in_order(self, expected: int) -> tuple[list[int], bool]:
        """Park what waits at address 0, one after another; return their addresses, and whether one came late.

        Late is who came behind another one: all that were reset at one instant wait for the first, and for no other.
        """
        self.had_address.clear()
        parked: list[int] = []
        late, free = False, iter(WAITING_ADDRESSES)
        until_s = asyncio.get_running_loop().time() + self.rate.reset_s if expected else 0.0
        while len(parked) < (expected or MOST_MODULES) and (expected or await self._newcomer()):
            address, at_once = await self._park(len(parked) + 1, free, until_s)
            if address is None:
                break
            late = late or (bool(parked) and not at_once)
            parked.append(address)
        return parked, late

    async def _park(self, number: int, free: Iterator[int], until_s: float) -> tuple[int | None, bool]:
        """Give what waits at address 0 a waiting address; return that, and whether it was there at the first attempt.

        A lost reply leaves open whether a module took the address: then it answers there. One that took it and is not
        heard is reset, and keeps the next one deaf again: that one would be numbered in its place. The address is
        given to nobody else, also if that reset was lost.

        Args:
            number: of the module in the chain.
            free: waiting addresses that were given to nobody.
            until_s: when it should have restarted, in loop time.
        """
        # whoever receives at address 0 takes it: that is harmless only while no place is meant
        for attempt, address in enumerate(free):
            if attempt and not await self._comes(until_s):
                break
            # "the host starts by sending a Set Address command to module 0": the first that receives; it "will lower
            # its ADDR_OUT signal", and the next one receives (PIC-SERVO manual, 4.1)
            if await self._set_address(UNADDRESSED, address, EVERYBODY):
                return address, not attempt
            if await self.rate.who_is(address):
                self.had_address.add(number)
                return address, not attempt
            await self._reset_each((address, address))  # twice: nothing tells whether one was damaged on its way
        return None, False

    async def _comes(self, until_s: float) -> bool:
        """Tell whether anything is heard at address 0, until that instant."""
        while not await self._newcomer():
            if asyncio.get_running_loop().time() >= until_s:
                return False
            # it may be restarting: a packet that is only half received would be completed by the next one
            await asyncio.sleep(RESTART_PAUSE_S)
        return True

    async def _newcomer(self) -> Identity | None:
        """Return what waits at address 0 and is heard, where perhaps nothing does."""
        for _ in range(END_ATTEMPTS):
            if identity := await self.rate.who_is(UNADDRESSED.address):
                return identity
        return None

    async def let_all_hear(self, expected: int) -> None:
        """Assign this many waiting addresses, to any modules, so that the next reset reaches every module.

        Behind a module that waits for its address one with an address is deaf, and those behind it receive: a reset
        then leaves it as it is, and two modules of the chain at address 0.
        """
        for address in WAITING_ADDRESSES[:expected]:
            await self._set_address(UNADDRESSED, address, EVERYBODY)

    async def move(self, waiting: int, address: int) -> bool:
        """Move the one module at a waiting address to its own, into its group; tell whether it did."""
        self.untold.add(address)
        for _ in range(ADDRESSING_ATTEMPTS):
            moved = await self._set_address(Node(waiting, ANY_DIALECT), address, self._plan.place(address).address)
            # it answers from the new address: a reply that was lost leaves open whether it has moved
            if moved or await self.rate.who_is(address, patient=True):
                if not self._plan.leads(address):
                    self.untold.discard(address)
                return True
        return False

    async def regroup(self, address: int) -> bool:
        """Tell an addressed module its group again, which keeps its address; tell whether it acknowledged that.

        Never repeated blindly: the same bytes once more are harmless, but only when the module is known to be there.
        """
        node = Node(address, ANY_DIALECT)
        self.untold.add(address)
        for _ in range(ADDRESSING_ATTEMPTS):
            if await self._set_address(
                node, address, self._plan.place(address).address, leader=self._plan.leads(address)
            ):
                self.untold.discard(address)
                return True
            if not await self.rate.who_is(address, patient=True):
                return False
        return False

    async def lead(self, address: int) -> None:
        """Make one module lead, if it is the leader of its group; it stays `untold` where it does not acknowledge."""
        if self._plan.leads(address):
            await self.regroup(address)

    async def without_leaders(self) -> None:
        """Make leaders members, so that their groups take Set Baud Rate; those that do not answer are left."""
        # its reply would come "at the new baud rate" (PIC-SERVO manual, 5.2, "Set Baud Rate")
        for address in self._plan.leaders:
            await self._set_address(Node(address, ANY_DIALECT), address, self._plan.place(address).address)

    async def with_leaders(self) -> None:
        """Make leaders lead, once all modules are at the rate where they stay; see `lead`."""
        for address in self._plan.leaders:
            await self.regroup(address)

    async def _set_address(self, node: Node, address: int, group: int, *, leader: bool = False) -> bool:
        packet = commands.set_address(node, address, group, leader=leader)
        try:
            await self._bus.execute(packet)
        except (OutcomeUnknown, BadReply, PacketRejected):
            return False
        return True
