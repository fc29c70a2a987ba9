"""Taking over a running LDCN/NMC line.

Adoption finds the line at whatever rate, identifies the modules and moves nothing: it sends nothing but nulls, Read
Status and No Operation, and Define Status where another host has its replies contain more. Positions and motions go on;
gains cannot be read back and count as those of the configuration.
"""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass

from ldcnd.contract.errors import BusDown, BusError, LdcndError, NetworkMismatch
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.identity import Expected, Identity, differences
from ldcnd.drives.ldcn.line_rate import LineRate
from ldcnd.drives.ldcn.packet import STATUS_BYTE_ONLY, AuxFlag, StatusFlag, StatusItem, StatusPacket
from ldcnd.drives.ldcn.profiles import Profile, Support
from ldcnd.line.bus import Bus

UNADDRESSED = 0
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
        bared: addresses whose replies another host had extended.
    """

    baud: int
    identities: Mapping[int, Identity]
    states: Mapping[int, StatusPacket]
    bared: tuple[int, ...] = ()


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
        """Find every expected module at one rate, and stay there.

        Raises:
            NetworkMismatch: a module is missing, is something else, is at another rate than the others, or answers
                otherwise than the manual says; says precisely what differs.
            BusError: the line failed meanwhile.
        """
        await self.search()
        identities = {address: found.identity for address, found in self.found.items()}
        problems = list(differences(self._expected, identities))
        # addresses follow the chain from 1 on, so one module more has the next one
        if not problems and (more := await self._rate.who_is(len(self._expected) + 1)):
            problems.append(f"address {len(self._expected) + 1}: {more} is not configured")
        bauds = sorted({found.baud for found in self.found.values()})
        if len(bauds) > 1:
            problems += [f"address {address} is at {found.baud} baud" for address, found in sorted(self.found.items())]
        if problems:
            raise NetworkMismatch(
                f"bus {self._bus.settings.name}: not taken over, {len(self.found)} of {len(self._expected)} module(s)"
                f" answer; {'; '.join(problems)}",
                remedy='switch everything on, correct the configuration, or allow adopt_fallback = "reset"',
            )
        (baud,) = bauds
        await self._rate.host_to(baud)
        bared = tuple([each.address for each in self._expected if await self._bare_status(each)])
        states = {each.address: await self._motion_state(each) for each in self._expected if _is_servo(each)}
        return Adopted(baud, identities, states, bared)

    async def not_standing(self) -> tuple[str, ...]:
        """Return in words what keeps the line from a reset: what moves, and what is not known to stand.

        A silent module is not known to stand, also behind one that waits for its address: it may only be kept from
        hearing, and go on with its motion. `Gathering` makes such modules audible. Where nothing answers but a
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
            if moves(before[address], after[address]):
                obstacles.append(f"address {address}, {found.identity}, moves")
        # the manuals have no watchdog: what moves goes on without its host
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

    async def _motion_states(self, watched: Mapping[int, tuple[Found, Profile]]) -> dict[int, StatusPacket | None]:
        states: dict[int, StatusPacket | None] = dict.fromkeys(watched)
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
                # at most rates nobody is: each silent address would cost all of the bus's attempts there
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

    async def _bare_status(self, each: Expected) -> bool:
        """Have the module add nothing to its replies; return whether another host had it add something.

        What Define Status has set cannot be read back: the reply to No Operation shows it by its length.
        """
        node = Node(each.address, each.profile)
        try:
            await self._bus.execute(commands.no_operation(node))
        # the line, not the module
        except BusDown:
            raise
        except BusError:
            try:
                await self._bus.execute(commands.define_status(node, STATUS_BYTE_ONLY))
                await self._bus.execute(commands.no_operation(node))
            except BusDown:
                raise
            except LdcndError as error:
                raise NetworkMismatch(
                    f"bus {self._bus.settings.name}: not taken over, address {each.address} ({each.what}) does not"
                    " answer No Operation with a bare status byte, also after Define Status",
                    remedy="stop the host that has set it up, or reset the line",
                ) from error
            return True
        return False

    async def _motion_state(self, each: Expected) -> StatusPacket:
        return await self._bus.execute(commands.read_status(Node(each.address, each.profile), MOTION_ITEMS))


def _is_servo(each: Expected) -> bool:
    return each.profile.support is Support.FULL


def moves(before: StatusPacket | None, after: StatusPacket | None) -> bool:
    """Judge by velocity, by a profile that runs with the loop closed, and by two positions; not known counts as yes."""
    if before is None or after is None or before.position is None or after.position is None:
        return True
    runs = any(
        bool(status.velocity)
        or (status.aux is not None and bool(status.aux & AuxFlag.SERVO_ON) and not status.flags & StatusFlag.MOVE_DONE)
        for status in (before, after)
    )
    return runs or abs(after.position - before.position) > STILL_COUNTS
