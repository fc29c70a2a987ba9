"""A drive that can be read over its line and not be moved: every motion is refused."""

from typing import NoReturn

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

    def quantise(self, motion: Motion) -> Motion:  # noqa: ARG002 - part of the contract
        """See `AxisDriver`."""
        self._refuse("move")

    async def power(self, *, on: bool) -> None:
        """See `AxisDriver`."""
        self._refuse("be enabled" if on else "be disabled")

    async def load(
        self,
        motion: Motion | AnalogMotion | PwmOutput,  # noqa: ARG002 - part of the contract
        *,
        home: HomeCapture | None = None,  # noqa: ARG002 - part of the contract
    ) -> None:
        """See `AxisDriver`."""
        self._refuse("move")

    async def start(self) -> None:
        """See `AxisDriver`."""
        self._refuse("move")

    async def stop(self, mode: StopMode) -> None:  # noqa: ARG002 - part of the contract
        """See `AxisDriver`."""
        self._refuse("be stopped")

    async def captured_home(self) -> int:
        """See `AxisDriver`."""
        self._refuse("home")

    async def reset(self) -> None:
        """See `AxisDriver`."""
        self._refuse("be reset")

    async def set_gains(self, gains: Gains) -> None:  # noqa: ARG002 - part of the contract
        """See `AxisDriver`."""
        self._refuse("take gains")

    def _refuse(self, what: str) -> NoReturn:
        raise NotSupported(
            f"axis {self.spec.name}: {self.spec.model} cannot {what} over its line",
            axis=self.spec.name,
            remedy="use the drive's own inputs",
        )
