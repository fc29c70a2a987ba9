"""What the parts of an LDCN or NMC servo drive share: the way to it, what is known of it, and the gains it needs."""

from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass
from typing import TypeVar

from ldcnd.contract.errors import RegisterUnknown, Remedy, WrongState, step
from ldcnd.drives.driver import AxisSpec, Gains
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag, StatusItem, StatusPacket
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.drives.ldcn.record import DriveState
from ldcnd.drives.ldcn.registers import ServoRegisters, Unknown
from ldcnd.line.bus import Bus

ValueT = TypeVar("ValueT")
STATE_ITEMS = StatusItem.POSITION | StatusItem.VELOCITY | StatusItem.AUX
LOADED_AT_REST = Remedy(
    "{} and wait, or {} if its loop hunts: at standstill the gains are loaded again",
    step("halt"),
    step("power", 'send power {"on": false}', on=False),
)
AGREE_WITHIN = 4
"""Replies of which one is to agree with the one before it."""


async def agreed(read: Callable[[], Awaitable[ValueT]]) -> ValueT | None:
    """Read until a reply agrees with the one before it: one byte alone vouches for each. None where none does."""
    before = await read()
    for _ in range(AGREE_WITHIN):
        value = await read()
        if value == before:
            return value
        before = value
    return None


@dataclass(frozen=True, slots=True)
class ServoAccess:
    """One servo drive on its line.

    Attributes:
        spec: what the configuration says of it.
        profile: its dialect.
        bus: its line.
        node: where it answers.
        book: what its registers hold.
        state: what else is known of it.
    """

    spec: AxisSpec
    profile: Profile
    bus: Bus
    node: Node
    book: ServoRegisters
    state: DriveState

    async def read(self, items: StatusItem) -> StatusPacket:
        """Read these items of its status."""
        return await self.bus.execute(commands.read_status(self.node, items))

    async def _stands(self, *, when_done: bool) -> bool:
        """Read the drive: its loop is open, or it stands, see `Moves.load`; a loop hunts by a count."""
        status = await self.read(STATE_ITEMS)
        if status.aux is not None and not status.aux & AuxFlag.SERVO_ON:
            return True
        return when_done and bool(status.flags & StatusFlag.MOVE_DONE) and abs(status.velocity or 0) <= 1

    def unknown(self, register: str, remedy: str) -> RegisterUnknown:
        """Return the refusal of what needs a register of which it is not known what it holds."""
        holding = self.book[register]
        why = f": {holding.why}" if isinstance(holding, Unknown) else ""
        return RegisterUnknown(
            f"axis {self.spec.name}: what register {register} of the drive holds is not known{why}",
            axis=self.spec.name,
            value=register,
            remedy=remedy,
        )

    def next_divisor(self, *, in_motion: bool = False) -> int:
        """Return the servo rate divisor in which the next motion will be loaded.

        Args:
            in_motion: it goes on from the motion under way, before which no gains are loaded.

        Raises:
            RegisterUnknown: it is not known, and no gains are there to be loaded.
        """
        divisor = self.book.divisor if in_motion else self.book.next_divisor
        if divisor is None:
            all_gains = Remedy("{}", step("set_gains", "send set_gains with all gains"))
            raise self.unknown("sr", LOADED_AT_REST if in_motion and self.book.wanted_gains else all_gains)
        return divisor

    def check_planned(self, planned: int | None, divisor: int) -> None:
        """Refuse a motion that was rounded to registers for another servo rate divisor than is in force.

        Rounded again, its values would be others, and above their limits perhaps.

        Raises:
            WrongState: it stands where it was thought to move, or moves where it was thought to stand.
        """
        if planned not in (None, divisor):
            raise WrongState(
                f"axis {self.spec.name}: the motion is planned for the servo rate divisor {planned}, and the drive has"
                f" {divisor}",
                axis=self.spec.name,
                value=divisor,
                limit=planned,
                remedy=LOADED_AT_REST,
            )

    async def ensure_gains(self, *, stands_when_done: bool) -> int:
        """Have the drive hold the gains that it should before a motion; return the servo rate divisor in force.

        "If the servo rate divisor is modified, the time dependent velocity and acceleration parameters will also have
        to be modified" (LS-182AP manual, "Servo Control"). Set Gain is idempotent and moves nothing at standstill. What
        is loaded are the gains that were acknowledged last, or the configured ones: a change that was reported as
        failed does not take effect later by itself.

        Raises:
            RegisterUnknown: the divisor is not known, and the axis moves or has no gains to be loaded.
        """
        book = self.book
        # in motion kp to deadband may be unknown: one of two values that clients gave, and Set Gain would act at once
        if book.wanted_gains is not None and not book.loaded:
            if not await self._stands(when_done=stands_when_done):
                return self.next_divisor(in_motion=True)
            await self.load_gains(book.wanted_gains, stands_when_done=stands_when_done)
        return self.next_divisor()

    async def load_gains(self, gains: Gains, *, stands_when_done: bool) -> None:
        """See `Moves.set_gains`."""
        exchange = commands.set_gain(self.node, gains)
        changes = self.profile.divisor_slows_profile and self.book.divisor != gains.sr
        if changes and not await self._stands(when_done=stands_when_done):
            raise WrongState(
                f"axis {self.spec.name} moves: another servo rate divisor would change its velocity",
                axis=self.spec.name,
                value=gains.sr,
                remedy=Remedy("{} and wait", step("halt")),
            )
        # a lost reply leaves each register the old or the new value, and the next motion loads them again
        with self.book.writing(asdict(gains)) as sent:
            await self.bus.execute(exchange, sent=sent)
        # only now: what was not acknowledged must not be loaded later by itself
        self.book.wanted_gains = gains
