"""A drive without the calls that can move it: those are methods of a permit."""

from typing import Any, NoReturn, Protocol

from typing_extensions import override

from ldcnd.contract.commands import HomeMethod, Verb
from ldcnd.contract.errors import NotSupported
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.driver import (
    NO_CEILING,
    AnalogMotion,
    AxisReading,
    AxisSpec,
    Ceiling,
    CountsMotion,
    Drive,
    Gains,
    HomeCapture,
    Moves,
    PathStatus,
    PwmOutput,
    StopMode,
    cannot,
)
from ldcnd.line.exchange import Exchange


class QuietDrive(Protocol):
    """Calls to a drive that need no permission: none of them can make it move."""

    spec: AxisSpec
    capabilities: frozenset[Verb]
    adc_full_scale: int | None
    retargets: bool
    wanted_gains: Gains | None
    holds_gains: bool
    home_methods: frozenset[HomeMethod]
    capture_s: float
    deceleration_counts_per_s2: float | None
    path_period_s: float
    path_packet: int
    path_most_counts: int

    def quantise(self, motion: CountsMotion, most: Ceiling = ...) -> CountsMotion: ...  # noqa: D102 - of `Moves`, as all of these
    def exchanges(self, motion: CountsMotion) -> tuple[Exchange[Any], ...]: ...  # noqa: D102
    def room_counts(self, *, forward: bool) -> int: ...  # noqa: D102
    async def stop(self, mode: StopMode) -> StopMode: ...  # noqa: D102
    async def reset(self) -> None: ...  # noqa: D102
    async def clear_warnings(self) -> None: ...  # noqa: D102
    async def captured_home(self) -> int: ...  # noqa: D102
    def stands_on(self, limit: HomeMethod, reading: AxisReading) -> bool: ...  # noqa: D102
    def check_path(self) -> None: ...  # noqa: D102
    def path_exchanges(self) -> tuple[Exchange[Any], ...]: ...  # noqa: D102
    async def path_status(self) -> PathStatus: ...  # noqa: D102


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
    def quantise(self, motion: CountsMotion, most: Ceiling = NO_CEILING) -> CountsMotion:
        self._refuse("move")

    @override
    def exchanges(self, motion: CountsMotion) -> tuple[Exchange[Any], ...]:
        return ()

    @override
    async def power(self, *, on: bool) -> None:
        self._refuse("be enabled" if on else "be disabled")

    @override
    async def load(self, motion: CountsMotion | AnalogMotion | PwmOutput, *, home: HomeCapture | None = None) -> None:
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
