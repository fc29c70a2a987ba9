"""The gateway: motor records of a rig, served over Channel Access for as long as it runs."""

import asyncio
import logging
import os
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from contextlib import asynccontextmanager
from functools import partial

from caproto.asyncio.server import Context

from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import check_axes
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.meta import AxisInfo
from ldcnd.lab.borrowed_control import BorrowedControl
from ldcnd.lab.epics.fields import Put, RecordField, Short, Value
from ldcnd.lab.epics.motor import MovedRecord
from ldcnd.lab.epics.record import MOTIONLESS, Defaults, MotorRecord
from ldcnd.lab.fresh import fresh_samples
from ldcnd.listen_address import ListenAddress

LEARN_S = 0.5
"""Time between two queries for velocities and accelerations that are not known yet, seconds."""
WHO = "epics gateway"


class Gateway:
    """Shows the axes of a rig as motor records; made by `gateway`.

    Attributes:
        variables: the process variables by name.
        circuits: the connections of clients over Channel Access at present.
        jog_channels: what clients over PV Access are connected to that jogs.
        on_added: called with the variables of each axis that comes later.
    """

    def __init__(self, rig: Rig, group: asyncio.TaskGroup, prefix: str, *, shows_all: bool, moves_all: bool) -> None:
        self.variables: dict[str, RecordField] = {}
        self.circuits: set[object] = set()
        self.jog_channels: set[object] = set()
        self.on_added: list[Callable[[Mapping[str, RecordField]], None]] = []
        self._prefix = prefix
        self._shows_all = shows_all
        self._moves_all = moves_all
        self._rig = rig
        self._group = group
        self._tasks: set[asyncio.Task[None]] = set()
        self._records: dict[str, MotorRecord] = {}
        self._learning: set[str] = set()
        self._all_stop = Short(value=0)
        self._all_stop.action = self._stop_all

    def begin(self) -> None:
        """Begin to follow what the axes are."""
        self._start(self._follow_descriptions(), "descriptions")

    def add(self, info: AxisInfo, defaults: Defaults | None, *, moves: bool) -> None:
        """Show an axis, and begin to follow it."""
        prefix = self._prefix
        record = (
            MovedRecord(info, defaults, self._start_motion, self.connected) if moves else MotorRecord(info, defaults)
        )
        record["NAME"].begin(f"{prefix}{info.axis}")
        self._records[info.axis] = record
        added = {f"{prefix}{name}": field for name, field in record.fields.items()}
        self.variables |= added
        for take in self.on_added:
            take(added)
        self._start(self._follow(record), f"values of {info.axis}")
        for monitor in info.monitors:
            self._start(self._follow_monitor(record, monitor), f"{monitor} of {info.axis}")
        if isinstance(record, MovedRecord):
            record.control = BorrowedControl(
                self._rig,
                info.axis,
                WHO,
                is_busy=record.is_busy,
                on_change=record.show_control,
                on_taken=partial(self._describe, record),
            )
            self._start(record.control.run(), f"control of {info.axis}")
            self.variables[f"{prefix}allstop"] = self._all_stop

    def end(self) -> None:
        """End all that runs in the background; motions halt when control is released."""
        for task in self._tasks:
            task.cancel()

    def connected(self) -> frozenset[object]:
        """Return who is connected now."""
        return frozenset(self.circuits | self.jog_channels)

    async def _follow_descriptions(self) -> None:
        async for described in self._rig.follow_descriptions():
            for name, info in described.items():
                if name in self._records:
                    record = self._records[name]
                    await self._take(record, info)
                    if record.defaults is None and name not in self._learning:
                        self._learning.add(name)
                        self._start(self._learn_defaults(record), f"velocities of {name}")
                elif self._shows_all:  # the daemon was restarted with another axis
                    self.add(info, await _defaults(self._rig, info), moves=self._moves_all)

    async def _learn_defaults(self, record: MotorRecord) -> None:
        """Describe a record anew once its axis says how fast it moves: it may not have been up before."""
        while record.defaults is None:
            await asyncio.sleep(LEARN_S)
            info = record.info
            defaults = await _defaults(self._rig, info)
            if defaults and record.info is info:
                await record.describe(info, defaults)
        self._learning.discard(record.info.axis)

    async def _describe(self, record: MotorRecord) -> None:
        """Have a record say what its axis is by the daemon that is there now."""
        for info in await self._rig.describe():
            if info.axis == record.info.axis:
                await self._take(record, info)

    async def _take(self, record: MotorRecord, info: AxisInfo) -> None:
        kept = record.defaults if info.unit == record.info.unit else None
        await record.describe(info, await _defaults(self._rig, info) or kept)

    async def _follow(self, record: MotorRecord) -> None:
        axis = record.info.axis
        async with self._rig.samples(axis) as samples:
            for item in record.info.items:
                last = await self._rig.latest(axis, item)
                if last:
                    await record.take(last)
            async for sample in fresh_samples(samples):
                if sample is None:
                    await record.grow_old()
                else:
                    await record.take(sample)

    async def _follow_monitor(self, record: MotorRecord, monitor: str) -> None:
        async with self._rig.samples(record.info.axis, f"monitor/{monitor}") as samples:
            async for _, sample in samples:
                await record.take(sample, monitor)

    async def _stop_all(self, asked: Value) -> Put:
        """Do to each axis what a put to its STOP does: one that fails hinders no other."""
        moved = [record for record in self._records.values() if isinstance(record, MovedRecord)]
        if asked:
            stopped = await asyncio.gather(*(record.halt() for record in moved), return_exceptions=True)
            for error in filter(None, stopped):
                raise error
        return Put(0)

    def _start(self, work: Coroutine[object, object, None], name: str) -> asyncio.Task[None]:
        task = self._group.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def _start_motion(self, work: Coroutine[object, object, None], name: str) -> asyncio.Future[None]:
        """Start what may fail without ending the gateway: the client that has put it learns of it."""
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        ended.add_done_callback(lambda future: future.cancelled() or future.exception())  # perhaps without a waiter

        async def motion() -> None:
            try:
                await work
            except LdcndError as error:
                if not ended.done():
                    ended.set_exception(error)
            finally:
                if not ended.done():
                    ended.set_result(None)

        self._start(motion(), name)
        return ended


