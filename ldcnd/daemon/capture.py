"""Captures that the daemon makes of its lines: what triggers them, what is in them, and where they are kept.

A fault of a drive triggers one, a line that went down, a line that acts too late. The watch checks a few times a second
and never delays a packet. The capture is made a moment after its cause, so that it shows what came of it, and never
sooner than `PAUSE_S` after the one before: a loose contact fills no disk. Writing one never runs on the event loop. The
text is written in small pieces: between two of them another thread may have the interpreter, so a bus waits for less
than a millisecond.
"""

import asyncio
import contextlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from pydantic import ValidationError

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.config.rig import CapturesConfig, RigConfig, ZenohConfig, of_one_line
from ldcnd.contract.errors import ConfigError
from ldcnd.daemon.line import BusService
from ldcnd.daemon.rig import OwnedRig
from ldcnd.drives.known import FAMILIES
from ldcnd.line.capture import Capture, CaptureHeader, capture_lines
from ldcnd.line.flight_recorder import WireEntries, WireRecord
from ldcnd.log import get_logger
from ldcnd.own_thread import OwnThread
from ldcnd.version import version

log = get_logger("captures")


SUFFIX = ".capture"
CHECK_PERIOD_S = 0.2
AFTERMATH_S = 0.5
PAUSE_S = 10.0
PIECE_LINES = 64


class CaptureStore:
    """A directory of captures.

    Args:
        directory: made when the first capture is written.
        files: maximum number of captures.
        total_bytes: maximum disk space; the newest capture stays even if it is larger.
    """

    def __init__(self, directory: Path, files: int, total_bytes: int) -> None:
        self._directory = directory
        self._files = files
        self._total_bytes = total_bytes

    def write(self, capture: Capture) -> Path | None:
        """Write one capture and return its file; None, and a line in the log, where that is impossible."""
        header = capture.header
        until_ns = header.zero_ns + round(header.until_s * 1e9)
        when = datetime.fromtimestamp(until_ns / 1e9, UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        cause = re.sub(r"[^a-z0-9]+", "-", header.cause.lower()).strip("-")[:60]
        path = self._directory / f"{when}-{header.bus}-{cause}{SUFFIX}"
        part = path.with_suffix(".part")
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            size = 0
            with part.open("wb", buffering=0) as file:
                for piece in _pieces(capture_lines(header, capture.records, _without_words)):
                    rest = piece
                    while rest:  # a disk that is nearly full takes a part, and says nothing
                        rest = rest[file.write(rest) :]  # lets go of the interpreter
                    size += len(piece)
            part.replace(path)
            self._thin_out(path)
        except OSError as error:
            log.error("capture not written", bus=header.bus, cause=header.cause, file=str(path), reason=str(error))
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)  # the disk needs the room
            return None
        log.warning("capture written", bus=header.bus, cause=header.cause, file=str(path), size_bytes=size)
        return path

    def _thin_out(self, newest: Path) -> None:
        """Delete the oldest captures, which have the smallest names, and what a crash has left unfinished."""
        for left in self._directory.glob("*.part"):
            left.unlink(missing_ok=True)
        captures = sorted(self._directory.glob(f"*{SUFFIX}"))
        sizes = {path: path.stat().st_size for path in captures}
        while len(sizes) > self._files or (sum(sizes.values()) > self._total_bytes and len(sizes) > 1):
            # names begin with the time: behind a clock that was set back the newest comes first
            oldest = next(path for path in sizes if path != newest or len(sizes) == 1)
            oldest.unlink(missing_ok=True)
            del sizes[oldest]


def _without_words(_record: object) -> str:
    return ""


def _pieces(lines: Iterator[str]) -> Iterator[bytes]:
    while piece := list(islice(lines, PIECE_LINES)):
        yield ("\n".join(piece) + "\n").encode()


@dataclass(frozen=True, slots=True)
class Run:
    """One run of the daemon: its name, when it began, UTC in ns since 1970, and its clock."""

    instance: str
    started_ns: int
    clock: Clock


@dataclass(frozen=True, slots=True)
class RecorderSnapshot:
    """The contents of a line's flight recorder at one instant; quick to take, and then independent of the line."""

    header: CaptureHeader
    entries: WireEntries


def snapshot_of(line: BusService, run: Run) -> RecorderSnapshot:
    """Take what a line's flight recorder holds: less than a millisecond for a full one."""
    log = line.bus.wire_log
    entries = log.entries()
    header = CaptureHeader(
        version=version(),
        bus=line.bus.settings.name,
        family=line.family,
        port=line.port,
        baud=line.bus.baud,
        instance=run.instance,
        zero_ns=run.clock.wall_ns(0.0),
        started_s=run.clock.started_s,
        until_s=run.clock.now_s(),
        first_record=log.added - len(entries),
    )
    return RecorderSnapshot(header, entries)


