"""A drive that can be read over its line and not be moved: every motion is refused."""

from typing import NoReturn

from typing_extensions import override

from ldcnd.drivers.driver import (
    AnalogMotion,
    AxisDriver,
    AxisReading,
    Gains,
    HomeCapture,
    Motion,
    PwmOutput,
    StopMode,
)
from ldcnd.errors import NotSupported
from ldcnd.exchange import Exchange
from ldcnd.model.samples import TelemetryItem


class ReadOnlyAxis(AxisDriver):
    """The motion half of `AxisDriver`, refused; a subclass brings its own poller."""

    def reading(self, items: frozenset[TelemetryItem]) -> Exchange[AxisReading]:
        """See `AxisDriver`; one exchange cannot tell so much here."""
        self._refuse(f"read {', '.join(sorted(items))} at once")

    @override
    def quantise(self, motion: Motion) -> Motion:
        self._refuse("move")

    @override
    async def power(self, *, on: bool) -> None:
        self._refuse("be enabled" if on else "be disabled")

    @override
    async def load(
        self,
        motion: Motion | AnalogMotion | PwmOutput,
        *,
        home: HomeCapture | None = None,
    ) -> None:
        self._refuse("move")

    @override
    async def start(self) -> None:
        self._refuse("move")

    @override
    async def stop(self, mode: StopMode) -> None:
        self._refuse("be stopped")

    @override
    async def captured_home(self) -> int:
        self._refuse("home")

    @override
    async def reset(self) -> None:
        self._refuse("be reset")

    @override
    async def set_gains(self, gains: Gains) -> None:
        self._refuse("take gains")

    def _refuse(self, what: str) -> NoReturn:
        raise NotSupported(
            f"axis {self.spec.name}: {self.spec.model} cannot {what} over its line",
            axis=self.spec.name,
            remedy="use the drive's own inputs",
        )
