"""The contract of a drive family: one object with its configuration, its lines and its tools.

A family is a folder with a subclass of `Family`, listed in `known.py`. Nothing outside the folder names it.
"""

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import click

from ldcnd.contract.health import Finding
from ldcnd.drives.cost import LineTiming
from ldcnd.drives.driver import Gains
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.line_plan import Poll, Urgent, in_time
from ldcnd.drives.network import Network
from ldcnd.drives.simulated_line import SimulatedLineConfig
from ldcnd.drives.transcript import Describe
from ldcnd.line.bus import Bus
from ldcnd.line.settings import BusSettings, ServoCycle
from ldcnd.line.transport import Opener
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultPlan

BusT = TypeVar("BusT", bound=BusConfig)
SimulatedT = TypeVar("SimulatedT", bound=SimulatedLineConfig)


@dataclass(frozen=True, slots=True)
class Line:
    """A line that is not open yet: who owns it, and the drives on it."""

    bus: Bus
    network: Network


@dataclass(frozen=True, slots=True)
class Demand:
    """The load of a line, and how fast the line is.

    Attributes:
        timing: of the line.
        polls: the periodic exchanges.
        urgent: what goes before them.
        by_deadline: the earliest deadline goes first; otherwise axes take turns, exchange by exchange.
        cycle: of the drives, where polls with the same deadline are ordered by it.
    """

    timing: LineTiming
    polls: Sequence[Poll]
    urgent: Urgent
    by_deadline: bool = True
    cycle: ServoCycle | None = None

    @property
    def fits(self) -> bool:
        """Whether every poll is always over before its next turn."""
        probes = [self.urgent.probe] if self.urgent.probe else []
        return in_time(self.polls, probes, by_deadline=self.by_deadline)

    @property
    def without_probes(self) -> "Demand":
        """The same without probes of the stop lane."""
        return replace(self, urgent=replace(self.urgent, probe=None))

    @property
    def stop_probe_hz(self) -> float:
        """How often the stop lane is probed; 0 for never."""
        return 1.0 / self.urgent.probe.period_s if self.urgent.probe else 0.0


@dataclass(frozen=True, slots=True)
class TrialMove:
    """The limits of a drive's trial move.

    Attributes:
        address: of the drive.
        gains: loaded first.
        counts: there and back.
        velocity_counts_per_s: positive.
        acceleration_counts_per_s2: positive.
    """

    address: int
    gains: Gains
    counts: int
    velocity_counts_per_s: float
    acceleration_counts_per_s2: float


@dataclass(frozen=True, slots=True)
class Trial:
    """A line on which drives are tried, what that finds, and its configuration if it needs one."""

    bus: Bus
    findings: AsyncIterator[Finding]
    settings: BusConfig | None = None


@dataclass(frozen=True, slots=True)
class ScannedDrive:
    """A module that a scan found at an address.

    Attributes:
        address: of it.
        model: as in the configuration; None for a device without a profile.
        is_axis: ldcnd can move it.
        baud: the rate at which it answers.
        text: what it is and does, for a person.
    """

    address: int
    model: str | None
    is_axis: bool
    baud: int
    text: str


@dataclass(frozen=True, slots=True)
class Scan:
    """A scan of an unknown line.

    Attributes:
        bus: of the line, not open yet.
        findings: runs the scan, while the line is open.
        drives: what was found, in the order of addresses; complete when `findings` has ended.
    """

    bus: Bus
    findings: AsyncIterator[Finding]
    drives: Sequence[ScannedDrive]


class PacketCutter(Protocol):
    """Cuts the bytes of a host into packets."""

    def begins(self, byte: int) -> bool:
        """Tell whether this byte would begin a packet."""

    def feed(self, byte: int) -> object:
        """Take a byte; return something true when it completes a packet."""


@dataclass(frozen=True, slots=True)
class ServedLine:
    """A simulated line for a pseudo-terminal.

    Attributes:
        chain: with its drives.
        described: what `--json` says about it.
        baud: the rate at which its drives begin.
        cutter: makes what cuts the host's bytes into packets, for the wire log.
        baud_check: bytes at another rate are garbage.
    """

    chain: Chain
    described: Mapping[str, Any]
    baud: int
    cutter: Callable[[], PacketCutter]
    baud_check: bool = False


OpenLine = Callable[[BusT, Opener | None, Chain | None], Line]
"""Makes a line: its configuration, what opens it instead of its port, the simulated line that it is."""


