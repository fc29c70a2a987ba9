"""Captures that the daemon makes of its lines: what is in them, and where they are kept.

Writing one never runs on the event loop. The text is written in small pieces: between two of them another thread may
have the interpreter, so a bus waits for less than a millisecond.
"""

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from ldcnd.config.rig import CapturesConfig, RigConfig, ZenohConfig
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.line.line import BusService
from ldcnd.errors import ConfigError
from ldcnd.families.known import FAMILIES
from ldcnd.log import get_logger
from ldcnd.version import version
from ldcnd.wirelog.capture import Capture, CaptureHeader, capture_lines
from ldcnd.wirelog.recorder import WireEntry, WireRecord

log = get_logger("captures")


SUFFIX = ".capture"
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
class Snapshot:
    """The contents of a line's flight recorder at one instant; quick to take, and then independent of the line."""

    bus: str
    family: str
    port: str
    baud: int
    zero_ns: int
    until_s: float
    added: int
    entries: tuple[WireEntry, ...]


def snapshot_of(line: BusService, clock: Clock) -> Snapshot:
    """Take what a line's flight recorder holds: about a millisecond for a full one."""
    log = line.bus.wire_log
    return Snapshot(
        bus=line.bus.settings.name,
        family=line.family,
        port=line.port,
        baud=line.bus.baud,
        zero_ns=clock.wall_ns(0.0),
        until_s=clock.now_s(),
        added=log.added,
        entries=log.entries(),
    )


def capture_of(snapshot: Snapshot, config: RigConfig, run: Run, cause: str) -> Capture:
    """Return a snapshot as a capture; needs no event loop, and takes its time."""
    header = CaptureHeader(
        version=version(),
        bus=snapshot.bus,
        family=snapshot.family,
        port=snapshot.port,
        baud=snapshot.baud,
        instance=run.instance,
        zero_ns=snapshot.zero_ns,
        started_s=run.clock.started_s,
        until_s=snapshot.until_s,
        first_record=snapshot.added - len(snapshot.entries),
        cause=cause,
        config=of_one_line(config, snapshot.bus).model_dump(mode="json", exclude_defaults=True),
    )
    return Capture(header, tuple(WireRecord(*entry) for entry in snapshot.entries))


def lines_of(capture: Capture, config: RigConfig) -> Iterator[str]:
    """Yield the lines of a capture's text, with each packet in words."""
    line = next(line for line in config.bus if line.name == capture.header.bus)
    models = {axis.address: axis.model for axis in line.axis}
    return capture_lines(capture.header, capture.records, FAMILIES[line.family].describe(models))


def of_one_line(config: RigConfig, bus: str) -> RigConfig:
    """Return the configuration of a rig as if it had one line, and neither network nor memory of its own.

    Raises:
        ConfigError: it has no such line.
    """
    lines = tuple(line for line in config.bus if line.name == bus)
    if not lines:
        raise ConfigError(f"rig {config.rig} has no bus {bus!r}; it has {', '.join(line.name for line in config.bus)}")
    simulated = tuple(line for line in config.sim if f"sim:{line.name}" == lines[0].port)
    alone = {"bus": lines, "sim": simulated, "zenoh": ZenohConfig(), "state_dir": None, "captures": CapturesConfig()}
    return config.model_copy(update=alone)
