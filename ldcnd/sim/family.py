"""The contract of what simulates a drive family: one object with the configuration of its lines and what plays them.

It is a folder with a subclass of `SimulatedFamily`, listed in `known.py` under the family's name.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import click

from ldcnd.drives.line_config import BusConfig
from ldcnd.line.transport import Opener
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.line_config import FaultyLineConfig

BusT = TypeVar("BusT", bound=BusConfig)
LineT = TypeVar("LineT", bound=FaultyLineConfig)


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


class SimulatedFamily(ABC, Generic[BusT, LineT]):
    """The simulation of one drive family.

    Attributes:
        line_config: reads a `[[sim]]` table.
        key: the key of such a table that no other family has: its drives.
    """

    line_config: type[LineT]
    key: str

    @abstractmethod
    def chain(self, line: LineT, settings: BusT, starts_at_s: float) -> Chain:
        """Return a simulated line; its events count from an instant of the loop's clock."""

    @abstractmethod
    def opener(self, chain: Chain, settings: BusT) -> Opener:
        """Return what opens a simulated line as drivers of the family expect it."""

    def sim_options(self) -> Sequence[click.Option]:
        """Return the options of `ldcnd sim` that describe a line; none where it serves no lines of the family."""
        return ()

    def served(self, options: Mapping[str, Any], faults: Callable[[int], FaultPlan]) -> ServedLine | None:  # noqa: ARG002 - for families with options
        """Return the line that the options describe; None when they describe none of this family.

        Args:
            options: those of `sim_options`, and `seed` and `baud_check`.
            faults: returns the faults of the fault plan, given the seed.
        """
        return None