class Family(ABC, Generic[BusT, SimulatedT]):
    """One drive family.

    Attributes:
        name: as `family` in the configuration.
        bus_config: reads a `[[bus]]` table.
        simulated_line: reads a `[[sim]]` table.
        simulated_key: the key of such a table that no other family has: its drives.
        bauds: rates that its lines may run at; none when the rate is fixed.
        is_tuned_by_host: whether `ldcnd tune` finds gains for its axes.
    """

    name: str
    bus_config: type[BusT]
    simulated_line: type[SimulatedT]
    simulated_key: str
    bauds: tuple[int, ...] = ()
    is_tuned_by_host: bool = False

    @abstractmethod
    def open_lines(self, state_dir: Path | None) -> OpenLine[BusT]:
        """Return what makes the lines of one rig; nothing is opened yet.

        Args:
            state_dir: where what outlives the daemon is kept; None where nothing is.

        Raises:
            ConfigError: what is kept there cannot be read.
        """

    @abstractmethod
    def plan(self, settings: BusT) -> Demand:
        """Return the load of a line."""

    @abstractmethod
    def describe(self, models: Mapping[int, str]) -> Describe:
        """Return what puts the records of a line into words.

        Args:
            models: the drives' models by address, as far as they are known.
        """

    @abstractmethod
    def simulate(self, line: SimulatedT, settings: BusT, starts_at_s: float) -> Chain:
        """Return a simulated line; its events count from an instant of the loop's clock."""


# -- what only some families can: a family that can inherits it ------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ConfigFiles:
    """Operations of tools on files of the configuration.

    Attributes:
        lines: reads one and returns its lines.
        chain: builds the simulated line that a line of a file is; None for a real one.
        set_for_axis: sets values of an axis: the file, the axis, tables by name with their keys and literals.
    """

    lines: Callable[[Path], Sequence[BusConfig]]
    chain: Callable[[Path, BusConfig], Chain | None]
    set_for_axis: Callable[[Path, str, Mapping[str, Mapping[str, str]]], None]


class Examines(ABC, Generic[BusT]):
    """A family whose lines `ldcnd doctor` examines.

    Attributes:
        examination: what it does, as a help text.
    """

    examination: str

    @abstractmethod
    def examine(self, line: Line, settings: BusT) -> AsyncIterator[Finding]:
        """Examine an open line by reading only."""

    def commands(self, files: ConfigFiles) -> Sequence[click.Command]:  # noqa: ARG002 - most have none
        """Return further commands of `ldcnd doctor`."""
        return ()


class Tries(ABC):
    """A family whose drives `ldcnd accept` tries against the documents."""

    def assumptions(self) -> Sequence[Mapping[str, str]]:
        """Return what the documents leave open, as far as a trial confirms it."""
        return ()

    @abstractmethod
    def trial(
        self,
        port: str,
        units: Sequence[int],
        move: TrialMove | None,
        held: Callable[[], bool],
        opener: Opener | None = None,
    ) -> Trial:
        """Return the trial of the drives on a port.

        Args:
            port: that they are on.
            units: their numbers, where the family cannot find them.
            move: None to read only.
            held: tells whether the dead-man is held.
            opener: opens the line instead of its port.
        """


class Scans(ABC):
    """A family whose drives `ldcnd scan` finds on a line of which nothing is known."""

    @abstractmethod
    def scan(self, port: str, *, give_addresses: bool, opener: Opener | None = None) -> Scan:
        """Return a scan of a port; it reads only.

        Args:
            port: that drives may be on.
            give_addresses: reset and address them where nothing can be moving; families without addresses ignore it.
            opener: opens the line instead of its port.
        """

    @abstractmethod
    def configured_line(self, name: str, port: str, drives: Sequence[ScannedDrive]) -> str:
        """Return the `[[bus]]` table of a line, without its drives, as the configuration has it."""

    @abstractmethod
    def configured_drive(self, name: str, drive: ScannedDrive) -> str:
        """Return the table of a drive of a known model, as the configuration has it."""


class HasParameters(ABC):
    """A family whose drives have parameters that files hold."""

    @abstractmethod
    def check_parameters(self, values: Mapping[str, int]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return what is wrong with the parameters of a file, and what deserves attention; sends nothing to a drive."""

    @abstractmethod
    def parameter(self, name: str, value: int) -> tuple[str, str, Sequence[str]]:
        """Return a parameter's number, its value as a file has it, and remarks about its digits."""


class ServesLines(ABC):
    """A family whose simulated lines `ldcnd sim` serves behind a pseudo-terminal."""

    @abstractmethod
    def sim_options(self) -> Sequence[click.Option]:
        """Return the options that describe a line."""

    @abstractmethod
    def served(self, options: Mapping[str, Any], faults: Callable[[int], FaultPlan]) -> ServedLine | None:
        """Return the line that the options describe; None when they describe none of this family.

        Args:
            options: those of `sim_options`, and `seed` and `baud_check`.
            faults: returns the faults of the fault plan, given the seed.
        """


def bus_settings(settings: BusConfig, baud: int, *, margin_s: float = 0.0, **family: Any) -> BusSettings:  # noqa: ANN401
    """Return the settings of a bus: those of every line, and what the family adds to them."""
    return BusSettings(
        settings.name,
        baud,
        margin_s=settings.margin_ms / 1000 + margin_s,
        recorded_s=settings.recorder.seconds,
        recorded_bytes=settings.recorder.memory_mb * 1_000_000,
        **family,
    )
