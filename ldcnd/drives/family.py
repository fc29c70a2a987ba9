"""The contract of a drive family: one object with what a daemon needs, its configuration, its lines, their load.

A family is a folder with a subclass of `Family`, listed in `known.py`. Nothing outside the folder names it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from ldcnd.drives.cost import LineTiming
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.line_plan import Poll, Urgent, in_time
from ldcnd.drives.network import Network
from ldcnd.line.bus import Bus
from ldcnd.line.flight_recorder import Describe
from ldcnd.line.settings import BusSettings, ServoCycle
from ldcnd.line.transport import Opener

BusT = TypeVar("BusT", bound=BusConfig)


@dataclass(frozen=True, slots=True)
class UnopenedLine:
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


OpenLine = Callable[[BusT, Opener | None], UnopenedLine]
"""Makes a line: its configuration, and what opens it instead of its port."""


class Family(ABC, Generic[BusT]):
    """One drive family.

    Attributes:
        name: as `family` in the configuration.
        bus_config: reads a `[[bus]]` table.
        bauds: rates that its lines may run at; none when the rate is fixed.
    """

    name: str
    bus_config: type[BusT]
    bauds: tuple[int, ...] = ()

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


# -- what only some families can: a family that can inherits it ------------------------------------------------------


class HasParameterFiles(ABC):
    """A family whose drives have parameters that files hold."""

    @abstractmethod
    def check_parameters(self, values: Mapping[str, int]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return what is wrong with the parameters of a file, and what deserves attention; sends nothing to a drive."""

    @abstractmethod
    def parameter(self, name: str, value: int) -> tuple[str, str, Sequence[str]]:
        """Return a parameter's number, its value as a file has it, and remarks about its digits."""


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