def capture_of(snapshot: RecorderSnapshot, config: RigConfig, cause: str) -> Capture:
    """Return a snapshot as a capture; needs no event loop, and takes its time."""
    alone = without_surroundings(config, snapshot.header.bus).model_dump(mode="json", exclude_defaults=True)
    header = snapshot.header.model_copy(update={"cause": cause, "config": alone})
    return Capture(header, tuple(WireRecord(*entry) for entry in snapshot.entries))


def lines_of(capture: Capture, config: RigConfig) -> Iterator[str]:
    """Yield the lines of a capture's text, with each packet in words."""
    line = next(line for line in config.bus if line.name == capture.header.bus)
    models = {axis.address: axis.model for axis in line.axis}
    return capture_lines(capture.header, capture.records, FAMILIES[line.family].describe(models))


def without_surroundings(config: RigConfig, bus: str) -> RigConfig:
    """Return the configuration of a rig as if it had one line, and neither network nor memory of its own.

    Raises:
        ConfigError: it has no such line.
    """
    line, _ = of_one_line(config, bus)
    return line.model_copy(update={"zenoh": ZenohConfig(), "state_dir": None, "captures": CapturesConfig()})


def config_of(header: CaptureHeader, beside: RigConfig | None = None) -> RigConfig:
    """Return the configuration that a capture belongs to: the one given, or the one in the capture; its line only.

    Raises:
        ConfigError: there is none, it has no such line, or this version cannot use it.
    """
    if beside is None:
        if header.config is None:
            raise ConfigError(
                "there is no configuration in the capture", remedy="name the file it was made with: --config FILE"
            )
        try:
            beside = RigConfig.model_validate(header.config)
        except ValidationError as error:
            raise ConfigError(f"the configuration in the capture does not fit this version: {error}") from error
    return without_surroundings(beside, header.bus)


class CaptureWatch:
    """Keeps the captures of one run of the daemon.

    Args:
        rig: its lines.
        config: returns what it runs with at present.
        run: which run this is.
        store: where captures go.
    """

    def __init__(self, rig: OwnedRig, config: Callable[[], RigConfig], run: Run, store: CaptureStore) -> None:
        self._rig = rig
        self._config = config
        self._run = run
        self._store = store
        self._known: dict[str, frozenset[str]] = {}
        self._last_s: dict[str, float] = {}

    async def run(self) -> None:
        """Watch until cancelled."""
        clock, loop = self._run.clock, asyncio.get_running_loop()
        writing = OwnThread("captures")
        while True:
            await asyncio.sleep(CHECK_PERIOD_S)
            for line in self._rig.buses:
                name = line.bus.settings.name
                if clock.now_s() < self._last_s.get(name, -PAUSE_S) + PAUSE_S:
                    continue
                causes = frozenset(_causes(line, clock.now_s()))
                news = causes - self._known.get(name, frozenset()) - frozenset(_inherited(line))
                # not joined with those of before: what has gone and comes again is news
                self._known[name] = causes
                if news:
                    await asyncio.sleep(AFTERMATH_S)
                    # counted from here, however long the disk takes
                    self._last_s[name] = clock.now_s()
                    snapshot = snapshot_of(line, self._run)
                    await loop.run_in_executor(writing, self._write, snapshot, "; ".join(sorted(news)))

    def write_all(self, cause: str) -> None:
        """Write a capture of every line here and now; for a process that is about to die."""
        for line in self._rig.buses:
            self._write(snapshot_of(line, self._run), cause)

    def _write(self, snapshot: RecorderSnapshot, cause: str) -> None:
        self._store.write(capture_of(snapshot, self._config(), cause))


def _causes_of(axis: AxisService) -> Iterator[str]:
    status = axis.tracker.status
    if status.first_fault is not None:
        yield f"{axis.config.name} {status.first_fault.code}"
    for fault in status.active_faults:
        yield f"{axis.config.name} {fault.code}"


def _inherited(line: BusService) -> Iterator[str]:
    """Yield what is wrong with axes whose drives have not answered yet: an earlier run has captured how it came."""
    for axis in line.axes:
        if axis.tracker.reading is None:
            yield from _causes_of(axis)


def _causes(line: BusService, now_s: float) -> Iterator[str]:
    """Yield what is wrong with a line now, or was since its axes were reset last."""
    for axis in line.axes:
        yield from _causes_of(axis)
    if line.bus.statistics.losses:
        # with their number, so that each loss is a cause of its own
        yield f"line down {line.bus.statistics.losses}"
    if not line.bus.on_time(now_s):
        yield "line acts too late"
