"""Traces of an axis as the readings of a Bluesky detector."""

import math
from typing import TYPE_CHECKING

from ldcnd.client.axis import Axis
from ldcnd.client.loop_thread import LoopThread
from ldcnd.client.traces import Trace as Taken
from ldcnd.contract.errors import OutcomeUnknown, WrongState
from ldcnd.lab.bluesky.status import Status
from ldcnd.lab.bluesky.values import array_key, reading

if TYPE_CHECKING:
    from bluesky.protocols import Hints, Reading
    from event_model.documents import DataKey


class TraceDetector:
    """A detector whose readings are rows of numbers: times in seconds, and a row for each channel.

    `trigger` records while a plan does something else; where the drive did not say, a row has nan. Made by
    `ReadableAxis.trace`.

    Attributes:
        name: of the device; readings are called `<name>_time` and `<name>_<channel>`.
        parent: None; it is part of no other device.
    """

    parent = None

    def __init__(
        self,
        name: str,
        axis: Axis,
        channels: tuple[str, ...],
        samples: int,
        interval_s: float | None,
        loop: LoopThread,
    ) -> None:
        self.name = name
        self._axis = axis
        self._channels = channels
        self._samples = samples
        self._interval_s = interval_s
        self._loop = loop
        self._taken: Taken | None = None

    @property
    def hints(self) -> "Hints":
        """Plot nothing: a row of numbers is no point."""
        return {"fields": []}

    def trigger(self) -> Status:
        """Take a trace; done when it is complete."""

        async def take() -> None:
            self._taken = None
            taken = await self._axis.take_trace(*self._channels, samples=self._samples, interval_s=self._interval_s)
            if len(taken.offsets_ns) != self._samples:
                raise OutcomeUnknown(
                    f"axis {self._axis.name}: the trace has {len(taken.offsets_ns)} samples instead of {self._samples}",
                    axis=self._axis.name,
                )
            self._taken = taken

        return Status(f"trace of {self.name}", self._loop.start(take()))

    async def read(self) -> "dict[str, Reading[list[float]]]":
        """Return the rows of the last trace, stamped with its beginning.

        Raises:
            WrongState: there is none.
        """
        if self._taken is None:
            raise WrongState(
                f"axis {self._axis.name}: no trace was taken", axis=self._axis.name, remedy="trigger first"
            )
        began_s = self._taken.header.t * 1e-9
        read = {f"{self.name}_time": reading([offset * 1e-9 for offset in self._taken.offsets_ns], began_s)}
        for channel, values in zip(self._channels, self._taken.values, strict=True):
            read[f"{self.name}_{channel}"] = reading([math.nan if v is None else v for v in values], began_s)
        return read

    async def describe(self) -> "dict[str, DataKey]":
        """Return what the rows are."""
        source = f"ldcnd://{self._axis.name}/trace"
        keys = {f"{self.name}_time": array_key(f"{source}/time", "s", self._samples)}
        for channel in self._channels:
            keys[f"{self.name}_{channel}"] = array_key(f"{source}/{channel}", "", self._samples)
        return keys

    def __repr__(self) -> str:
        return f"<trace {self.name}: {', '.join(self._channels)}>"
