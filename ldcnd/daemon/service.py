"""The daemon as a service: reports readiness and state, feeds the watchdog, reloads on request, ends in order.

The watchdog is fed only while every bus keeps to its own plan. So it ends a daemon whose loop hangs and one whose loop
runs while a line does not; a line without adapter or without drives is no reason, and appears in the status instead.

What a reload takes is in reload.py; a signal asks for it here, a client by the command `reload`.
"""

import asyncio
import gc
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from ldcnd import systemd
from ldcnd.axis.status import AxisStatus
from ldcnd.certificate import watch_certificate
from ldcnd.config.rig import RigConfig
from ldcnd.contract.condition import Condition, assess, assess_module
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.rig_commands import Reload, ReloadReply
from ldcnd.contract.samples import FaultEntry, LinkState, Moving
from ldcnd.contract.troubles import OWN, TroubleKind, certificate_troubles, disk_troubles, line_troubles
from ldcnd.daemon.daemon import Daemon
from ldcnd.daemon.reload import Reloader
from ldcnd.daemon.rig import OwnedRig
from ldcnd.line.tasks import GuardedGroup
from ldcnd.log import get_logger
from ldcnd.parts import missing
from ldcnd.systemd import Notifier

log = get_logger("service")

CPU_LATENCY = Path("/dev/cpu_dma_latency")
"""Linux: while it is held open with a number of microseconds in it, the processor wakes up within that time."""

LoopFactory = Callable[[], asyncio.AbstractEventLoop]


def loop_factory(*, uvloop: bool) -> LoopFactory:
    """Return what makes the event loop: uvloop's where it is wanted and installed, asyncio's otherwise."""
    if uvloop:
        try:
            import uvloop as fast  # noqa: PLC0415 - an optional package
        except ImportError:
            log.warning("no uvloop", remedy=f"{missing('uvloop').remedy}, or set uvloop = false")
        else:
            return _finely_timed(fast.Loop)
    return asyncio.new_event_loop


def require_writable(rig: RigConfig) -> None:
    """Check that the daemon can keep what must outlive it, before anything is opened.

    Raises:
        ConfigError: it may not write where the configuration says; names where a service manager lets it.
    """
    for key, directory in (("state_dir", rig.state_dir), ("captures.directory", rig.captures.directory)):
        if directory is None:
            continue
        # the nearest folder that is there: those below it the daemon makes itself
        there = next(place for place in (directory.absolute(), *directory.absolute().parents) if place.exists())
        if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
            allowed = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
            raise ConfigError(
                f"{key}: {directory} cannot be written by this user or service",
                value=str(directory),
                remedy=f'{key} = "{allowed}", where the service may write' if allowed else "choose a writable place",
            )


@contextmanager
def state_held(rig: RigConfig) -> Iterator[None]:
    """Keep other daemons out of the state directory for as long as the context lasts, however that ends.

    Each of two would replace what the other one keeps, its latches too. A daemon of one line of a rig shares the
    directory of the whole rig with those of its other lines, and keeps a daemon of all of them out.

    Raises:
        ConfigError: another daemon uses it.
    """
    if rig.state_dir is None:
        yield
        return
    rig.state_dir.mkdir(parents=True, exist_ok=True)
    whole = [rig.state_dir.parent] if [bus.name for bus in rig.bus] == [rig.state_dir.name] else []
    with ExitStack() as held:
        for directory in (*whole, rig.state_dir):
            descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
            held.callback(os.close, descriptor)
            _lock(descriptor, directory, shared=directory in whole)
        yield


