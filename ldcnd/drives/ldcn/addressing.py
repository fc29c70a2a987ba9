"""Bring-up of an LDCN/NMC line: who is on it, in which groups, at which rate, and one module after another out of 0.

A module has exactly one group address, so what concerns the whole line goes to all addresses in use. Rates are changed
by group commands without a leader (PIC-SERVO manual, 5.2 "Set Baud Rate"). What is sent at another rate than a module's
is noise to it: the bits of the header 0xAA alternate, which no slower sender's byte can produce at a faster receiver,
and the bytes received from a faster sender have no header, length and checksum that fit.
Sources: LS-182AP manual, "Addressing" with the flow chart of the procedure, "Define Status", item 5; PIC-SERVO manual,
4.1 "Network initialization", 5.2.
"""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from ldcnd.contract.errors import BadReply, CommandAborted, OutcomeUnknown, PacketRejected, ReplyTimeout, StopLatched
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node, spaced, unanswered
from ldcnd.drives.ldcn.packet import StatusItem, StatusPacket, check_status, decode_status
from ldcnd.drives.ldcn.profiles import CLOCK_HZ, CYCLE_CLOCKS, PIC_SERVO_SC, PIC_SERVO_V4, Profile, identify
from ldcnd.drives.ldcn.registers import FASTEST_BAUD, BaudCodes, actual_baud, baud_at_reset, baud_divisor
from ldcnd.drives.network import GroupSpec
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, PacketEffect, ReplyVerdict

ReplyT = TypeVar("ReplyT")

ANY_DIALECT = PIC_SERVO_V4
"""Status byte and identity are laid out alike everywhere, so any profile reads them."""
UNADDRESSED = Node(0, ANY_DIALECT)
"""The first module of the chain that has no address yet."""


@dataclass(frozen=True, slots=True)
class Identity:
    """A module's identification; 0 to 255 each."""

    device_id: int
    version: int

    @property
    def profile(self) -> Profile | None:
        """The dialect of this pair; None for an unsupported device."""
        return identify(self.device_id, self.version)

    def __str__(self) -> str:
        """Return a title for people."""
        profile = self.profile
        return f"{profile.title if profile else 'an unknown device'} (id {self.device_id}, version {self.version})"


@dataclass(frozen=True, slots=True)
class Expected:
    """The module that the configuration expects at an address.

    Attributes:
        address: 1 to 127.
        what: the axis it is, for messages.
        profile: the dialect spoken with it.
        identity: accepted although it is not among the profile's own.
    """

    address: int
    what: str
    profile: Profile
    identity: Identity | None = None

    def accepts(self, found: Identity) -> bool:
        """Tell whether this identity may be spoken with as configured."""
        return found == self.identity or found.profile == self.profile

    def differs(self, found: Identity | None) -> str | None:
        """Return in words how what was found differs; None when it does not."""
        if found is not None and self.accepts(found):
            return None
        return f"address {self.address} ({self.what}): expected {self.profile.title}, found {found or 'nothing'}"


def differences(expected: tuple[Expected, ...], found: Mapping[int, Identity]) -> tuple[str, ...]:
    """Return in words what is missing or something else, by address."""
    said = (each.differs(found.get(each.address)) for each in expected)
    return tuple(difference for difference in said if difference)


def read_identity(address: int, known: Identity | None = None) -> Exchange[StatusPacket]:
    """Return the exchange that reads id and version, and insists on the known ones if they are given."""
    exchange = commands.read_status(Node(address, ANY_DIALECT), StatusItem.IDENTITY)
    if known is None:
        return exchange

    def decode(data: bytes) -> StatusPacket:
        status = decode_status(ANY_DIALECT, StatusItem.IDENTITY, data)
        if identity_in(status) != known:
            raise BadReply(f"node {address} says {identity_in(status)}, known as {known}")
        return status

    return replace(exchange, decode=decode)


def identity_in(status: StatusPacket) -> Identity:
    """Return the identity that a status packet carries."""
    return Identity(status.device_id or 0, status.version or 0)


def once(exchange: Exchange[ReplyT]) -> Exchange[ReplyT]:
    """Return the exchange for a node that may not be there: it is not worth the bus's further attempts."""
    return replace(exchange, repeatable=False)


WAITING_ADDRESSES = tuple(range(127, 63, -1))
"""Given to what waits at address 0 until its place is proven; nothing that could move is ever sent there."""


def waiting_address(number: int) -> int:
    """Return the waiting address of the module with this number in the chain, from 1 on."""
    return WAITING_ADDRESSES[number - 1]


WAITING_GROUP = 0xFE
"""The group of modules at waiting addresses: no configured group reaches it."""
FIRST_GROUP = 0x81
"""Configured groups are numbered from here; 0x80 is avoided, as its leader's byte would be 0."""