@asynccontextmanager
async def gateway(
    rig: Rig, *, prefix: str, axes: tuple[str, ...] = (), moves: tuple[str, ...] = ()
) -> AsyncIterator[Gateway]:
    """Show axes of a rig as motor records until the context ends.

    Args:
        rig: the rig.
        prefix: of every process variable.
        axes: which; all of them when none is named.
        moves: those that puts may move, under a lease of the gateway for each.

    Raises:
        UnknownAxis: the rig has no such axis.
    """
    known = {info.axis: info for info in await rig.describe()}
    check_axes(rig.name, (*axes, *moves), known)
    try:
        async with asyncio.TaskGroup() as group:
            made = Gateway(rig, group, prefix, shows_all=not axes, moves_all={*known} <= {*moves})
            for name in axes or known:
                made.add(known[name], await _defaults(rig, known[name]), moves=name in moves)
            made.begin()
            try:
                yield made
            finally:
                made.end()
    except BaseExceptionGroup as errors:
        if len(errors.exceptions) > 1:
            raise
        raise errors.exceptions[0] from None


async def serve(records: Gateway, address: ListenAddress, ready: asyncio.Event) -> None:
    """Answer Channel Access clients until cancelled; `ready` is set when they can connect.

    Beacons go to the loopback interface when that is where the gateway listens, and otherwise where EPICS_CAS_* says.
    """
    os.environ["EPICS_CA_SERVER_PORT"] = str(address.port)
    if address.host.startswith("127."):
        os.environ["EPICS_CAS_AUTO_BEACON_ADDR_LIST"] = "NO"
        os.environ["EPICS_CAS_BEACON_ADDR_LIST"] = address.host
    logging.getLogger("caproto").setLevel(logging.CRITICAL)  # it logs every refused put with a traceback
    context = Context(records.variables, [address.host])
    records.circuits = context.circuits

    async def begun(_: object) -> None:
        ready.set()

    await context.run(startup_hook=begun)


async def _defaults(rig: Rig, info: AxisInfo) -> Defaults | None:
    """Return the velocity and acceleration of a move that names none; None when the daemon does not say now."""
    if Verb.MOVE_ABSOLUTE not in info.capabilities:
        return MOTIONLESS
    try:
        async with rig.watch(info.axis) as axis:
            preview = await axis.preview(distance=0)
    except LdcndError:
        return None
    if preview.velocity is None or preview.acceleration is None:
        return None
    return preview.velocity, preview.acceleration
