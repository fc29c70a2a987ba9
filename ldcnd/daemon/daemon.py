"""The daemon as a whole: in which order things start and stop."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Coroutine, Iterator, Mapping
from typing import Any

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.axis.latches import LatchKeeper
from ldcnd.axis.status import AxisStatus
from ldcnd.config.plan import plan_rig
from ldcnd.config.rig import RigConfig
from ldcnd.contract.errors import SessionError
from ldcnd.contract.events import LATCH, CommandStatus
from ldcnd.contract.keys import Keys
from ldcnd.contract.meta import API, DaemonInfo
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.rig_commands import Reload
from ldcnd.contract.samples import LinkState, Moving
from ldcnd.daemon.capture import CaptureStore, CaptureWatch, Run, capture_of, snapshot_of
from ldcnd.daemon.dispatch import Dispatcher
from ldcnd.daemon.health import HealthWatch
from ldcnd.daemon.heartbeat import Heartbeat
from ldcnd.daemon.leases import apply_policy
from ldcnd.daemon.link_events import LinkEvents
from ldcnd.daemon.meta import Describing
from ldcnd.daemon.modules import Situation
from ldcnd.daemon.requests import EarlyStops, Requests
from ldcnd.daemon.rig import OwnedRig
from ldcnd.daemon.rig_commands import AnswerReload
from ldcnd.line.capture import Capture
from ldcnd.line.tasks import GuardedGroup
from ldcnd.log import LogLimit, get_logger
from ldcnd.net.hand_over import Load
from ldcnd.net.publisher import Publisher
from ldcnd.net.session import Declaration, Session
from ldcnd.version import version

log = get_logger("daemon")

TOKEN_PERIOD_S = 0.2
STOP_AGAIN_S = 0.02
"""Pause between two attempts at a stop that no drive has confirmed, at the end of the daemon, seconds."""
STOP_TIME_S = 2.0
"""Time for the axes to confirm their loss policies when the daemon is ended."""


class Daemon:
    """Serves one rig over one session until it is ended.

    Attributes:
        rig: what it serves.
        captures: writes captures when something goes wrong; None where there is no place for them.
        moving_at_end: whether each axis moved when the daemon was done with it; None before, and where it was not.
    """

    def __init__(
        self,
        config: RigConfig,
        session: Session,
        rig: OwnedRig,
        dispatcher: Dispatcher,
        publisher: Publisher,
        clock: Clock,
        instance: str,
        latches: LatchKeeper,
        *,
        stops: EarlyStops | None = None,
        heartbeat: Heartbeat | None = None,
        guests: tuple[Callable[[], Awaitable[None]], ...] = (),
    ) -> None:
        self.rig = rig
        self._guests = guests
        self._stops = stops
        self._latches = latches
        self._dispatcher = dispatcher
        self._config = config
        self._session = session
        self._keys = Keys(config.rig)
        self._publisher = publisher
        self._run = Run(instance, clock.now_ns(), clock)
        self._serving = asyncio.Event()
        self._ending = asyncio.Event()
        self.moving_at_end: Mapping[str, Moving] | None = None
        self._failure: BaseException | None = None  # the first; a panic inside Zenoh is no Exception
        self.captures = _capture_watch(self, self._run)
        self._declarations: list[Declaration] = []
        self._health = HealthWatch(rig, self._keys, publisher, clock, self._load)
        plan = plan_rig(config)
        self._health.stop_bounds_s = _stop_bounds_s(plan)
        self._health.overrides = self._dispatcher.interlocks.overrides
        self._tokens_logged = LogLimit(now_s=clock.now_s)
        self._heartbeat = heartbeat
        if heartbeat:
            self._health.heartbeat = lambda: heartbeat.health
        self._describing = Describing(
            rig, self._keys, publisher, self._info, lambda: self._config, plan, self._health, clock
        )

    @property
    def config(self) -> RigConfig:
        """With what it runs at present."""
        return self._config

    def end(self) -> None:
        """Request the daemon to stop its axes and to leave; `run` returns when that is done."""
        # at once: what has its turn before `run` wakes would begin, and what waits would behind the stop of its policy
        for axis in self.rig.axes.values():
            axis.close()
        for module in self.rig.modules.values():
            module.close()
        self._ending.set()

    def capture(self, bus: str, cause: str) -> Capture:
        """Return what the flight recorder of a line holds.

        Raises:
            ValueOutOfRange: there is no such line.
        """
        return capture_of(snapshot_of(self.rig.lines[bus], self._run), self._config, cause)

    def reconfigure(self, config: RigConfig, plan: RigBudget) -> None:
        """Take other limits, speeds, rates and priorities of axes; everything else is as before, see `plan_reload`.

        Args:
            config: the rig.
            plan: of its lines; to work it out takes longer than lines should be held up.
        """
        self._config = config
        self._describing.plan = plan
        self._health.stop_bounds_s = _stop_bounds_s(plan)
        axes = {axis.name: axis for bus in config.bus for axis in bus.axis}
        for bus in self.rig.buses:
            bus.reconfigure(axes)

    def note_reload(self, axis: str, what: str) -> None:
        """Enter into the events what a reload has changed of an axis."""
        self._dispatcher.events.note(axis, Reload.verb, CommandStatus.DONE, what)

    def serve_reloads(self, answer: AnswerReload) -> None:
        """Let clients have the configuration read again."""
        self._dispatcher.rig_commands.answer_reload = answer

    async def wait_serving(self) -> None:
        """Return as soon as questions and commands are answered, whether or not any line is up."""
        await self._serving.wait()

    async def wait_up(self) -> None:
        """Return as soon as every line is up."""
        for bus in self.rig.buses:
            await bus.wait_up()

    async def run(self) -> None:
        """Serve until `end` is called or the caller is cancelled.

        Start: stops first, so that no line is open that cannot be stopped; then lines, questions, and commands. Stop:
        commands are refused, what moves comes to rest, tokens go, lines close.
        """
        async with contextlib.AsyncExitStack() as declared, GuardedGroup(self.guarded) as group:
            declared.callback(self._dispatcher.events.flush)  # last of all
            leases = self._dispatcher.leases
            leases.group = group
            requests = Requests(self.rig, self._keys, group, self._dispatcher)
            for each in self.rig.axes.values():
                self._watch_link(each, group)
            # what is cancelled at the end; commands under way are not among it, they end when their lines close
            serving: list[asyncio.Task[None]] = []
            try:
                await self._declare_stops(declared, requests)
                serving += [
                    group.create_task(bus.run(self.guarded), name=f"line {bus.bus.settings.name}")
                    for bus in self.rig.buses
                ]
                for axis, latch, said in self._latches.recalled_stops():
                    self._dispatcher.events.note(
                        axis, LATCH, CommandStatus.DONE, said, client=latch.client, login=latch.login
                    )
                for each in self.rig.axes.values():
                    each.show()  # what is latched and what no drive has confirmed is known before any drive is read
                await self._declare(declared, requests)
                serving.append(group.create_task(self._watch_axes(), name="liveliness"))
                serving.append(group.create_task(self._latches.run(), name="latches"))
                serving.append(group.create_task(leases.run(), name="leases"))
                serving.append(group.create_task(self._dispatcher.interlocks.run(), name="interlocks"))
                serving += [
                    group.create_task(module.run(), name=f"module {name}") for name, module in self.rig.modules.items()
                ]
                serving.append(group.create_task(self._health.run(), name="health"))
                if self._heartbeat:
                    serving.append(group.create_task(self._heartbeat.run(), name="heartbeat"))
                if self.captures:
                    serving.append(group.create_task(self.captures.run(), name="captures"))
                serving += [group.create_task(_served(guest), name="guest") for guest in self._guests]
                self._serving.set()
                log.info("serving", rig=self.rig.name, axes=list(self.rig.axes), instance=self._run.instance)
                await self._ending.wait()
                requests.close()
                await self._come_to_rest()
                # behind the axes: an interlock may forbid a level while something moves
                await self._leave_outputs()
                # behind them, too: a reference is kept of an axis that stands
                await self._keep_references()
                # before the lines close: after that nothing is known
                self.moving_at_end = {name: axis.tracker.status.moving for name, axis in self.rig.axes.items()}
                await self._latches.settled()
                if self._failure:
                    raise self._failure
            finally:
                leases.group = None  # what ends from now on has nobody any more that would carry it out
                requests.finish()
                for task in serving:
                    task.cancel()
                for name in (*self.rig.axes, *self.rig.modules):
                    self._publisher.withdraw(name)
        log.info("ended", rig=self.rig.name)

    async def guarded(self, work: Coroutine[Any, Any, None]) -> None:
        """Do part of the daemon's work; if it fails, end in order, so that axes come to rest, and fail only then."""
        try:
            await work
        except (asyncio.CancelledError, GeneratorExit, KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # noqa: BLE001 - whatever is wrong in here, axes must not go on unwatched
            log.error("internal error, the daemon ends", reason=repr(error))
            self._failure = self._failure or error
            self.end()

    async def _declare_stops(self, declared: contextlib.AsyncExitStack, requests: Requests) -> None:
        stops = self._stops
        if stops is None:
            stops = EarlyStops()
            await stops.declare(self._session, self._keys)
        for declaration in stops.hand_over(requests.on_stop):
            self._declarations.append(declaration)
            # closed behind the lines: until then stops are taken, or refused once `finish` was called
            declared.push_async_callback(declaration.close)

    async def _declare(self, declared: contextlib.AsyncExitStack, requests: Requests) -> None:
        keys, session = self._keys, self._session
        describing = self._describing

        async def until_end(declaration: Declaration) -> None:
            self._declarations.append(declaration)
            declared.push_async_callback(declaration.close)

        await until_end(await session.serve_reads(keys.all_telemetry, describing.on_telemetry, complete=False))
        await until_end(await session.serve_reads(keys.all_meta, describing.on_meta, complete=True))
        await until_end(
            await session.serve(
                keys.all_commands, requests.on_command, complete=True, spared=requests.may_take_energy_out
            )
        )
        await until_end(await session.watch_tokens(keys.all_alive, self._on_daemon))
        await until_end(await session.declare_token(keys.alive(self._run.instance)))

    def _load(self) -> Load:
        """Return how the daemon keeps up with its load."""
        loads = [declaration.load for declaration in self._declarations]
        return Load(sum(load.waiting for load in loads), sum(load.lost for load in loads))

    def _on_daemon(self, key: str, alive: bool) -> None:  # noqa: FBT001 - the session's signature
        """Note which other daemons serve this rig: two of them would move every axis twice."""
        address = self._keys.parse_alive(key)
        # the watch shows this daemon's own token as well, and those of axes
        if address.axis is not None or address.instance == self._run.instance:
            return
        log.error("another daemon serves this rig", rig=self.rig.name, instance=address.instance, alive=alive)
        (self._dispatcher.rivals.add if alive else self._dispatcher.rivals.discard)(address.instance)

    async def _come_to_rest(self) -> None:
        """The daemon ends: do to each axis what its policy says; bounded."""
        try:
            async with asyncio.timeout(STOP_TIME_S), asyncio.TaskGroup() as group:
                for name, axis in self.rig.axes.items():
                    group.create_task(self.guarded(self._bring_to_rest(axis)), name=f"rest {name}")
        except TimeoutError:
            log.error("not everything came to rest", rig=self.rig.name, limit_s=STOP_TIME_S)
        for name, axis in self.rig.axes.items():
            if axis.tracker.status.stop_pending:
                log.error("stop not confirmed at the end of the daemon, the axis may move", axis=name)
            elif axis.tracker.status.stop_due:
                log.warning("ended before the drive was read: what it does is not known", axis=name)

    async def _bring_to_rest(self, axis: AxisService) -> None:
        await apply_policy(axis, axis.config.loss.daemon, "the daemon ends", daemon_ends=True)
        # as long as there is time for it, and until it is seen: after that nothing sends it again
        while axis.tracker.status.stop_due or axis.tracker.status.is_braking:
            await axis.send_pending_stop()
            await asyncio.sleep(STOP_AGAIN_S)
        # behind the stop, since it opens the loop of an axis that holds lent gains
        await axis.take_gains_back(at_end=True)

    async def _leave_outputs(self) -> None:
        """The daemon ends: give the outputs the levels that they are to have then; bounded."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STOP_TIME_S), asyncio.TaskGroup() as group:
                for name, module in self.rig.modules.items():
                    group.create_task(module.apply(Situation.DAEMON), name=f"outputs {name}")

    async def _keep_references(self) -> None:
        """Keep where each axis is while its line is still up; bounded."""
        async with asyncio.TaskGroup() as group:
            for name, axis in self.rig.axes.items():
                group.create_task(axis.reference.finish(), name=f"keep {name}")

    def _watch_link(self, axis: AxisService, group: asyncio.TaskGroup) -> None:
        """Act and tell when a drive answers again that was out of reach; its fault tells that it was."""
        name = axis.config.name
        link_events = LinkEvents(self._dispatcher.events.noting(name), "the drive", None)

        def changed(_before: AxisStatus, after: AxisStatus) -> None:
            if after.link is LinkState.DOWN:
                link_events.lost()

        async def rest() -> None:
            """If it still moves, do what its policy says."""
            cause = "the drive was out of reach"
            if said := await apply_policy(axis, axis.config.loss.bus, cause):
                link_events.add(f"{said}, its policy of loss.bus")

        def returned() -> None:
            link_events.back()
            group.create_task(rest(), name=f"bus loss {name}")

        axis.tracker.watch(changed, "link")
        axis.readings.returned = returned

    async def _watch_axes(self) -> None:
        """Keep one liveliness token for each axis whose drive answers."""
        tokens: dict[str, Declaration] = {}
        try:
            while True:
                for name, axis in self.rig.axes.items():
                    alive = axis.tracker.status.link is not LinkState.DOWN
                    if alive and name not in tokens:
                        with self._unless_congested(name):
                            tokens[name] = await self._session.declare_token(
                                self._keys.alive_axis(self._run.instance, name)
                            )
                    elif not alive and name in tokens:
                        await tokens.pop(name).close()
                await asyncio.sleep(TOKEN_PERIOD_S)
        finally:
            for token in tokens.values():
                await token.close()

    @contextlib.contextmanager
    def _unless_congested(self, axis: str) -> Iterator[None]:
        """Go on without a token that the network does not take, and try again: nothing moves by it, or stops for it."""
        try:
            yield
        except SessionError as error:
            if (fields := self._tokens_logged.admit()) is not None:
                log.warning("axis not shown as alive", axis=axis, reason=error.message, **fields)

    def _info(self) -> DaemonInfo:
        return DaemonInfo(
            rig=self.rig.name,
            version=version(),
            api=API,
            instance=self._run.instance,
            started=self._run.started_ns,
            encoding=self._config.telemetry.encoding,
            axes=tuple(self.rig.axes),
            buses=tuple(bus.bus.settings.name for bus in self.rig.buses),
        )


async def _served(guest: Callable[[], Awaitable[None]]) -> None:
    await guest()


def _capture_watch(daemon: Daemon, run: Run) -> CaptureWatch | None:
    directory, bounds = daemon.config.captures_dir, daemon.config.captures
    if directory is None:
        return None
    store = CaptureStore(directory, bounds.files, bounds.total_mb * 1_000_000)
    return CaptureWatch(daemon.rig, lambda: daemon.config, run, store)


def _stop_bounds_s(plan: RigBudget) -> dict[str, float]:
    return {bus.bus: bus.stop_wait_s for bus in plan.buses if bus.stops}
