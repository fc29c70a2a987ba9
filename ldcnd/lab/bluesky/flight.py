"""Flights: motions during which positions are recorded, of one axis or of several, as the events of one stream."""

import asyncio
import concurrent.futures
from collections import ChainMap, deque
from collections.abc import AsyncIterator, Coroutine, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

from ldcnd.client.loop_thread import LoopThread
from ldcnd.contract.errors import LdcndError, OutcomeUnknown, WrongState
from ldcnd.contract.samples import Quality
from ldcnd.lab.bluesky.status import Status
from ldcnd.lab.bluesky.values import PATIENCE_S, number_keys

if TYPE_CHECKING:
    from bluesky.protocols import Hints, Reading
    from event_model.documents import DataKey
    from event_model.documents.event_page import PartialEventPage

    from ldcnd.client.axis import Positions
    from ldcnd.lab.bluesky.axis import PlanAxis

PAGE_SAMPLES = 1000
"""Maximum number of positions on a page of a fly scan."""
POSITIONS_BEHIND = 4
"""Positions of an axis that follow an instant until the daemon knows where it was then."""


Place: TypeAlias = "dict[str, Reading[float | str]]"
"""Where an axis was, as its readings are."""
Row = tuple[Place, ...]


@dataclass(frozen=True, slots=True)
class Fly:
    """A motion during which positions are recorded; what `prepare` takes.

    Attributes:
        start: where it begins, in axis units.
        end: where it ends, in axis units.
        velocity: of the motion, in units a second; that of the device's moves when missing.
    """

    start: float
    end: float
    velocity: float | None = None


@dataclass(slots=True)
class _Preparation:
    """What `prepare` was given.

    Attributes:
        flights: by the names of the devices.
        stops: how often each axis was stopped before it went to its start, likewise.
        starts: where each axis was sent, as its drive's registers have it, likewise.
        ready: each axis is at its start.
    """

    flights: Mapping[str, Fly]
    stops: dict[str, int | None] = field(default_factory=dict)
    starts: dict[str, float | None] = field(default_factory=dict)
    ready: bool = False