@dataclass(frozen=True, slots=True)
class Group:
    """Modules that share a group address.

    Attributes:
        address: 0x80 to 0xFF.
        members: axis names; for `EVERYBODY` the axes that are in no configured group.
        leader: the member that answers for the group.
    """

    address: int
    members: frozenset[str]
    leader: str | None = None


class GroupPlan:
    """The groups of one line.

    Attributes:
        groups: those that have members, `EVERYBODY` first.
    """

    def __init__(self, specs: tuple[GroupSpec, ...], axes: Mapping[int, str]) -> None:
        configured = tuple(
            Group(FIRST_GROUP + number, frozenset(spec.axes), spec.leader) for number, spec in enumerate(specs)
        )
        others = frozenset(axes.values()).difference(*(group.members for group in configured))
        self.groups = (Group(EVERYBODY, others), *configured) if others else configured
        self._axes = axes

    @property
    def addresses(self) -> tuple[int, ...]:
        """Return every group address that a module may have, `EVERYBODY` first."""
        return (EVERYBODY, *(group.address for group in self.groups if group.address != EVERYBODY))

    def place(self, address: int) -> Group:
        """Return the group of the module at an individual address."""
        name = self._axes.get(address)
        return next((group for group in self.groups if name in group.members), Group(EVERYBODY, frozenset()))

    def leads(self, address: int) -> bool:
        """Tell whether the module at this address answers for its group."""
        leader = self.place(address).leader
        return leader is not None and self._axes.get(address) == leader

    @property
    def leaders(self) -> tuple[int, ...]:
        """Return the addresses of the modules that answer for their groups."""
        return tuple(address for address in self._axes if self.leads(address))

    def exactly(self, names: frozenset[str]) -> Group | None:
        """Return the group with exactly these members: a command to it concerns no other module."""
        return next((group for group in self.groups if group.members == names), None)

    def within(self, names: frozenset[str]) -> tuple[Group, ...]:
        """Return the groups all of whose members are among these."""
        return tuple(group for group in self.groups if group.members <= names)


COMMON_CODES = (0x0A, 0x14, 0x81)
"""Of the rates at which a crashed host may have left the drives: 115200, 57600 and 9600 baud with the usual clock."""
COMMON_BAUDS = (115_200, 57_600, 9600)
EVERYBODY = 0xFF
"""The group address after power-up."""
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

    async def who_is_at(self, baud: int, address: int) -> Identity | None:
        """Read the identity once at another rate than the other modules', which receive noise; otherwise `who_is`."""
        exchange = once(read_identity(address))
        return await self._answer(lambda: self.execute_at(baud, exchange))

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


MOST_MODULES = 32
ADDRESSING_ATTEMPTS = 3
END_ATTEMPTS = 2
"""The chain is expected to end here: each attempt to find one more module costs a time-out."""
RESTART_PAUSE_S = 0.05
"""From one question to a module that may be restarting to the next, seconds."""
DRAIN_S = 0.005
"""Silence after which no reply can come to a half-received packet that nulls have filled up."""


