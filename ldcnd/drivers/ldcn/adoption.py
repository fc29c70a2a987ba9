"""Taking over a running LDCN/NMC line as it is: found at whatever rate, identified, and not touched.

Sends nothing but nulls, Read Status and No Operation. Positions and motions go on; gains cannot be read back and count
as those of the configuration.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from ldcnd.bus.bus import Bus
from ldcnd.drivers.ldcn import commands
from ldcnd.drivers.ldcn.destinations import Node
from ldcnd.drivers.ldcn.identities import Expected, Identity, differences
from ldcnd.drivers.ldcn.profiles import Support
from ldcnd.drivers.ldcn.rates import LineRate
from ldcnd.drivers.ldcn.status import AuxFlag, Status, StatusFlag, StatusItem
from ldcnd.errors import BusDown, BusError, NetworkMismatch

MOTION_ITEMS = StatusItem.VELOCITY | StatusItem.AUX


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
        await self._search()
        identities = {address: found.identity for address, found in self.found.items()}
        problems = list(differences(self._expected, identities))
        bauds = sorted({found.baud for found in self.found.values()})
        if len(bauds) > 1:
            problems += [f"address {address} is at {found.baud} baud" for address, found in sorted(self.found.items())]
        if problems:
            await self._rate.host_to(bauds[-1] if bauds else self._rate.working)  # where a stop may still be heard
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

    async def moving(self) -> tuple[str, ...]:
        """Return in words which of the modules found move, or may move as far as can be told.

        Raises:
            BusError: the line failed meanwhile.
        """
        moving = []
        for address, found in sorted(self.found.items()):
            profile = found.identity.profile
            if profile is None:
                moving.append(f"address {address}, {found.identity}, may move: its status is unknown")
                continue
            if profile.support is not Support.FULL or not await self._rate.host_to(found.baud):
                continue
            status = await self._bus.execute(commands.read_status(Node(address, profile), MOTION_ITEMS))
            if _moves(status):
                moving.append(f"address {address}, {found.identity}, moves")
        return tuple(moving)

    async def _search(self) -> None:
        """Ask every expected address at every rate, the working rate first, until all have answered."""
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
        """Give those that were asked impatiently, before anybody had answered at this rate, a fair chance."""
        for each in self._expected:
            if each.address not in self.found and (identity := await self._rate.who_is(each.address, patient=True)):
                self.found[each.address] = Found(baud, identity)

    async def _check_default_status(self, each: Expected) -> None:
        """Prove that the module adds nothing to its replies: what Define Status was told cannot be read back."""
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


def _moves(status: Status) -> bool:
    """Judge by velocity, and by a profile that runs with the loop closed."""
    servo_on = status.aux is not None and bool(status.aux & AuxFlag.SERVO_ON)
    return bool(status.velocity) or (servo_on and not status.flags & StatusFlag.MOVE_DONE)
