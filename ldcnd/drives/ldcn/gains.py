"""The position loop's registers of an LDCN or NMC servo drive: when they are loaded."""

from dataclasses import asdict

from ldcnd.contract.errors import Remedy, WrongState, step
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.access import ServoAccess


class GainRegisters:
    """Keeps the gains of one drive as they should be."""

    def __init__(self, of: ServoAccess) -> None:
        self._of = of

    def next_divisor(self) -> int:
        """Return the servo rate divisor in which the next motion will be loaded.

        Raises:
            RegisterUnknown: it is not known, and no gains are there to be loaded.
        """
        divisor = self._of.book.next_divisor
        if divisor is None:
            raise self._of.unknown("sr", Remedy("{}", step("set_gains", "send set_gains with all gains")))
        return divisor

    async def ensure(self) -> int:
        """Have the drive hold the gains that it should before a motion; return the servo rate divisor in force.

        "If the servo rate divisor is modified, the time dependent velocity and acceleration parameters will also have
        to be modified" (LS-182AP manual, "Servo Control"). Set Gain is idempotent and moves nothing at standstill. What
        is loaded are the gains that were acknowledged last, or the configured ones: a change that was reported as
        failed does not take effect later by itself.

        Raises:
            RegisterUnknown: the divisor is not known, and the axis moves or has no gains to be loaded.
        """
        book = self._of.book
        # in motion kp to deadband may be unknown: one of two values that clients gave, and Set Gain would act at once
        if book.wanted_gains is not None and not book.loaded:
            if await self._of.stands():
                await self.load(book.wanted_gains)
            elif book.divisor is None:
                raise self._of.unknown(
                    "sr", Remedy("{} and wait: at standstill the gains are loaded again", step("halt"))
                )
        return self.next_divisor() if book.divisor is None else book.divisor

    async def load(self, gains: Gains) -> None:
        """See `Moves.set_gains`."""
        exchange = commands.set_gain(self._of.node, gains)
        if self._of.profile.divisor_slows_profile and self._of.book.divisor != gains.sr and not await self._of.stands():
            raise WrongState(
                f"axis {self._of.spec.name} moves: another servo rate divisor would change its velocity",
                axis=self._of.spec.name,
                value=gains.sr,
                remedy=Remedy("{} and wait", step("halt")),
            )
        # a lost reply leaves each register the old or the new value, and the next motion loads them again
        with self._of.book.writing(asdict(gains)):
            await self._of.bus.execute(exchange)
        # only now: what was not acknowledged must not be loaded later by itself
        self._of.book.wanted_gains = gains