class Addressing:
    """Gives modules their addresses; neither of the procedures moves a motor.

    Attributes:
        rate: who is at which rate.
        had_address: addresses of modules that may have had theirs already, as they did not acknowledge getting it.
    """

    def __init__(self, bus: Bus, rate: LineRate, plan: GroupPlan) -> None:
        self.had_address: set[int] = set()
        self._bus = bus
        self.rate = rate
        self._plan = plan

    async def reset_all(self) -> None:
        """Hard Reset at every rate the drives may be at, twice each, ending at the rate they restart with.

        Time to restart is given at that last rate only: a module that obeyed at another one restarts meanwhile, and
        receives nothing that it would have to obey. The line is silent then for longer than any late reply takes.

        A module that is reset makes the next one deaf, so one that is left at a rate of its own would split the chain:
        all are called to one rate first, which leaves their address outputs as they are. PIC-SERVO version 4 obeys only
        a reset of the group it is in, so every known group address is reset; `EVERYBODY` last, because Logosol drives
        obey that one in any group, and would make those behind them deaf to their own.
        """
        for baud in (*self.rate.missed_by, *self.rate.candidates):
            if baud != self.rate.at_reset and await self.rate.host_to(baud):
                await self.without_leaders()
                await self.rate.everybody_to(self.rate.at_reset)
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
                receives is not the next place. Where there is one more, all are reset again, and it is returned with
                them: only the right number shows that none is without power, and in a chain without any address those
                that receive are the first ones.
        """
        count, late = await self._park_in_order(expected)
        if count == expected and late:
            # one that came late had kept the next one deaf to the reset, and what receives behind that was parked
            # before it, out of its turn: all of them hear now, so that behind another reset none has an address
            await self._reset_at(self.rate.at_reset, commands.RESET_SETTLE_S)
            await self._bus.execute(nulls(DRAIN_S))
            count, _ = await self._park_in_order(expected)
        surplus: Identity | None = None
        if not expected:
            while count < MOST_MODULES and await self._newcomer() and await self._park_expected(count + 1, 0.0):
                count += 1
        elif count == expected:
            await self._reset_strays(count)
            surplus = await self._newcomer()
        modules: dict[int, Identity] = {}
        for number in range(1, count + 1):
            # "the host can also use this mechanism to verify that the proper number of modules are present" (ibid.)
            identity = await self.rate.who_is(waiting_address(number), patient=True)
            if identity is None:
                return modules
            modules[number] = identity
        if surplus:
            await self._reset_at(self.rate.at_reset, commands.RESET_SETTLE_S)
            return modules | {count + 1: surplus}
        if count < expected:
            return modules
        for number in modules:
            if not await self.move(waiting_address(number), number):
                return {address: modules[address] for address in range(1, number)}
        return modules

    async def _reset_strays(self, places: int) -> None:
        """Reset what has the address of a place before it was given to any module.

        It was deaf to the reset, behind a module without power, and receives now that all others have addresses. So
        those that did not wait for it are not in the places that they seem to be in. It shows as one module more that
        waits at address 0, or by making the next one deaf.
        """
        nodes = [Node(number, ANY_DIALECT) for number in range(1, places + 1)]
        burst = self.rate.spaced([commands.hard_reset(node).request for node in nodes])
        await self._bus.execute(
            unanswered(EVERYBODY, burst, NULLS_SETTLE_S, repeatable=False, effect=PacketEffect.ARRANGES)
        )

    async def _park_in_order(self, expected: int) -> tuple[int, bool]:
        """Park what waits at address 0, one after another; return how many there were, and whether one came late.

        Late is who came behind another one: all that were reset at one instant wait for the first, and for no other.
        """
        self.had_address.clear()
        count, late, until_s = 0, False, asyncio.get_running_loop().time() + self.rate.reset_s
        while count < expected and (attempts := await self._park_expected(count + 1, until_s)):
            count, late = count + 1, late or (count > 0 and attempts > 1)
        return count, late

    async def _park_expected(self, number: int, until_s: float) -> int:
        """Give what waits at address 0 a waiting address; return at which attempt until that instant, 0 without one.

        A lost reply leaves open whether the module took the address: then it answers there.
        """
        # whoever receives at address 0 takes it: that is harmless only while no place is meant
        address, attempts = waiting_address(number), 0
        while attempts < ADDRESSING_ATTEMPTS or asyncio.get_running_loop().time() < until_s:
            attempts += 1
            # "the host starts by sending a Set Address command to module 0": the first that receives; it "will lower
            # its ADDR_OUT signal", and the next one receives (PIC-SERVO manual, 4.1)
            if await self._set_address(UNADDRESSED, address, EVERYBODY):
                return attempts
            if await self.rate.who_is(address):
                self.had_address.add(number)
                return attempts
            # it may be restarting: a packet that is only half received would be completed by the next one
            if attempts >= ADDRESSING_ATTEMPTS:
                await asyncio.sleep(RESTART_PAUSE_S)
        return 0

    async def _newcomer(self) -> Identity | None:
        """Return what waits at address 0 although no module is expected there any more."""
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
        for _ in range(ADDRESSING_ATTEMPTS):
            if await self._set_address(Node(waiting, ANY_DIALECT), address, self._plan.place(address).address):
                return True
            # it answers from the new address: a reply that was lost leaves open whether it has moved
            if await self.rate.who_is(address, patient=True):
                return True
        return False

    async def regroup(self, address: int) -> bool:
        """Tell an addressed module its group again, which keeps its address; tell whether it acknowledged that.

        Never repeated blindly: the same bytes once more are harmless, but only when the module is known to be there.
        """
        node = Node(address, ANY_DIALECT)
        for _ in range(ADDRESSING_ATTEMPTS):
            if await self._set_address(
                node, address, self._plan.place(address).address, leader=self._plan.leads(address)
            ):
                return True
            if not await self.rate.who_is(address, patient=True):
                return False
        return False

    async def lead(self, address: int) -> None:
        """Make one module lead, if it is the leader of its group."""
        if self._plan.leads(address):
            await self.regroup(address)

    async def without_leaders(self) -> None:
        """Make leaders members, so that their groups take Set Baud Rate; those that do not answer are left."""
        # its reply would come "at the new baud rate" (PIC-SERVO manual, 5.2, "Set Baud Rate")
        for address in self._plan.leaders:
            await self._set_address(Node(address, ANY_DIALECT), address, self._plan.place(address).address)

    async def with_leaders(self) -> None:
        """Make leaders lead, once all modules are at the rate where they stay."""
        for address in self._plan.leaders:
            await self.regroup(address)

    async def _set_address(self, node: Node, address: int, group: int, *, leader: bool = False) -> bool:
        packet = commands.set_address(node, address, group, leader=leader)
        try:
            await self._bus.execute(packet)
        except (OutcomeUnknown, BadReply, PacketRejected):
            return False
        return True
