"""One line at work: brings its drives up whenever it opens, has them polled, tells the axes when it is gone."""

import asyncio
import contextlib
from collections.abc import Mapping
from typing import Any

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.axis.events import PowerSwitched
from ldcnd.axis.polling import AxisPoller
from ldcnd.config.ports import GuestView
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import BusDown, BusError, LdcndError, NetworkMismatch, Remedy, WrongState, step
from ldcnd.contract.rig_commands import SnapshotReply
from ldcnd.contract.samples import TelemetryItem
from ldcnd.daemon.link_events import LinkEvents, Note
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import PollsItself, Readable, ReadingListeners, StopMode
from ldcnd.drives.network import BringUpReport, Network
from ldcnd.line.bus import Bus, only_during
from ldcnd.line.exchange import Poller, Priority
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.line.tasks import Guarded, GuardedGroup, each
from ldcnd.log import get_logger

log = get_logger("bus")

FIRST_RETRY_S = 0.5
LONGEST_RETRY_S = 10.0
FIRST_SCAN_PAUSE_S = 0.25
LONGEST_SCAN_PAUSE_S = 2.0
"""Longest pause between two scans for lost drives: a drive that powers up must be back within 3 s."""
CAPTURING = frozenset({Verb.HOME, Verb.PROBE})
"""Commands that wait for a capture in the drive's home register."""
SCAN_SHARE = 0.01
"""Share of the line's time for these scans; more where the longest pause requires it."""
STOP_SHARE = 0.1
"""Share of the line's time for the stops that a drive did not hear; more where the longest pause requires it."""
FIRST_STOP_PAUSE_S = 0.02
LEAST_STOP_PAUSE = 2
"""Pause between two rounds of such stops, in multiples of a round, where that is longer than the longest pause."""


