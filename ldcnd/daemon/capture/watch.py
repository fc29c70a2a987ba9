"""Triggers captures: a fault of a drive, a line that went down, a line that acts too late.

It checks a few times a second and never delays a packet. The capture is made a moment after its cause,
so that it shows what came of it, and never sooner than `PAUSE_S` after the one before: a loose contact fills no disk.
"""

import asyncio
from collections.abc import Callable, Iterator

from ldcnd.config.rig import RigConfig
from ldcnd.daemon.capture.captures import CaptureStore, Run, Snapshot, capture_of, snapshot_of
from ldcnd.daemon.line.line import BusService
from ldcnd.daemon.line.rig import Rig

CHECK_PERIOD_S = 0.2
AFTERMATH_S = 0.5
PAUSE_S = 10.0


class CaptureWatch:
    """Keeps the captures of one run of the daemon.

    Args:
        rig: its lines.
        config: returns what it runs with at present.
        run: which run this is.
        store: where captures go.
    """

    def __init__(self, rig: Rig, config: Callable[[], RigConfig], run: Run, store: CaptureStore) -> None:
        self._rig = rig
        self._config = config
        self._run = run
        self._store = store
        self._known: dict[str, frozenset[str]] = {}
        self._last_s: dict[str, float] = {}

    async def run(self) -> None:
        """Watch until cancelled."""
        clock = self._run.clock
        while True:
            await asyncio.sleep(CHECK_PERIOD_S)
            for line in self._rig.buses:
                name = line.bus.settings.name
                if clock.now_s() < self._last_s.get(name, -PAUSE_S) + PAUSE_S:
                    continue
                causes = frozenset(_causes(line, clock.now_s()))
                news = causes - self._known.get(name, frozenset())
                self._known[name] = causes
                if news:
                    await asyncio.sleep(AFTERMATH_S)
                    self._last_s[name] = clock.now_s()
                    snapshot = snapshot_of(line, clock)
                    await asyncio.to_thread(self._write, snapshot, "; ".join(sorted(news)))

    def write_all(self, cause: str) -> None:
        """Write a capture of every line here and now; for a process that is about to die."""
        for line in self._rig.buses:
            self._write(snapshot_of(line, self._run.clock), cause)

    def _write(self, snapshot: Snapshot, cause: str) -> None:
        self._store.write(capture_of(snapshot, self._config(), self._run, cause))


def _causes(line: BusService, now_s: float) -> Iterator[str]:
    """Yield what is wrong with a line now, or was since its axes were reset last."""
    for axis in line.axes:
        tracker = axis.tracker
        if (first := tracker.first_fault) is not None:
            yield f"{axis.config.name} {first.code}"
        for fault in tracker.active_faults:
            yield f"{axis.config.name} {fault.code}"
    if line.bus.statistics.losses:
        yield f"line down {line.bus.statistics.losses}"
    if not line.bus.on_time(now_s):
        yield "line acts too late"
