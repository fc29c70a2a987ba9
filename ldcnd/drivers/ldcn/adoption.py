"""Taking over a running LDCN/NMC line, and bringing back modules that lost power, without a reset of the healthy ones.

Adoption finds the line at whatever rate, identifies the modules and touches nothing: it sends nothing but nulls, Read
Status and No Operation. Positions and motions go on; gains cannot be read back and count as those of the configuration.

A module that lost power comes back silent, at 19200 baud and address 0, and keeps those behind it in the chain from
receiving the host until it has an address again; they go on with what they were doing. A scan for it is one exchange at
19200 baud, on a line that stays at its working rate: modules at that rate receive noise. When it answers, all modules
that receive are taken down to 19200 baud, which is allowed while motors move, the newcomers get addresses one after
another, and all go back to the working rate. In between every exchange is an ordinary one: stops overtake, healthy
drives are polled at the lower rate. Some may have missed a change of rate, or have taken part in one before they had an
address: while a module is missing afterwards, it is searched for, too.

A PIC-SERVO SC may have saved its addresses: then it comes back with them, and never answers at address 0. One that
answers at 19200 baud with its own address, and cannot have missed a change of rate, has restarted. It is reset while it
stands, before it gets its address, because saved settings may have energised its motor, or would with the address.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from ldcnd.bus.bus import Bus
from ldcnd.drivers.ldcn import commands
from ldcnd.drivers.ldcn.addressing import Addressing, Expected, Identity, LineRate, differences
from ldcnd.drivers.ldcn.commands import Node
from ldcnd.drivers.ldcn.packet import AuxFlag, Status, StatusFlag, StatusItem
from ldcnd.drivers.ldcn.profiles import Profile, Support
from ldcnd.errors import BusDown, BusError, LdcndError, NetworkMismatch
from ldcnd.log import get_logger

log = get_logger("ldcn")

UNADDRESSED = 0
STRAY_SCANS = 3
"""Number of scans for each possible stray at its rate and address."""
MOTION_ITEMS = StatusItem.POSITION | StatusItem.VELOCITY | StatusItem.AUX
WATCH_S = 0.5
"""How long positions are watched before drives count as standing: the velocity in a status has no fraction."""
STILL_COUNTS = 2
"""A drive that stands changes its position by no more than that: a closed loop hunts a little."""


@dataclass(frozen=True, slots=True)
class Found:
    """A module that answered.

    Attributes:
        baud: the rate at which it did.
        identity: what it is.
    """

    baud: int
    identity: Identity


@dataclass(frozen=True, slots=True)
class Adopted:
    """A line that was taken over.

    Attributes:
        baud: the rate it is at.
        identities: by address.
        states: flags and auxiliary byte of every servo drive, by address.
    """

    baud: int
    identities: Mapping[int, Identity]
    states: Mapping[int, Status]


class Adoption:
    """One line's take-over.

    Attributes:
        found: who answered at the latest attempt, by address.
    """

    def __init__(self, bus: Bus, rate: LineRate, expected: tuple[Expected, ...]) -> None:
        self.found: dict[int, Found] = {}
        self._bus = bus
        self._rate = rate
        self._expected = expected

    async def attempt(self) -> Adopted:
        """Find every expected module at one rate, and stay there; also where only some were found.

        Raises:
            NetworkMismatch: a module is missing, is something else, is at another rate than the others, or answers
                like one that another host has set up; says precisely what differs.
            BusError: the line failed meanwhile.
        """
        await self.search()
        identities = {address: found.identity for address, found in self.found.items()}
        problems = list(differences(self._expected, identities))
        bauds = sorted({found.baud for found in self.found.values()})
        if len(bauds) > 1:
            problems += [f"address {address} is at {found.baud} baud" for address, found in sorted(self.found.items())]
        if problems:
            await self._rate.host_to(bauds[-1] if bauds else self._rate.working)  # where a stop may still be received
            raise NetworkMismatch(
                f"bus {self._bus.settings.name}: not taken over, {len(self.found)} of {len(self._expected)} module(s)"
                f" answer; {'; '.join(problems)}",
                remedy='switch everything on, correct the configuration, or allow adopt_fallback = "reset"',
            )
        (baud,) = bauds
        await self._rate.host_to(baud)
        for each in self._expected:
            await self._check_default_status(each)
        states = {each.address: await self._motion_state(each) for each in self._expected if _is_servo(each)}
        return Adopted(baud, identities, states)

    async def not_standing(self) -> tuple[str, ...]:
        """Return in words what keeps the line from a reset: what moves, and what is not known to stand.

        A silent module is not known to stand, also behind one that waits for its address: it may only be kept from
        hearing, and go on with its motion. `Rejoin.gather` makes such modules audible. Where nothing answers but a
        module that waits for its address, the line has been powered on or reset as a whole.

        Raises:
            BusError: the line failed meanwhile.
        """
        obstacles = []
        watched: dict[int, tuple[Found, Profile]] = {}
        for address, found in sorted(self.found.items()):
            profile = found.identity.profile
            if profile is None:
                obstacles.append(f"address {address}, {found.identity}, may move: its status is unknown")
            elif profile.support is Support.FULL:
                watched[address] = (found, profile)
        before = await self._motion_states(watched)
        await asyncio.sleep(WATCH_S)
        after = await self._motion_states(watched)
        for address, (found, _) in watched.items():
            if _moves(before[address], after[address]):
                obstacles.append(f"address {address}, {found.identity}, moves")
        silent = [each for each in self._expected if each.address not in self.found]
        if silent and (self.found or not await self._newcomer()):
            obstacles += [f"address {each.address} ({each.what}) does not answer and may move" for each in silent]
        return tuple(obstacles)

    async def _newcomer(self) -> bool:
        """Tell whether a module waits for its address."""
        return (
            await self._rate.host_to(self._rate.at_reset)
            and await self._rate.who_is(UNADDRESSED, patient=True) is not None
        )

    async def _motion_states(self, watched: Mapping[int, tuple[Found, Profile]]) -> dict[int, Status | None]:
        states: dict[int, Status | None] = dict.fromkeys(watched)
        for address, (found, profile) in watched.items():
            exchange = commands.read_status(Node(address, profile), MOTION_ITEMS)
            if await self._rate.host_to(found.baud):
                status = await self._bus.execute(exchange)
                states[address] = status
        return states

    async def search(self) -> None:
        """Probe every expected address at every rate, the working rate first, until all have answered."""
        self.found.clear()
        others = sorted(set(self._rate.candidates) - {self._rate.working}, reverse=True)
        for baud in (self._rate.working, *others):
            if not await self._rate.host_to(baud):
                continue
            heard = False
            for each in self._expected:
                if each.address in self.found:
                    continue
                identity = await self._rate.who_is(each.address, patient=heard or baud == self._rate.working)
                if identity:
                    heard = True
                    self.found[each.address] = Found(baud, identity)
            if heard:
                await self._ask_again(baud)
            if len(self.found) == len(self._expected):
                return

    async def _ask_again(self, baud: int) -> None:
        """Probe again, with patience, those that were probed before any module had answered at this rate."""
        for each in self._expected:
            if each.address not in self.found and (identity := await self._rate.who_is(each.address, patient=True)):
                self.found[each.address] = Found(baud, identity)

    async def _check_default_status(self, each: Expected) -> None:
        """Prove that the module adds nothing to its replies: the setting of Define Status cannot be read back."""
        try:
            await self._bus.execute(commands.no_operation(Node(each.address, each.profile)))
        except BusDown:
            raise
        except BusError as error:
            raise NetworkMismatch(
                f"bus {self._bus.settings.name}: not taken over, address {each.address} ({each.what}) does not answer"
                " No Operation with a bare status byte: another host has set it up",
                remedy="stop that host, or reset the line",
            ) from error

    async def _motion_state(self, each: Expected) -> Status:
        return await self._bus.execute(commands.read_status(Node(each.address, each.profile), MOTION_ITEMS))


def _is_servo(each: Expected) -> bool:
    return each.profile.support is Support.FULL


def _moves(before: Status | None, after: Status | None) -> bool:
    """Judge by velocity, by a profile that runs with the loop closed, and by two positions; not known counts as yes."""
    if before is None or after is None or before.position is None or after.position is None:
        return True
    runs = any(
        bool(status.velocity)
        or (status.aux is not None and bool(status.aux & AuxFlag.SERVO_ON) and not status.flags & StatusFlag.MOVE_DONE)
        for status in (before, after)
    )
    return runs or abs(after.position - before.position) > STILL_COUNTS


class Rejoin:
    """One line's search for newcomers."""

    def __init__(self, bus: Bus, rate: LineRate, addressing: Addressing, expected: tuple[Expected, ...]) -> None:
        self._bus = bus
        self._rate = rate
        self._addressing = addressing
        self._expected = expected
        self._strays: deque[tuple[int, int]] = deque()  # rates and addresses at which a stray module may be
        self._kept_addresses: set[int] = set()  # of those that have restarted with them
        self._foreign: Identity | None = None  # complained about already

    async def look(self, mute: tuple[Expected, ...], addressing: Callable[[int], None]) -> frozenset[int]:
        """Scan for these modules once, and bring back those that are found; return those known to answer.

        Args:
            mute: modules that have stopped answering, in the order of the chain.
            addressing: called with the address of a newcomer before it is given that address.

        Raises:
            BusError: the line failed meanwhile.
        """
        if self._bus.baud != self._rate.at_reset and not self._rate.changeable:
            return frozenset()  # a newcomer could not receive at this port's rates
        if not mute or not (await self._anybody_there(mute) or await self._anybody_with_saved_address(mute)):
            return frozenset()
        lost = [each for each in mute if await self._rate.who_is(each.address) is None]
        if lost:
            await self._at_reset_baud(lost, addressing)
        heard = [each.address for each in self._expected if await self._rate.who_is(each.address, patient=True)]
        # those behind a newcomer answer again, too
        self._suspect(each.address for each in self._expected if each.address not in heard)
        return frozenset(each.address for each in mute if each.address in heard)

    async def gather(self, found: Mapping[int, Found], addressing: Callable[[int], None]) -> bool:
        """Make a line audible that answers in part; tell whether there was something to do.

        Newcomers get their addresses, which reconnects those behind them, and modules that a lost host has left
        at different rates are brought to the working rate. Nothing is moved or reset.

        Args:
            found: who answered, at which rate; at least one.
            addressing: called with the address of a newcomer before it is given that address.

        Raises:
            BusError: the line failed meanwhile.
        """
        if not self._rate.changeable and self._bus.baud != self._rate.at_reset:
            return False
        lost = [each for each in self._expected if each.address not in found]
        rates = {each.baud for each in found.values()}
        if len(rates) == 1 and not (lost and await self._rate.who_is_at(self._rate.at_reset, UNADDRESSED)):
            return False
        for baud in rates - {self._rate.at_reset}:
            await self._rate.host_to(baud)
            await self._addressing.without_leaders()
            await self._rate.everybody_to(self._rate.at_reset)
        await self._at_reset_baud(lost, addressing)
        return True

    async def _anybody_there(self, mute: tuple[Expected, ...]) -> bool:
        """Probe for a newcomer at 19200 baud, and for one of those that may have strayed."""
        found = await self._rate.who_is_at(self._rate.at_reset, UNADDRESSED)
        if found and (found != self._foreign or mute[0].accepts(found)):
            return True
        if self._strays:
            baud, address = self._strays.popleft()
            awaited = address == UNADDRESSED or address in {each.address for each in mute}
            return awaited and await self._rate.who_is_at(baud, address) is not None
        return False

    async def _anybody_with_saved_address(self, mute: tuple[Expected, ...]) -> bool:
        """Return whether a mute module has come back at 19200 baud with an address that it has saved."""
        at_reset = self._rate.at_reset
        if self._bus.baud == at_reset:
            return False
        for each in mute:
            astray = (at_reset, each.address) in self._strays
            if each.profile.sc_extensions and not astray and await self._rate.who_is_at(at_reset, each.address):
                self._kept_addresses.add(each.address)
        return bool(self._kept_addresses)

    async def _stands(self, each: Expected) -> bool:
        exchange = commands.read_status(Node(each.address, each.profile), MOTION_ITEMS)
        before = await self._bus.execute(exchange)
        await asyncio.sleep(WATCH_S)
        after = await self._bus.execute(exchange)
        return not _moves(before, after)

    def _suspect(self, missing: Iterable[int]) -> None:
        strays = [(self._rate.at_reset, address) for address in missing]
        self._strays = deque([(self._rate.working, UNADDRESSED), *strays] * STRAY_SCANS if strays else [])

    async def _at_reset_baud(self, lost: list[Expected], addressing: Callable[[int], None]) -> None:
        """Address newcomers at the rate of power-up; all modules that receive are at the working rate afterwards."""
        self._suspect(each.address for each in self._expected)
        await self._addressing.without_leaders()
        await self._rate.everybody_to(self._rate.at_reset)
        try:
            await self._address_newcomers(lost, addressing)
        except LdcndError:
            if self._bus.is_open:
                await self._back_to_work()
            raise
        await self._back_to_work()

    async def _back_to_work(self) -> None:
        await self._rate.everybody_to(self._rate.working)
        await self._addressing.with_leaders()

    async def _address_newcomers(self, lost: list[Expected], addressing: Callable[[int], None]) -> None:
        """Give the module at address 0 the first address that is missing, as long as there is one."""
        for each in lost:
            if each.address in self._kept_addresses:
                self._kept_addresses.discard(each.address)
                if not await self._stands(each):
                    continue
                await self._bus.execute(commands.hard_reset(Node(each.address, each.profile)))
            elif await self._rate.who_is(each.address):
                continue  # it has its address, and had only missed a change of rate
            found = await self._rate.who_is(UNADDRESSED)
            if found is None:
                break  # the next one has no power, or keeps those behind it from receiving
            if not each.accepts(found):
                if found != self._foreign:
                    log.error("foreign newcomer", bus=self._bus.settings.name, place=each.what, found=str(found))
                self._foreign = found
                break
            log.info("newcomer", bus=self._bus.settings.name, address=each.address, identity=str(found))
            if each.profile.sc_extensions:
                # saved settings may energise its motor as it gets an address, but not after a reset by command
                await self._bus.execute(commands.hard_reset(Node(UNADDRESSED, each.profile)))
            addressing(each.address)
            if not await self._addressing.address_next(each.address):
                break