class Flight:
    """Axes that fly at the same time; made by `Devices.flight`. Each axis is one of its own, too.

    An event has the position of the first axis, and where the others were at that instant; what such an axis had
    published last, with the time of that, where the daemon does not know.

    Attributes:
        name: of the device.
        parent: None; it is part of no other device.
    """

    parent = None

    def __init__(self, name: str, axes: "tuple[PlanAxis, ...]", loop: LoopThread) -> None:
        self.name = name
        self._axes = axes
        self._loop = loop
        # what was called last: each is used and replaced where it is called, before anything of it happens on the loop
        self._prepared: tuple[_Preparation, Status] | None = None
        self._kicked_off: concurrent.futures.Future[Status | None] | None = None
        self._unfinished: dict[str, Fly] = {}  # what was prepared last, until it has ended well
        self._resumed = False
        self._rows: list[Row] = []
        for axis in axes:
            axis.join(self)

    @property
    def hints(self) -> "Hints":
        """Plot the positions."""
        return {"fields": [axis.name for axis in self._axes]}

    def prepare(self, value: "Fly | Mapping[str, Fly]") -> Status:
        """Move each axis to the start of its motion, after a check of all ends.

        Args:
            value: by the names of the devices; a single one for a flight of one axis.
        """
        self._prepared = self._kicked_off = None
        flights = {self._axes[0].name: value} if isinstance(value, Fly) else dict(value)
        if set(flights) != {axis.name for axis in self._axes}:
            named = ", ".join(axis.name for axis in self._axes)
            raise WrongState(
                f"{self.name}: a flight of each of {named} is needed, there is one of {', '.join(flights)}"
            )
        self._unfinished, self._resumed = flights, False
        self._prepared = _, prepared = self._prepare(flights)
        return prepared

    def _prepare(self, flights: Mapping[str, Fly]) -> tuple[_Preparation, Status]:
        preparation = _Preparation(flights)

        async def check() -> None:
            for axis in self._axes:
                preparation.stops[axis.name] = await axis.stops_so_far()
            for axis in self._axes:
                await axis.check_flight(flights[axis.name])

        checking = self._loop.start(check())  # of all, before the first one moves

        async def checked(axis: "PlanAxis") -> int | None:
            await asyncio.wrap_future(checking)
            return preparation.stops[axis.name]

        def sent(axis: "PlanAxis", start: float | None) -> None:
            preparation.starts[axis.name] = start

        moves = [
            axis.prepare_flight(flights[axis.name], partial(checked, axis), partial(sent, axis)) for axis in self._axes
        ]

        async def ready() -> None:
            await asyncio.gather(*(moved.wrapped() for moved in moves))
            preparation.ready = not any(axis.is_stopped() for axis in self._axes)

        return preparation, self._start("preparation", ready())

    def forget(self) -> None:
        """Prepare anew before the next kickoff: an axis is stopped."""
        self._prepared = None

    def kickoff(self) -> Status:
        """Begin the motions that `prepare` was given; done when every drive has acknowledged its own.

        It waits for the preparation that was called last, which outlasts no stop of an axis by anybody, and nothing
        that sends an axis away from its start or makes another place of it. Of a plan that was paused in the flight and
        goes on behind its `prepare` they are prepared anew first.
        """
        prepared, self._prepared = self._prepared, None
        self._kicked_off = self._loop.start(self._kick_off(prepared))
        return Status(f"kickoff of {self.name}", self._kicked_off)

    async def _kick_off(self, prepared: tuple[_Preparation, Status] | None) -> Status | None:
        """Begin the motions, and return their status; None where the preparation was stopped meanwhile."""
        if prepared is None and not (self._resumed and self._unfinished):
            raise self._unprepared()
        with ExitStack() as beginning:
            for axis in self._axes:
                beginning.enter_context(axis.beginning())
            preparation, under_way = prepared or self._prepare(self._unfinished)
            await under_way
            if not preparation.ready:
                return None
            for axis in self._axes:
                stands_there = await axis.stands_where_sent(preparation.starts.get(axis.name))
                if axis.is_stopped():  # a stop that comes to it here ends the kickoff as it says
                    continue
                if axis.was_stopped_since(preparation.stops[axis.name]):
                    raise self._unprepared(f": {axis.name} was stopped since")
                if not stands_there:
                    raise self._unprepared(f": {axis.name} was moved since, or its position was set")
            began: list[asyncio.Future[None]] = [asyncio.get_running_loop().create_future() for _ in self._axes]
            self._rows.clear()
            flight = self._start("flight", self._fly(preparation, began))
            try:
                await asyncio.gather(*began)
            except LdcndError:
                with suppress(LdcndError):  # the others are at rest then
                    await flight
                raise
            return flight

    def _unprepared(self, why: str = "") -> WrongState:
        return WrongState(f"{self.name}: no fly scan is prepared{why}", remedy="call prepare")

    def complete(self) -> Status:
        """Return the status of the motions of the kickoff that was called last, which may be on its way."""
        kicked_off = self._kicked_off
        if kicked_off is None:
            raise WrongState(f"{self.name}: no fly scan is under way")

        async def end() -> None:
            if flight := await asyncio.wrap_future(kicked_off):
                await flight

        return self._start("flight", end())

    def stop(self, success: bool = True) -> Status:  # noqa: FBT001, FBT002 - the protocol's signature
        """Halt the axes; see `PlanAxis.stop`."""
        halts = [axis.stop(success) for axis in self._axes]

        async def halted() -> None:
            for each in halts:
                await each

        return self._start("stop", halted())

    async def pause(self) -> None:
        """Halt the axes; see `PlanAxis.pause`."""
        await self.stop()

    async def resume(self) -> None:
        """Move nothing; a kickoff begins what was not finished anew."""
        self._resumed = True

    async def describe_collect(self) -> "dict[str, DataKey]":
        """Return what the events hold; the plan names the stream."""
        keys: dict[str, DataKey] = {}
        for axis in self._axes:
            keys |= number_keys(axis.name, await axis.describe_position())
        return keys

    async def collect_pages(self) -> "AsyncIterator[PartialEventPage]":
        """Yield the positions since the last call or the beginning, with the times at which the drives were there."""
        rows = await asyncio.wrap_future(self._loop.start(self._taken()))
        for first in range(0, len(rows), PAGE_SAMPLES):
            page = [dict(ChainMap(*row)) for row in rows[first : first + PAGE_SAMPLES]]
            yield {
                "time": [row[self._axes[0].name]["timestamp"] for row in page],
                "data": {key: [row[key]["value"] for row in page] for key in page[0]},
                "timestamps": {key: [row[key]["timestamp"] for row in page] for key in page[0]},
            }

    async def _taken(self) -> list[Row]:
        rows = list(self._rows)
        self._rows.clear()
        return rows

    async def _fly(self, preparation: _Preparation, began: list[asyncio.Future[None]]) -> None:
        """Move every axis to its end and keep the positions on the way."""
        readers = [axis.positions() for axis in self._axes]
        places = _Places(self._axes, self._rows)
        keeping = [
            asyncio.create_task(places.keep(at, positions), name=f"positions of {self._axes[at].name}")
            for at, positions in enumerate(readers)
        ]
        placing = asyncio.create_task(places.find(), name=f"places of {self.name}")
        moves = [
            axis.begin_flight(preparation.flights[axis.name], future, preparation.stops[axis.name])
            for axis, future in zip(self._axes, began, strict=True)
        ]
        try:
            for moved, future in zip(moves, began, strict=True):
                moved.add_callback(partial(_pass_on, self._loop, future))
            await asyncio.gather(*(moved.wrapped() for moved in moves))
            for kept in keeping:
                if kept.done():  # they end by an error alone
                    kept.result()
            for axis in self._axes:
                await axis.measured()
            await places.found()
            if not any(axis.is_stopped() for axis in self._axes):
                self._unfinished = {}
        except LdcndError:
            with suppress(LdcndError):  # what failed matters more than how the others came to rest
                await self.stop(success=False)
            raise
        finally:
            for task in (*keeping, placing):
                task.cancel()
            places.end()
        dropped = sum(reader.dropped for reader in readers)
        if dropped:
            raise OutcomeUnknown(
                f"{self.name}: {dropped} positions of the fly scan were lost: this program was too busy to take them"
            )

    def _start(self, name: str, work: Coroutine[object, object, None]) -> Status:
        return Status(f"{name} of {self.name}", self._loop.start(work))

    def __repr__(self) -> str:
        return f"<flight {self.name}: {', '.join(axis.name for axis in self._axes)}>"