class BusService:
    """One bus, its network and its axes.

    Attributes:
        port: where it is connected, as configured.
        family: the drive family on it.
        report: how the line came up; None while it is not up.
        problem: why it is not up; empty while it is.
        guests: of its ports that are served, by their names.
        unserved: why the others are not.
    """

    def __init__(
        self,
        bus: Bus,
        network: Network,
        axes: tuple[AxisService, ...],
        *,
        port: str,
        family: str,
        note: Note = lambda *_: None,
        stop_probe_hz: float = 0.0,
    ) -> None:
        self.bus = bus
        self.port = port
        self.family = family
        self.network = network
        self.axes = axes
        self.report: BringUpReport | None = None
        self.problem = "not opened yet"
        self._link_events = LinkEvents(note, "the line", "bus_down")
        self.guests: dict[str, GuestView] = {}
        self.unserved: dict[str, str] = {}
        self._pollers: dict[str, Poller[Any]] = {}
        self._stop_probe_hz = stop_probe_hz
        self._was_up = False
        self._up = asyncio.Event()
        self._down = asyncio.Event()
        self._down.set()
        self._stop_wanted = asyncio.Event()
        for axis in axes:
            axis.stops.wanted = self._stop_wanted

    async def run(self, guarded: Guarded) -> None:
        """Serve the line until cancelled.

        Args:
            guarded: does the work of each of its tasks. One that fails does not close the line, by which axes are to
                come to rest.
        """
        name = self.bus.settings.name
        async with GuardedGroup(guarded) as group:
            group.create_task(self.bus.run(), name=f"bus {name}")
            group.create_task(self.bus.wait_failed(), name=f"failures of {name}")
            group.create_task(self._supervise(), name=f"bring up {name}")
            if self._stop_probe_hz:
                group.create_task(self._probe_stop_lane(1.0 / self._stop_probe_hz), name=f"stop probes {name}")
            for axis in self.axes:
                group.create_task(axis.run(), name=f"axis {axis.config.name}")
                group.create_task(axis.reference.run(), name=f"reference {axis.config.name}")
                group.create_task(axis.traces.run(), name=f"traces {axis.config.name}")

    async def wait_up(self) -> None:
        """Return as soon as the drives are polled."""
        await self._up.wait()

    async def wait_down(self) -> None:
        """Return as soon as the axes are informed of the line's loss."""
        await self._down.wait()

    async def stop_together(self, mode: StopMode, names: frozenset[str]) -> None:
        """Stop axes with closed loops by one packet if they form groups; each must be stopped by itself besides."""
        # which groups there are is known once the line is up; each axis is stopped by itself anyway
        if self.report is None:
            return
        try:
            await self.network.stop_together(mode, names)
        except BusError as error:
            log.warning("group stop not sent", bus=self.bus.settings.name, reason=error.message)

    async def snapshot(self, clock: Clock) -> SnapshotReply:
        """Return the positions of all axes at one instant; moves nothing.

        Raises:
            NotSupported, WrongState, BusError: as `Network.snapshot`; BusDown while the line is not up.
        """
        name = self.bus.settings.name
        self.check_up()
        instant = await self.network.snapshot(self._check_registers)
        t, t_error_ns = clock.stamp_between(instant.from_s, instant.until_s)
        positions = tuple(axis.readings.frozen_at(instant.counts[axis.config.name]) for axis in self.axes)
        return SnapshotReply(bus=name, t=t, t_error_ns=t_error_ns, positions=positions, io=instant.io)

    def check_up(self) -> None:
        """Refuse what needs the line while it is not up.

        Raises:
            BusDown: it is not.
        """
        name = self.bus.settings.name
        if self.report is None:
            look = Remedy("{}", step("list_lines", "see `ldcnd bus list`"))
            raise BusDown(f"bus {name} is not up: {self.problem}", value=name, remedy=look)

    def _check_registers(self) -> None:
        """Refuse to overwrite a register in which a command waits for a capture.

        Raises:
            WrongState: an axis is homing or probing.
        """
        for axis in self.axes:
            command = axis.tracker.status.command
            if command and command.verb in CAPTURING:
                name = axis.config.name
                raise WrongState(
                    f"axis {name} carries out {command.verb}: its home register is in use",
                    axis=name,
                    value=command.verb.value,
                    remedy="wait until it has ended",
                )

    def reconfigure(self, configs: Mapping[str, AxisConfig]) -> None:
        """Take other limits, speeds, rates and priorities of axes, by name."""
        for axis in self.axes:
            config, before = configs[axis.config.name], axis.config
            axis.reconfigure(config)
            polled_anew = (config.rates, config.priority) != (before.rates, before.priority)
            if polled_anew and axis.stops.line_up:
                self._poll(axis, asyncio.get_running_loop().time())

    def asked_hz(self, axis: str) -> Mapping[TelemetryItem, float]:
        """Return the current rates at which the items of an axis are polled."""
        poller = self._pollers.get(axis)
        return poller.rates_hz if poller else {}

    async def _supervise(self) -> None:
        retry_s = FIRST_RETRY_S
        while True:
            opening = await self.bus.wait_opened()
            await self._send_stops_first()
            try:
                with only_during(self.bus, opening):
                    report = await self.network.bring_up()
            except LdcndError as error:  # also a stop that took one of its packets off the queue
                self._not_up(error)
                await self._pause(retry_s)
                retry_s = min(2 * retry_s, LONGEST_RETRY_S)
                continue
            retry_s, self.problem = FIRST_RETRY_S, "what is kept of its axes is being read"
            for name in report.restarted:
                self._restarted(name)
            for axis in self.axes:
                axis.brought_up(reset=report.reset, is_open=axis.config.name in report.open_loops)
            # what was found open just now, and what has come during the bring-up
            await self._send_pending_stops()
            await self._serve(report, opening)
            # from here to the last axis nothing is awaited, so nobody sees the one without the other
            self.report, self.problem = None, "the line was lost"
            self._link_events.lost(f"the line was lost: {self.bus.loss_reason}".rstrip(": "))
            self._up.clear()
            self._down.set()
            for axis in self.axes:
                axis.stops.line_up = False
                axis.disconnected()
            for module in self.network.io.values():
                module.gone()

    async def _send_stops_first(self) -> None:
        """Send what no drive has confirmed at the rate at which it may be heard: at another one drives are deaf."""
        if any(axis.tracker.status.stop_due for axis in self.axes):
            with contextlib.suppress(LdcndError):
                await self.network.let_stops_be_heard()
        await self._send_pending_stops()

    def _not_up(self, error: LdcndError) -> None:
        """Keep why the line is not up; its axes show whether nothing answers, or something that is not theirs."""
        problem = f"{error.message}; {error.remedy}" if error.remedy else error.message
        if problem != self.problem:
            log.error("line not up", bus=self.bus.settings.name, reason=error.message, remedy=error.remedy)
        self.problem = problem
        # something that answers and does not match is not silent: its axes say `not_identified`
        self.bus.proofs.lose_all(error.message, silent=not isinstance(error, NetworkMismatch))
        for axis in self.axes:
            axis.disconnected()

    async def _send_pending_stops(self) -> None:
        """Send what no drive has confirmed, to all axes that wait for it at once."""
        # before the look: a stop that comes while these are sent is not lost
        self._stop_wanted.clear()
        waiting = [axis for axis in self.axes if axis.tracker.status.stop_due or axis.tracker.status.off_again]
        if not waiting:
            return
        await each({f"pending stop {axis.config.name}": axis.send_pending_stop() for axis in waiting})

    async def _pause(self, pause_s: float) -> None:
        """Wait before the next attempt to bring the line up; a stop that comes meanwhile is tried at once."""
        loop = asyncio.get_running_loop()
        until_s = loop.time() + pause_s
        while loop.time() < until_s:
            try:
                async with asyncio.timeout_at(until_s):
                    await self._stop_wanted.wait()
            except TimeoutError:
                return
            await self._send_pending_stops()

    async def _serve(self, report: BringUpReport, opening: int) -> None:
        """Serve a line that takes stops until it is lost, each axis as soon as its place is known."""
        async with asyncio.TaskGroup() as tasks:
            stops = tasks.create_task(self._repeat_stops(), name=f"stops on {self.bus.settings.name}")
            for watch in self.network.watches:  # before axes that move: their interlocks ask what modules read
                self.bus.add_poller(watch)
            for axis in self.axes:
                # once in the life of a daemon: afterwards it knows itself what it knows
                if not self._was_up:
                    await axis.recall(report)  # the disk may be slow, and shafts may move that an earlier host has left
                self._connect(axis, report)
            self._note_up(report)
            await self._scan_for_lost_drives(opening)
            stops.cancel()

    async def _scan_for_lost_drives(self, opening: int) -> None:
        """Scan for drives that lost power and came back; return when the line is lost."""
        pause_s = FIRST_SCAN_PAUSE_S
        while not await self._closed_within(pause_s, opening):
            # before the search: who is heard during it is searched for once more
            self.bus.proofs.heard_again.clear()
            with only_during(self.bus, opening):
                pause_s = await self._search() if self.network.incomplete() else FIRST_SCAN_PAUSE_S

    async def _repeat_stops(self) -> None:
        """Send stops that no drive has confirmed, until one has: at once when it is heard, and now and then."""
        loop = asyncio.get_running_loop()
        pause_s: float | None = FIRST_SCAN_PAUSE_S
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause_s):
                    await self._stop_wanted.wait()
            began_s = loop.time()
            await self._send_pending_stops()
            # nothing is to be repeated: only who needs a stop ends the wait
            pause_s = None
            if any(axis.tracker.status.stop_due for axis in self.axes):
                # polls of a mute drive come ever more seldom: one that hears again gets its stop before them
                took_s = loop.time() - began_s
                # where each lost answer takes long, the search, which brings it back, still gets the most of the line
                longest_s = max(LONGEST_SCAN_PAUSE_S, LEAST_STOP_PAUSE * took_s)
                pause_s = min(took_s / STOP_SHARE + FIRST_STOP_PAUSE_S, longest_s)

    async def _search(self) -> float:
        """Search once for lost drives; return how long to wait until the next search, in seconds.

        The stop that waits goes out meanwhile, first to each drive that answers again.
        """
        loop = asyncio.get_running_loop()
        began_s = loop.time()

        def heard(name: str) -> None:
            # a new poller is due at once; that of a mute drive is put off ever longer
            self._poll(self._axis(name), loop.time())
            self._stop_wanted.set()

        found: frozenset[str] = frozenset()
        try:
            found = await self.network.rejoin(self._restarted, heard)
        except LdcndError as error:
            log.warning("search for lost drives failed", bus=self.bus.settings.name, reason=error.message)
        self.problem = self.network.problem
        for axis in self.axes:
            axis.readings.explain_loss()
        if found:
            return FIRST_SCAN_PAUSE_S
        return min((loop.time() - began_s + self.bus.quarantine_s) / SCAN_SHARE, LONGEST_SCAN_PAUSE_S)

    def _axis(self, name: str) -> AxisService:
        return next(axis for axis in self.axes if axis.config.name == name)

    async def _probe_stop_lane(self, period_s: float) -> None:
        """Keep measuring how long a stop would wait."""
        while True:
            await asyncio.sleep(period_s)
            await self.wait_up()
            try:
                await self.bus.probe_stop_wait()
            except LdcndError as error:  # a lost reply is counted and reported by the drive's owner
                log.debug("stop probe lost", bus=self.bus.settings.name, reason=error.message)

    async def _closed_within(self, pause_s: float, opening: int) -> bool:
        """Tell whether the line is lost within a time, or before a node is heard again."""
        closed = asyncio.ensure_future(self.bus.wait_closed(opening))
        heard = asyncio.ensure_future(self.bus.proofs.heard_again.wait())
        try:
            await asyncio.wait((closed, heard), timeout=pause_s, return_when=asyncio.FIRST_COMPLETED)
            return closed.done()
        finally:
            closed.cancel()
            heard.cancel()

    def _restarted(self, name: str) -> None:
        """A drive has lost power and is about to answer again: its loop is open, nothing that was commanded goes on.

        Its module was initialised again, its axis was not reset: an axis in error_stop stays there.
        """
        log.warning("drive lost power", axis=name, bus=self.bus.settings.name)
        axis = self._axis(name)
        axis.readings.report_restart()
        axis.disconnected()
        axis.stops.note_power_loss()
        axis.tracker.take(PowerSwitched(on=False, now_s=asyncio.get_running_loop().time()))

    def _connect(self, axis: AxisService, report: BringUpReport) -> None:
        """Have an axis polled. Only the very first reset can be a reference, and only where its place is proven."""
        trusted = axis.config.reference == "at_reset" and axis.config.name in report.placed and not self._was_up
        axis.connected(placed=trusted)
        if not axis.readings.are_of_the_drive:
            axis.disconnected()  # the others of its line are served without it
        self._poll(axis, asyncio.get_running_loop().time())

    def _note_up(self, report: BringUpReport) -> None:
        """All axes are polled: the line is up."""
        log.info(
            "line up",
            bus=self.bus.settings.name,
            baud=report.baud,
            drives=dict(report.identities),
            remarks=report.remarks,
        )
        self.report, self.problem = report, ""
        self._was_up = True
        self._link_events.back()
        self._down.clear()
        self._up.set()

    def _poll(self, axis: AxisService, now_s: float) -> None:
        """Poll the axis from now on; an existing poller is replaced."""
        if previous := self._pollers.get(axis.config.name):
            self.bus.remove_poller(previous)
        poller: Poller[Any]
        drive, taken = axis.driver, axis.readings
        if isinstance(drive, PollsItself):
            poller = drive.own_poller(
                now_s, ReadingListeners(taken.accept, taken.take_monitor, taken.miss, taken.take_alarm)
            )
        elif isinstance(drive, Readable):
            rates_hz = axis.config.rates.wanted_hz(adc=bool(drive.adc_full_scale))
            poller = AxisPoller(drive, rates_hz, now_s, taken.judge, taken.miss, self.bus.move_poller)
            taken.ask_at = poller.ask_at
        else:
            raise TypeError(f"axis {axis.config.name}: its drive can be read in no way")
        poller.priority = Priority[axis.config.priority.upper()]
        self._pollers[axis.config.name] = poller
        self.bus.wire_log.add(now_s, WireEvent.POLLED, note=axis.config.name)
        self.bus.add_poller(poller)
