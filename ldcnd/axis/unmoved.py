"""What is asked of a drive before it moves, and what stands for the motion of one that takes none."""

from collections.abc import Sequence
from typing import Any, NoReturn

from typing_extensions import override

from ldcnd.contract.errors import NotSupported
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.driver import (
    NO_CEILING,
    AnalogMotion,
    AxisReading,
    Ceiling,
    CountsMotion,
    Drive,
    Gains,
    HomeCapture,
    Moves,
    PwmOutput,
    QuietDrive,
    StopMode,
    cannot,
)
from ldcnd.line.exchange import Exchange


def homing(drive: QuietDrive) -> QuietDrive:
    """Return a drive as one that captures its position.

    Raises:
        NotSupported: it does not.
    """
    if drive.home_methods:
        return drive
    raise cannot(drive.spec, "home")


def walking(drive: QuietDrive) -> QuietDrive:
    """Return a drive as one that walks paths.

    Raises:
        NotSupported: it does not.
    """
    if drive.path_period_s:
        return drive
    raise cannot(drive.spec, "walk a path")


class Unmoved(Moves):
    """Stands for the motion of a drive that takes none over its line: everything is refused."""

    def __init__(self, drive: Drive) -> None:
        self.spec = drive.spec
        self.identity = drive.identity
        self.capabilities = drive.capabilities

    @override
    def reading(self, items: frozenset[TelemetryItem]) -> Exchange[AxisReading]:
        self._refuse(f"read {', '.join(sorted(items))} at once")

    @override
    def quantise(self, motion: CountsMotion, most: Ceiling = NO_CEILING, *, in_motion: bool = False) -> CountsMotion:
        self._refuse("move")

    @override
    def exchanges(
        self, legs: Sequence[CountsMotion], here: AxisReading, gains: Gains | None
    ) -> tuple[Exchange[Any], ...]:
        return ()

    @override
    async def power(self, *, on: bool) -> None:
        self._refuse("be enabled" if on else "be disabled")

    @override
    async def load(
        self,
        motion: CountsMotion | AnalogMotion | PwmOutput,
        *,
        home: HomeCapture | None = None,
        stands_when_done: bool,
    ) -> None:
        self._refuse("move")

    @override
    async def start(self) -> None:
        self._refuse("move")

    @override
    async def stop(self, mode: StopMode) -> StopMode:
        self._refuse("be stopped")

    @override
    async def reset(self) -> None:
        self._refuse("be reset")

    def _refuse(self, what: str) -> NoReturn:
        raise NotSupported(
            f"axis {self.spec.name}: {self.spec.model} cannot {what} over its line",
            axis=self.spec.name,
            remedy="use the drive's own inputs",
        )
