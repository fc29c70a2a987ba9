"""From an endpoint to Bluesky devices."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ldcnd.client.loop_thread import LoopThread, loop_thread
from ldcnd.client.rig import Rig
from ldcnd.client.rig import connect as connect_rig
from ldcnd.contract.errors import UnknownAxis
from ldcnd.contract.meta import AxisInfo
from ldcnd.lab.bluesky.axis import PlanAxis, ReadableAxis, described
from ldcnd.lab.bluesky.flight import Flight
from ldcnd.lab.bluesky.signal import Signal

LEASE_S = 2.0
"""Lease of a device unless it is given one, in seconds: a plan that computes holds up every thread a little."""


@contextmanager
def connect(
    endpoint: str | None = None, *, rig: str | None = None, config: Path | str | None = None
) -> Iterator["Devices"]:
    """Make devices of one rig for as long as the context lasts; arguments and errors are those of `ldcnd.connect`."""
    with loop_thread() as loop, loop.inside(connect_rig(endpoint, rig=rig, config=config)) as found:
        yield Devices(found, loop)


class Devices:
    """The axes of a rig as Bluesky devices; made by `connect`.

    Args:
        rig: the rig.
        loop: the loop on which it runs.
    """

    def __init__(self, rig: Rig, loop: LoopThread) -> None:
        self._rig = rig
        self._loop = loop

    @contextmanager
    def control(
        self, axis: str, *, client: str, name: str | None = None, lease_s: float = LEASE_S, force: bool = False
    ) -> Iterator[PlanAxis]:
        """Yield a device that moves an axis, under a lease of its own, until the context ends.

        Args:
            axis: which one.
            client: who this is, a name for people.
            name: of the device; that of the axis when missing.
            lease_s: how soon the daemon acts when this program disappears, 0.2 to 60 s.
            force: take control away from its holder.

        Raises:
            LeaseHeld: another program controls the axis.
            UnknownAxis: there is no such axis.
        """
        with self._loop.inside(self._rig.control(axis, client=client, lease_s=lease_s, force=force)) as held:
            yield PlanAxis(name or axis, held, self._known(axis), self._rig, self._loop)

    @contextmanager
    def control_all(self, *axes: str, client: str, lease_s: float = LEASE_S) -> Iterator[tuple[PlanAxis, ...]]:
        """Yield a device for each of several axes, as `control` does."""
        with ExitStack() as held:
            yield tuple(held.enter_context(self.control(axis, client=client, lease_s=lease_s)) for axis in axes)

    def flight(self, *axes: PlanAxis, name: str = "flight") -> Flight:
        """Return axes that fly at the same time as one device, whose positions are the events of one stream."""
        return Flight(name, axes, self._loop)

    @contextmanager
    def watch(self, axis: str, *, name: str | None = None) -> Iterator[ReadableAxis]:
        """Yield a device that reads an axis and controls nothing, until the context ends.

        Raises:
            UnknownAxis: there is no such axis.
        """
        info = self._known(axis)
        with self._loop.inside(self._rig.watch(axis)) as watched:
            yield ReadableAxis(name or axis, watched, info, self._rig, self._loop)

    def signal(self, axis: str, item: str, *, name: str | None = None) -> Signal:
        """Return an item of an axis as a device: `velocity`, `adc`, `state`, `fault`, or `monitor/<name>`.

        Raises:
            UnknownAxis: there is no such axis, or it does not publish the item.
        """
        info = self._known(axis)
        published = {*info.items, *(f"monitor/{monitor}" for monitor in info.monitors)}
        if item not in published:
            raise UnknownAxis(
                f"axis {axis} does not publish {item!r}; it publishes {', '.join(sorted(published))}",
                axis=axis,
                value=item,
            )
        return Signal(name or f"{axis}_{item.rpartition('/')[2]}", self._rig, info, item, self._loop)

    def _known(self, axis: str) -> AxisInfo:
        return self._loop.run(described(self._rig, axis))
