"""Bringing a chain to the state in which every module has the address of its place, without a reset of what works.

A module that lost power waits at address 0 and 19200 baud. Its address output is high, so the next one is deaf; one
behind that receives, because the output of the deaf one is low. Several modules of one chain may thus wait at address 0
and receive together, and one more may restart between a proof and the packet that relies on it. So nothing at address 0
ever gets the address of a place. It first gets a waiting address, which belongs to no place: that is harmless whichever
module receives it, and connects those behind it, which is what a stop needs. From then on the modules at this waiting
address can only become fewer, and what is proven about them stays true until the packet that moves them to their place.

What proves a place, after every module that receives was taken off address 0:

* A place whose own address answers holds no waiting module. Waiting addresses that answer are held by different
  modules. If as many answer as places are silent, each is held by exactly one, and all modules have power and are
  heard. Where one place is silent, that tells which module it is.
* Which of several: neighbours are reset together, and then appear at address 0 in the order of the chain, as each keeps
  the next one deaf. A single one, reset by itself, makes the module behind it deaf, and no other.
* If fewer answer, some have no power, or hear and are not heard. Such a one may share the address of a module that is
  heard, but for its neighbours: at address 0 it keeps the next one deaf. So of two silent neighbours the one that waits
  is the second, if its reset makes the module behind that deaf. Nothing proves that it is the first: a chain whose last
  one has no power, and one in which the last one waits and the one before is not heard, look alike.

An identity proves no place, as drives may have been exchanged while they were dark: it must be the one that the
configuration expects at the place that was proven.

Modules of one kind that restarted at one instant, with one between them that kept its power, receive every packet
together. A packet that follows another one within a servo cycle overwrites it in those that have not executed it
(PIC-SERVO manual, 4.1); the cycles of two modules differ, so that some attempt moves one of them alone.

Whatever this cannot prove keeps its waiting address, and `problem` says what a person has to do. Only modules that have
restarted, and have not been given an address since, are ever reset. A PIC-SERVO SC is reset at address 0 before it gets
any: a start-up that it has saved may energise its motor with the address, but not after a reset by command.
Sources: PIC-SERVO manual, 4.1; LS-182AP manual, "Addressing", "Hard Reset".
"""

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise

from ldcnd.contract.errors import BadReply, CommandAborted, OutcomeUnknown, PacketRejected, StopLatched
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.addressing import WAITING_ADDRESSES, Addressing
from ldcnd.drives.ldcn.adoption import MOTION_ITEMS, WATCH_S, moves
from ldcnd.drives.ldcn.commands import Node, unanswered
from ldcnd.drives.ldcn.group_plan import WAITING_GROUP
from ldcnd.drives.ldcn.identity import ANY_DIALECT, UNADDRESSED, Expected, Identity
from ldcnd.drives.ldcn.line_rate import LineRate
from ldcnd.drives.ldcn.packet import StatusPacket
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, PacketEffect
from ldcnd.log import get_logger

log = get_logger("ldcn")

STEPS = 8
"""Most rounds of one search; each either gives an address, or separates modules, or is the last."""
SPLITS = 24
"""Most attempts of one search to separate modules that share a waiting address."""
LOOKED_FURTHER = 4
"""Further waiting addresses at which one search looks for leftovers: stops wait for the end of a bring-up."""
TOLD_AGAIN = 6
"""How often those at waiting addresses that do not answer are told the rate of the line once more: a line at two rates
polls less, and not for ever."""
CONFIRMATIONS = 3
"""Further replies that must be intact before what answers at a waiting address counts as one module there."""
IN_VAIN = 3
"""Most attempts to prove the places of the same silent modules: each can make a module deaf that works."""
GOLDEN = 0.618034
"""Instants that are spaced by this share of a servo cycle fall everywhere in it."""


