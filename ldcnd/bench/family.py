"""The contract of what the bench does with a drive family, on a line that no daemon owns.

It is a folder with a subclass of `BenchFamily`, listed in `known.py` under the family's name.
"""

from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import click

from ldcnd.contract.health import Finding
from ldcnd.drives.driver import Gains
from ldcnd.drives.family import UnopenedLine
from ldcnd.drives.line_config import BusConfig
from ldcnd.line.bus import Bus
from ldcnd.line.transport import Opener

BusT = TypeVar("BusT", bound=BusConfig)


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
class LineTrial:
    """A line on which drives are tried, what that finds, and its configuration if it needs one."""

    bus: Bus
    findings: AsyncGenerator[Finding]
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
    findings: AsyncGenerator[Finding]
    drives: Sequence[ScannedDrive]


class BenchFamily(ABC, Generic[BusT]):
    """One drive family on the bench.

    Attributes:
        is_tuned_by_host: whether `ldcnd tune` finds gains for its axes.
    """

    is_tuned_by_host: bool = False

    @abstractmethod
    def examine(self, line: UnopenedLine, settings: BusT) -> AsyncGenerator[Finding]:
        """Examine an open line by reading only."""

    def commands(self) -> Sequence[click.Command]:
        """Return further commands of `ldcnd doctor`."""
        return ()

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
    ) -> LineTrial:
        """Return the trial of the drives on a port.

        Args:
            port: that they are on.
            units: their numbers, where the family cannot find them.
            move: None to read only.
            held: tells whether the dead-man is held.
            opener: opens the line instead of its port.
        """

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