def _lock(held: int, directory: Path, *, shared: bool) -> None:
    import fcntl  # noqa: PLC0415 - of POSIX; the rest of the module is imported everywhere

    try:
        fcntl.flock(held, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ConfigError(
            f"state_dir: another daemon uses {directory}, and each would replace what the other one keeps",
            value=str(directory),
            remedy="stop the other one, or give each a directory of its own",
        ) from None
    except OSError as error:  # a file system without locks
        log.warning("state_dir is not locked", directory=str(directory), reason=error.strerror)


@contextmanager
def held_awake(*, wanted: bool, device: Path = CPU_LATENCY) -> Iterator[None]:
    """Keep the processor out of idle states that take long to leave, for as long as the context lasts.

    Where that is refused the daemon runs all the same, a little slower, and says so.
    """
    descriptor = _hold(device) if wanted else None
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


@contextmanager
def last_words(speak: Callable[[], object]) -> Iterator[None]:
    """Have something done when the process is aborted, as a service manager does whose watchdog was not fed.

    It is done wherever the interpreter is just then, also in an event loop that hangs; then the process dies as it
    would have without.
    """

    def aborted(number: int, _frame: FrameType | None) -> None:
        # first: another abort, while this one speaks, ends the process at once
        signal.signal(number, signal.SIG_DFL)
        try:
            speak()
        finally:
            os.kill(os.getpid(), number)

    before = signal.signal(signal.SIGABRT, aborted)
    try:
        yield
    finally:
        signal.signal(signal.SIGABRT, before)


def settle_heap() -> None:
    """Exempt objects left by start-up from garbage collection: they stay as long as the process.

    A full collection of it would hold up several polls.
    """
    gc.collect()
    gc.freeze()


def _finely_timed(loop: type[asyncio.AbstractEventLoop]) -> LoopFactory:
    """Give a loop the clock of asyncio's own.

    uvloop tells the time in whole milliseconds, of when its present turn began. That is longer than many a packet: a
    reply would seem to come before its request was over. The zero of both clocks is the same.
    """

    class FinelyTimed(loop):  # type: ignore[valid-type, misc] # a class that is known at run time only
        time = staticmethod(time.monotonic)  # read several times for each exchange: no Python frame round it

    return FinelyTimed


def _hold(device: Path) -> int | None:
    try:
        descriptor = os.open(device, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        log.warning(
            "processor not held awake",
            device=str(device),
            reason=error.strerror,
            remedy="give the daemon write access, or set hold_cpu_awake = false",
        )
        return None
    # 0 microseconds, as a 32-bit number
    os.write(descriptor, bytes(4))
    log.info("processor held awake", device=str(device))
    return descriptor


STATUS_PERIOD_S = 1.0
FEEDINGS = 3
"""Number of watchdog notifications within its time-out."""
TRIES, TRY_PERIOD_S = 50, 0.1


class Service:
    """Runs a daemon and keeps its service manager informed.

    Args:
        daemon: what to run.
        notifier: where to say it.
        load: reads the configuration again, as it was read at the start.
        monotonic_ns: CLOCK_MONOTONIC, which the service manager compares with its own.
    """

    def __init__(
        self,
        daemon: Daemon,
        notifier: Notifier,
        load: Callable[[], RigConfig],
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._daemon = daemon
        self._notifier = notifier
        self._reloader = Reloader(daemon, load)
        daemon.serve_reloads(self._answer_reload)
        self._monotonic_ns = monotonic_ns
        self._asked = asyncio.Event()
        self._ending = False
        self._stuck: tuple[str, ...] = ()
        self._remark = ""

    def reload(self) -> None:
        """Request a reload of the configuration; requests that come meanwhile are merged."""
        self._asked.set()

    def end(self) -> None:
        """Say that the daemon ends, and end it; `run` returns when its axes have come to rest."""
        self._ending = True
        self._notifier.tell(systemd.STOPPING, systemd.status(self._status()))
        self._daemon.end()

    async def run(self) -> None:
        """Serve until `end` is called or the caller is cancelled."""
        self._notifier.tell(systemd.status("starting"))  # else that of the run before is shown
        async with GuardedGroup(self._daemon.guarded) as group:
            certificate = watch_certificate(self._daemon.rig.certificate, _tell_of_certificate)
            beside = [
                group.create_task(self._reload_when_asked(), name="reload"),
                group.create_task(certificate, name="end of the certificate"),
            ]
            if self._notifier.is_heard:
                beside.append(group.create_task(self._report(), name="service manager"))
            try:
                await self._daemon.run()
            finally:
                for task in beside:
                    task.cancel()
                self._notifier.tell(systemd.status(_end_in_words(self._daemon.moving_at_end)))

    async def _report(self) -> None:
        await self._daemon.wait_serving()
        watchdog_s = self._notifier.watchdog_s
        period_s = min(STATUS_PERIOD_S, watchdog_s / FEEDINGS) if watchdog_s else STATUS_PERIOD_S
        told = self._status()
        await self._assure(systemd.READY, systemd.status(told))
        while True:
            messages = [systemd.WATCHDOG] if self._lines_on_time() else []
            if (now := self._status()) != told:
                messages.append(systemd.status(now))
                told = now
            self._notifier.tell(*messages)
            await asyncio.sleep(period_s)

    async def _assure(self, *messages: str) -> None:
        """Send a one-time message, repeatedly for a while if the service manager is too busy to take it."""
        for _ in range(TRIES):
            if self._notifier.tell(*messages):
                return
            await asyncio.sleep(TRY_PERIOD_S)

    def _lines_on_time(self) -> bool:
        now_s = asyncio.get_running_loop().time()
        stuck = tuple(bus.bus.settings.name for bus in self._daemon.rig.buses if not bus.bus.on_time(now_s))
        if stuck and stuck != self._stuck:
            log.error("a line has missed its deadline", buses=stuck, watchdog_s=self._notifier.watchdog_s)
        self._stuck = stuck
        return not stuck

    def _status(self) -> str:
        if self._ending:
            return "stopping: axes come to rest"
        rig = self._daemon.rig
        ends = certificate_troubles(rig.certificate, time.time_ns())
        stuck = [f"bus {name} has missed its deadline" for name in self._stuck]
        return "; ".join(filter(None, [describe(rig), *ends, *stuck, self._remark]))

    # -- reloading ---------------------------------------------------------------------------------------------------

    async def _reload_when_asked(self) -> None:
        await self._daemon.wait_serving()
        while True:
            await self._asked.wait()
            # before the file is read: who asks meanwhile means what it says by then
            self._asked.clear()
            await self._assure(systemd.reloading(self._monotonic_ns()))
            self._remark = await self._reload()
            await self._assure(systemd.READY, systemd.status(self._status()))

    async def _reload(self) -> str:
        """Take what can be taken; return what the status must say about the rest."""
        try:
            reload = await self._reloader.reload()
        except ConfigError as error:
            log.error("configuration not reloaded", reason=error.message, code=error.code.value)
            return f"configuration not reloaded: {error.message.splitlines()[0]}"
        return _remark(reload.refused)

    async def _answer_reload(self, command: Reload, held: Callable[[], Mapping[str, str]]) -> ReloadReply:
        reply = await self._reloader.answer(command, held)
        if not command.dry_run:
            self._remark = _remark([each.key for each in reply.changes if each.restart])
        return reply


def _remark(refused: Sequence[str]) -> str:
    return f"restart needed for {', '.join(refused)}" if refused else ""


def _end_in_words(moving: Mapping[str, Moving] | None) -> str:
    """Return in one line how a daemon has left its axes.

    Args:
        moving: of each, as its drive has said last; None where none was asked any more.
    """
    if moving is None:
        return "ended; it is not known whether axes move"
    named = {
        state: ", ".join(name for name, now in moving.items() if now is state) for state in (Moving.YES, Moving.UNKNOWN)
    }
    parts = [f"still moving: {named[Moving.YES]}"] if named[Moving.YES] else []
    parts += [f"not known whether it moves: {named[Moving.UNKNOWN]}"] if named[Moving.UNKNOWN] else []
    return "; ".join(("stopped", *(parts or ["all axes at rest"])))


def _tell_of_certificate(trouble: str | None) -> None:
    (log.warning if trouble else log.info)("certificate", problem=trouble)


def describe(rig: OwnedRig) -> str:
    """Return in one line what of a rig works and what does not; what is true of several is said once.

    Polls that a drive missed are left out: a status is for what lasts.
    """
    wrong: dict[str, list[str]] = {}
    for bus in rig.buses:
        name, up = bus.bus.settings.name, bus.report is not None
        why = bus.problem if bus.bus.is_open else bus.bus.loss_reason or bus.problem
        for trouble in line_troubles(up=up, problem=why):
            wrong.setdefault(trouble.text, []).append(name)
        found = {axis.config.name: _condition(axis.tracker.status) for axis in bus.axes}
        found |= {name: assess_module(rig.modules[name].health) for name in bus.network.io}
        for about, condition in found.items():
            lasts = [each for each in condition.wrong if each.kind is not TroubleKind.MISSED_POLLS]
            for trouble in [each for each in lasts if up or each.kind in OWN][:1]:
                wrong.setdefault(trouble.text, []).append(about)
    buses_up = sum(bus.report is not None for bus in rig.buses)
    axes_up = sum(axis.tracker.status.link is not LinkState.DOWN for axis in rig.axes.values())
    parts = [f"rig {rig.name}: {buses_up}/{len(rig.buses)} buses, {axes_up}/{len(rig.axes)} axes up"]
    parts += disk_troubles(rig.not_kept_in_words)
    return "; ".join(parts + [f"{', '.join(names)}: {text}" for text, names in wrong.items()])


def _condition(status: AxisStatus) -> Condition:
    return assess(status, _Faults(status.active_faults, status.first_fault))


class _Faults(NamedTuple):
    active: tuple[FaultEntry, ...]
    first: FaultEntry | None
