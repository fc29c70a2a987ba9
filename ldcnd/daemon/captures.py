"""What is in a capture that the daemon makes of one of its lines."""

from collections.abc import Iterator
from dataclasses import dataclass

from ldcnd.bus.capture import Capture, CaptureHeader, capture_lines
from ldcnd.bus.wire_log import WireEntry, WireRecord
from ldcnd.config import CapturesConfig, RigConfig, ZenohConfig
from ldcnd.daemon.bus_service import BusService
from ldcnd.daemon.clock import Clock
from ldcnd.drivers.transcript import describer
from ldcnd.errors import ConfigError
from ldcnd.version import version


@dataclass(frozen=True, slots=True)
class Run:
    """One run of the daemon: its name, when it began, UTC in ns since 1970, and its clock."""

    instance: str
    started_ns: int
    clock: Clock


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What the flight recorder of a line held at one instant; quick to take, and then independent of the line."""

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
    return capture_lines(capture.header, capture.records, describer(line.family, models))


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
