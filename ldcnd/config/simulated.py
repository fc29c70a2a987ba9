"""The door to the simulator: a rig with simulated lines needs it, every other rig runs without it.

What a `[[sim]]` table may have, and what plays it, is known there alone; it is loaded when a configuration has one.
"""

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Annotated, Any, Protocol

from pydantic import BaseModel, SerializeAsAny

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.toml import Name, Variants
from ldcnd.line.transport import Opener

SIMULATOR = "ldcnd.sim"


class SimulatedLineConfig(Frozen):
    """One simulated line, used by `port = "sim:NAME"`; the simulator adds what is on it."""

    name: Name
    """The name in `port = "sim:NAME"`."""


class Simulator(Protocol):
    """What the simulator does for a configuration and for a daemon: the functions of `ldcnd.sim.known`."""

    def line_config(self, table: Mapping[str, Any]) -> type[SimulatedLineConfig]:
        """Return the model that reads a `[[sim]]` table; raises ValueError when there is none."""

    def line_configs(self) -> Mapping[str, type[SimulatedLineConfig]]:
        """Return all of them, by family."""

    def refuse_other_drives(self, settings: BusConfig, line: SimulatedLineConfig) -> None:
        """Refuse a simulated line that has drives of another family than the line that it is; raises ValueError."""

    def opener_of(self, settings: BusConfig, lines: Sequence[SimulatedLineConfig]) -> Opener:
        """Return what opens the simulated line that a line of a rig is, instead of a port."""


def simulator() -> Simulator:
    """Load the simulator.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        known: Simulator = import_module(f"{SIMULATOR}.known")
    except ModuleNotFoundError as error:
        if error.name not in {SIMULATOR, f"{SIMULATOR}.known"}:
            raise
        raise ConfigError(
            f"simulated lines need the simulator, {SIMULATOR}, which is not installed",
            remedy="install all of ldcnd, or give the line a port and delete [[sim]]",
        ) from error
    return known


def _line_config(table: Mapping[str, Any]) -> type[BaseModel]:
    try:
        return simulator().line_config(table)
    except ConfigError as error:  # one complaint among others about the file
        raise ValueError(f"{error.message}; {error.remedy}") from error


def _line_configs() -> Mapping[str, type[BaseModel]]:
    try:
        return simulator().line_configs()
    except ConfigError:
        return {}


SimulatedLine = Annotated[SerializeAsAny[SimulatedLineConfig], Variants(_line_config, _line_configs)]
