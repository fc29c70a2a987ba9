"""The families that the bench knows: the one list of them, and their configured lines opened without a daemon."""

from collections.abc import Mapping
from typing import Any

from ldcnd.bench.family import BenchFamily
from ldcnd.config.rig import RigConfig
from ldcnd.config.simulated import simulator
from ldcnd.drives.family import UnopenedLine
from ldcnd.drives.known import FAMILIES, ByName
from ldcnd.drives.line_config import BusConfig

HOMES = {"ldcn": "ldcnd.bench.ldcn.family:LDCN_BENCH", "smartstep": "ldcnd.bench.smartstep.family:SMARTSTEP_BENCH"}
"""The module of what the bench does with each family, and behind the colon its name there."""
BENCHES: Mapping[str, BenchFamily[Any]] = ByName(HOMES)


def line_of(rig: RigConfig, settings: BusConfig) -> UnopenedLine:
    """Return a line of a configuration that is not open yet, also a simulated one.

    Raises:
        ConfigError: it is simulated, and there is no simulator.
    """
    opener = simulator().opener_of(settings, rig.sim) if settings.simulated else None
    return FAMILIES[settings.family].open_lines(None)(settings, opener)