class _Places:
    """Rows that wait until the daemon knows where all axes were at the instant of the first one.

    Args:
        axes: in the order of a row.
        rows: takes those that are known.
    """

    def __init__(self, axes: "tuple[PlanAxis, ...]", rows: list[Row]) -> None:
        self._axes = axes
        self._rows = rows
        self._last: dict[int, tuple[int, Place]] = {}
        self._counts = [0] * len(axes)
        self._waiting: deque[tuple[int, Row, tuple[int, ...]]] = deque()
        self._changed = asyncio.Event()
        self._takes = True
        self._all_found = asyncio.Event()

    async def keep(self, at: int, positions: "Positions") -> None:
        """Take the positions of an axis as they are published, until it is cancelled."""
        axis = self._axes[at]
        async for sample in positions:
            if sample.quality is Quality.BAD or (at in self._last and sample.t <= self._last[at][0]):
                continue  # what was published before once more: nothing was measured
            self._last[at] = sample.t, axis.news_of(sample).reading
            if at == 0 and self._takes and len(self._last) == len(self._axes):
                row = tuple(self._last[each][1] for each in range(len(self._axes)))
                self._waiting.append((sample.t, row, tuple(self._counts)))
            self._counts[at] += 1
            self._changed.set()

    async def find(self) -> None:
        """Hand rows over as they become known, until it is cancelled."""
        while True:
            while self._waiting and self._is_known():
                t, (first, *others), _ = self._waiting[0]
                found = [await axis.place_at(t) for axis in self._axes[1:]]
                self._waiting.popleft()
                self._rows.append((first, *(place or last for place, last in zip(found, others, strict=True))))
            if not self._waiting and not self._takes:
                self._all_found.set()
            self._changed.clear()
            await self._changed.wait()

    def _is_known(self) -> bool:
        behind = (now - then for now, then in zip(self._counts[1:], self._waiting[0][2][1:], strict=True))
        return all(count >= POSITIONS_BEHIND for count in behind)

    async def found(self) -> None:
        """Take no more rows, and wait until none waits, but not for ever."""
        self._takes = False
        if self._waiting:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._all_found.wait(), PATIENCE_S)

    def end(self) -> None:
        """Hand over what still waits as it was published."""
        self._rows.extend(row for _, row, _ in self._waiting)
        self._waiting.clear()


def _pass_on(loop: LoopThread, began: asyncio.Future[None], move: Status) -> None:
    """Let a motion that failed before it began be the error of its beginning; a stop that was meant is none."""

    def end() -> None:
        if began.done():
            return
        error = move.exception()
        if error is None:
            began.set_result(None)
        else:
            began.set_exception(error)

    loop.call(end)