@dataclass(frozen=True, slots=True)
class Stock:
    """Who answered after the last Set Address to address 0.

    Attributes:
        silent: places whose own address does not answer, as indices of the chain.
        waiting: identities at the waiting addresses that answer; None where replies collide or are damaged.
    """

    silent: tuple[int, ...]
    waiting: Mapping[int, Identity | None]

    @property
    def complete(self) -> bool:
        """Whether each silent place holds exactly one waiting address."""
        return len(self.waiting) == len(self.silent) and None not in self.waiting.values()

    @property
    def neighbours(self) -> bool:
        """Whether no module stands between the silent places."""
        return all(later == earlier + 1 for earlier, later in pairwise(self.silent))

    @property
    def one_of_two(self) -> bool:
        """Whether one module waits whose place is one of two neighbours."""
        heard = [each for each in self.waiting.values() if each]
        return self.neighbours and (len(self.silent), len(heard), len(self.waiting)) == (2, 1, 1)


class Gathering:
    """One line's modules that have lost their addresses.

    Attributes:
        places: of the chain, in its order.
        problem: what keeps modules from their addresses, with what a person has to do; empty without one.
    """

    def __init__(self, bus: Bus, rate: LineRate, addressing: Addressing, expected: tuple[Expected, ...]) -> None:
        self.problem = ""
        self._bus = bus
        self._rate = rate
        self._addressing = addressing
        self.places = expected
        own = {each.address for each in expected}
        self._pool = tuple(address for address in WAITING_ADDRESSES if address not in own)
        self._taken = 0
        self._waiting: list[int] = []
        self._empty: set[int] = set()  # waiting addresses at which nothing answered the last time
        self._told_again = 0  # how often, since something arrived at one
        self._attempt = 0
        self._beside: dict[int, int] = {}  # to where those that may share a waiting address are moved, to part them
        self._looked: int | None = None  # waiting addresses at which the leftovers of another daemon were looked for
        self._sorts = False
        self._in_vain: Counter[tuple[tuple[int, ...], int]] = Counter()  # by silent places and waiting modules
        self._wrong: tuple[str, ...] = ()  # which modules are in places that expect others

    @property
    def possible(self) -> bool:
        """Whether the port can speak to a module that has just restarted."""
        return self._bus.baud == self._rate.at_reset or self._rate.changeable

    async def search(
        self, addressing: Callable[[int], None], heard: Callable[[int], None], *, left: int = 0
    ) -> frozenset[int]:
        """Give modules that have restarted the addresses of their places; return the addresses that answer.

        Args:
            addressing: called with an address before a module that has restarted is given it.
            heard: called with the address of a place that answers.
            left: how many modules another daemon may have left at waiting addresses.

        Raises:
            BusError: the line failed meanwhile.
        """
        if not self.possible:
            return frozenset()
        if left:
            self._waiting = []
            await self._take_up(range(max(self._taken, left)))
        await self._take_saved_addresses()
        self._sorts = bool(await self._park_all())
        if not (self._sorts or self._waiting or (left and await self._look_further())):
            return frozenset()
        for _ in range(STEPS):
            stock = await self._take_stock(heard)
            if not stock.silent:
                break
            if await self._park_all():
                continue  # something has restarted meanwhile
            if not await self._step(stock, addressing):
                if left and await self._look_further():
                    continue
                self._report(stock)
                break
        else:
            stock = await self._take_stock(heard)
        if not stock.silent:
            self.problem = ""
        return frozenset(each.address for at, each in enumerate(self.places) if at not in stock.silent)

    def all_placed(self) -> None:
        """Take every waiting address for free: the place of each module was proven.

        Not earlier. Where one module was moved to its place, another may still wait: it got the address together with
        the first, and was deaf when the first was told the rate of the line. Nor is it enough that each place has
        answered: a late reply may have passed for the answer from a place whose module still waits.
        """
        self._start_over()
        self._in_vain.clear()

    def _start_over(self) -> None:
        self._taken, self._waiting = 0, []
        self._beside.clear()

    async def left_behind(self) -> frozenset[int]:
        """Return the rates of modules that a bring-up or a search has left when it was cut short, if no place answers.

        They are at waiting addresses, or several at address 0, where their replies collide.

        Raises:
            BusError: the line failed meanwhile.
        """
        rates = set()
        for baud in self._rate.candidates:
            if await self._rate.host_to(baud):
                addresses = self._pool[: len(self.places)]
                if any([await self._rate.who_is(address) for address in addresses]):
                    rates.add(baud)
        if not rates and await self._rate.host_to(self._rate.at_reset):
            first = await self._rate.listen(UNADDRESSED.address)
            if first is not None and first.identity is None:
                rates.add(self._rate.at_reset)
        return frozenset(rates)

    async def _take_up(self, numbers: range) -> bool:
        """Look for modules that were left at waiting addresses, by their numbers; tell whether there are any.

        A bring-up that was cut short has left them at the rate of power-up, in the group of everybody.
        """
        found = []
        for address in self._pool[numbers.start : numbers.stop]:
            for baud in dict.fromkeys((self._bus.baud, self._rate.at_reset)):
                if await self._rate.listen(address, baud):
                    found.append(address)
                    again = commands.set_address(Node(address, ANY_DIALECT), address, WAITING_GROUP)
                    await self._acknowledged(baud, again)
                    break
        if found:
            self._waiting += found
            self._taken = max(self._taken, self._pool.index(found[-1]) + 1)
            await self._to_line_rate()
        return bool(found)

    async def _look_further(self) -> bool:
        """Look for what another daemon may have left at later waiting addresses; tell whether there is anything.

        Not at the first attempt: it is to tell soon why the line is not up, and whether something moves.
        """
        if self._looked is None:
            self._looked = 0
            return False
        first = self._looked if self._taken <= self._looked < len(self._pool) else self._taken
        self._looked = first + LOOKED_FURTHER
        return await self._take_up(range(first, self._looked))

    async def _take_saved_addresses(self) -> None:
        """Reset each PIC-SERVO SC that has restarted with an address that it has saved, while it stands.

        It answers at the rate of power-up, where no other module is, and its saved settings may have energised its
        motor (data sheet, 4.6, 5.2). After a reset by command it waits at address 0 like the others.
        """
        at_reset = self._rate.at_reset
        if self._bus.baud == at_reset:
            return
        for each in self.places:
            if not (each.profile.sc_extensions and self._bus.misses(each.address)):
                continue
            # one that answers at the line's rate, too, has not restarted: only its replies were lost for a while, or
            # the port does not pass rates on (a pseudo-terminal); a reset would switch off a motor that holds
            heard = await self._rate.listen(each.address, at_reset)
            if heard and heard.identity and each.accepts(heard.identity) and not await self._answers(each.address):
                node = Node(each.address, each.profile)
                before = await self._rate.execute_at(at_reset, commands.read_status(node, MOTION_ITEMS))
                await asyncio.sleep(WATCH_S)
                after = await self._rate.execute_at(at_reset, commands.read_status(node, MOTION_ITEMS))
                if not moves(before, after):
                    await self._rate.execute_at(at_reset, commands.hard_reset(node))

    # -- waiting addresses -------------------------------------------------------------------------------------------

    async def _park_all(self) -> list[int]:
        """Give all that wait at address 0 and receive waiting addresses, and return these in their order."""
        arrived: list[int] = []
        while len(arrived) <= len(self.places) and await self._rate.listen(UNADDRESSED.address, self._rate.at_reset):
            arrived.append(await self._park())
        if arrived:
            self._in_vain.clear()
        return arrived

    async def _park(self) -> int:
        """Give what waits at address 0 a waiting address that no module has; it is at the line's rate afterwards."""
        address = await self._fresh()
        at_reset = self._rate.at_reset
        if any(each.profile.sc_extensions for each in self.places):
            await self._rate.execute_at(at_reset, commands.hard_reset(UNADDRESSED))
        # before the packet: if its reply is lost, the module may be there
        self._waiting.append(address)
        # this lets another one hear, which may have been deaf when it was told the rate of the line
        self._empty.clear()
        self._told_again = 0
        await self._acknowledged(at_reset, commands.set_address(UNADDRESSED, address, WAITING_GROUP))
        await self._to_line_rate()
        return address

    async def _to_line_rate(self) -> None:
        if self._bus.baud != self._rate.at_reset:
            await self._rate.execute_at(self._rate.at_reset, self._rate.set_baud(WAITING_GROUP, self._bus.baud))

    async def _fresh(self) -> int:
        """Return a waiting address that no module has had since all had their own."""
        if self._taken == len(self._pool):
            await self._release()
            self._start_over()
        self._taken += 1
        return self._pool[self._taken - 1]

    async def _release(self) -> None:
        """Reset all modules at waiting addresses: they have restarted, and nothing has been commanded since.

        One that is deaf, behind one that restarts, keeps its waiting address: it is looked for there later.
        """
        reset = commands.hard_reset(commands.LeaderlessGroup(WAITING_GROUP))
        # one that has missed Set Baud Rate is still at the rate of power-up
        for baud in dict.fromkeys((self._bus.baud, self._rate.at_reset)):
            await self._rate.execute_at(baud, reset)
        self._empty.update(self._waiting)

    # -- observations ------------------------------------------------------------------------------------------------

    async def _take_stock(self, heard: Callable[[int], None]) -> Stock:
        """Ask every place, and every waiting address; those that did not answer the last time once."""
        silent = []
        for at, each in enumerate(self.places):
            if await self._answers(each.address):
                heard(each.address)
            else:
                silent.append(at)
        present: dict[int, Identity | None] = {}
        if self._told_again < TOLD_AGAIN and self._empty.intersection(self._waiting):
            self._told_again += 1
            await self._to_line_rate()  # once more for those of before: noise may have spoilt it twice
        for address in tuple(self._waiting):
            answer = await self._rate.listen(address)
            if answer is None and address not in self._empty:
                await self._to_line_rate()  # the packet that should have brought it here may have been lost
                answer = await self._rate.listen(address)
            self._empty.discard(address)
            if answer is None:
                self._empty.add(address)
            else:
                present[address] = answer.identity
        return Stock(tuple(silent), present)

    async def _answers(self, address: int) -> bool:
        # one lost reply must not make a silent place of a working drive
        return await self._rate.who_is(address) is not None or await self._rate.who_is(address) is not None

    async def _acknowledged(self, baud: int | None, exchange: Exchange[StatusPacket]) -> None:
        """Send a packet whose effect is seen otherwise."""
        try:
            await self._rate.execute_at(baud, exchange)
        except (OutcomeUnknown, BadReply, PacketRejected, StopLatched, CommandAborted) as error:
            log.debug("not acknowledged", bus=self._bus.settings.name, reason=error.message)

    # -- steps -------------------------------------------------------------------------------------------------------

    async def _step(self, stock: Stock, addressing: Callable[[int], None]) -> bool:
        """Do what brings the chain nearer to its addresses; tell whether anything was found that does."""
        situation = stock.silent, len(stock.waiting)
        if self._in_vain[situation] < IN_VAIN:
            known = await self._prove(stock)
            for address, at in (known or {}).items():
                await self._give(address, self.places[at], addressing)
            if known is None or known:  # something has changed, or was placed: take stock again
                return True
            self._in_vain[situation] += 1
        if stock.complete:
            return False
        if self._sorts and stock.neighbours and len(stock.silent) > 1:
            self._sorts = False  # neighbours that wait need no splitting: once more, from a reset, in their order
            await self._release()
            await asyncio.sleep(commands.RESET_SETTLE_S)
            await self._park_all()
            return True
        return await self._split(stock)

    async def _prove(self, stock: Stock) -> dict[int, int] | None:
        """Return the proven places of waiting modules, by their addresses; None where something changed meanwhile."""
        self._wrong = ()
        if stock.complete and len(stock.silent) == 1:
            return await self._check(dict(zip(stock.waiting, stock.silent, strict=True)), stock)
        if stock.complete and stock.neighbours:
            return await self._by_order(stock)
        if stock.complete or (stock.one_of_two and stock.silent[-1] + 1 < len(self.places)):
            return await self._by_neighbour(stock)
        return {}

    async def _speaks_alone(self, address: int, identity: Identity | None) -> bool:
        """Tell whether one module is at a waiting address, also if one reply was lost or is one to something older."""
        for _ in range(CONFIRMATIONS):
            answer = await self._rate.listen(address)
            if answer is None or answer.identity is None or answer.identity != identity:
                return False
        return True

    async def _by_order(self, stock: Stock) -> dict[int, int] | None:
        """Reset neighbours that wait, all at once: each then keeps the next one deaf until it has an address."""
        await self._release()
        order: list[int] = []
        loop = asyncio.get_running_loop()
        until_s = loop.time() + self._rate.reset_s
        while len(order) < len(stock.silent) and loop.time() < until_s:
            if await self._rate.listen(UNADDRESSED.address, self._rate.at_reset):
                order.append(await self._park())
        return await self._confirm(stock, dict(zip(order, stock.silent, strict=False)))

    async def _by_neighbour(self, stock: Stock) -> dict[int, int] | None:
        """Reset waiting modules one after another: the module behind the one that is reset becomes deaf."""
        behind: dict[int, int] = {}  # own address of the next module, by waiting address
        names = dict.fromkeys(stock.waiting)
        now: dict[int, int] = {address: address for address in names}
        ahead: dict[int, int] = {}  # the waiting module behind a waiting module
        loop = asyncio.get_running_loop()
        for name in names:
            own = [self.places[at + 1].address for at in stock.silent if at + 1 < len(self.places)]
            candidates = [address for address in own if self._index(address) not in stock.silent]
            await self._bus.execute(commands.hard_reset(Node(now[name], ANY_DIALECT)))
            deaf = [address for address in candidates if not await self._answers(address)]
            hidden = [
                other
                for other in names
                if other != name and not (await self._rate.listen(now[other]) or await self._rate.listen(now[other]))
            ]
            until_s = loop.time() + self._rate.reset_s
            while not await self._rate.listen(UNADDRESSED.address, self._rate.at_reset):
                if loop.time() > until_s:
                    return None
            self._waiting.remove(now[name])
            now[name] = await self._park()
            # a reset makes one neighbour deaf, and its new address gives that one back: anything else has other causes
            if len(deaf) + len(hidden) > 1 or not all([await self._answers(address) for address in deaf]):
                return None
            if deaf:
                behind[name] = deaf[0]
            elif hidden:
                ahead[name] = hidden[0]
        if not (stock.complete or behind):
            return {}
        places = {name: self._index(address) - 1 for name, address in behind.items()}
        last = [name for name in names if name not in behind and name not in ahead]
        if stock.complete and len(last) == 1:
            places[last[0]] = len(self.places) - 1  # every other one has a module behind it
        for _ in names:
            for name, other in ahead.items():
                if other in places:
                    places[name] = places[other] - 1
        return await self._confirm(stock, {now[name]: at for name, at in places.items()})

    async def _confirm(self, stock: Stock, found: dict[int, int]) -> dict[int, int] | None:
        """Return what was found of all that wait, if nothing but that has changed since."""
        again = await self._take_stock(lambda _: None)
        if again.silent != stock.silent or set(again.waiting) != set(found) or len(found) != len(stock.waiting):
            return None
        if len(set(found.values())) != len(found) or not set(found.values()).issubset(stock.silent):
            return None
        return await self._check(found, again)

    async def _check(self, found: dict[int, int], stock: Stock) -> dict[int, int] | None:
        """Return what was found, if every identity is the one that is expected there.

        None where one does not go on to say who it is: its answer may have been a late one of the module at the place,
        to a question of before. That module has kept all it was set to.
        """
        for address in found:
            if not await self._speaks_alone(address, stock.waiting[address]):
                return None
        different = (self.places[at].differs(stock.waiting[address]) for address, at in found.items())
        self._wrong = tuple(sorted(filter(None, different)))
        return {} if self._wrong else found

    def _index(self, address: int) -> int:
        return next(at for at, each in enumerate(self.places) if each.address == address)

    async def _give(self, waiting: int, place: Expected, addressing: Callable[[int], None]) -> None:
        """Move the one module at a waiting address to its place."""
        log.info("newcomer", bus=self._bus.settings.name, address=place.address)
        addressing(place.address)
        if await self._addressing.move(waiting, place.address):
            await self._addressing.lead(place.address)

    async def _split(self, stock: Stock) -> bool:
        """Separate modules that share a waiting address; tell whether more waiting addresses answer than before."""
        byte_s = self._bus.settings.bits_per_byte / self._bus.baud
        # neighbours share none: one that waits for it keeps the next one deaf
        if stock.one_of_two or len(stock.waiting) >= len(stock.silent) or 2 * byte_s >= self._rate.cycle_s:
            return False
        for address, identity in stock.waiting.items():
            here, there = address, self._beside.pop(address, 0)
            if not there:
                there = await self._fresh()
                self._waiting.append(there)
            # an intact identity is most likely that of one module, but two that answer in step look like one
            for _ in range(SPLITS if identity is None else 1):
                await self._move_some(here, there)
                if await self._rate.listen(there):
                    if await self._rate.listen(here):
                        return True
                    # all of them have moved: once more, from there
                    here, there = there, here
            self._beside[here] = there
            self._empty.add(there)
        return False

    async def _move_some(self, here: int, there: int) -> None:
        """Move those modules at a waiting address that execute the packet before another one overwrites it."""
        node = Node(here, ANY_DIALECT)
        request = commands.set_address(node, there, WAITING_GROUP).request + commands.no_operation(node).request
        self._attempt += 1
        # behind the resynchronisation, whose end follows the last reply and so the cycle of a module
        await asyncio.sleep(self._bus.quarantine_s + self._attempt * GOLDEN % 1.0 * self._rate.cycle_s)
        quiet_s = 3.0 * self._rate.cycle_s
        await self._bus.execute(
            unanswered(WAITING_GROUP, request, quiet_s, repeatable=False, effect=PacketEffect.ARRANGES)
        )

    def _report(self, stock: Stock) -> None:
        """Say once what keeps modules from their addresses."""
        silent = ", ".join(f"{self.places[at].address} ({self.places[at].what})" for at in stock.silent)
        foreign = {
            str(identity)
            for identity in stock.waiting.values()
            if identity and not any(self.places[at].accepts(identity) for at in stock.silent)
        }
        if foreign:
            problem = (
                f"{', '.join(sorted(foreign))} waits for an address, and none of the addresses {silent} expects it"
            )
        elif self._wrong:
            problem = f"{'; '.join(self._wrong)}; switch off, and put each module into its place"
        elif stock.waiting:
            problem = (
                f"address {silent} of the chain: {len(stock.silent)} do not answer, {len(stock.waiting)} can be told"
                " apart, and which is which is not proven; switch those on that have no power, repair what hears and is"
                " not heard, or switch one of them off and on again, alone"
            )
        else:
            problem = ""
        if problem and problem != self.problem:
            log.error("address not proven", bus=self._bus.settings.name, reason=problem)
        self.problem = problem
