"""The families that can be simulated: the one list of them, and what a configuration asks of the simulator."""

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

from ldcnd.config.simulated import SimulatedLineConfig
from ldcnd.drives.known import ByName
from ldcnd.drives.line_config import BusConfig
from ldcnd.line.transport import Opener
from ldcnd.sim.chain import Chain
from ldcnd.sim.family import SimulatedFamily

HOMES = {"ldcn": "ldcnd.sim.ldcn.family:SIMULATED_LDCN", "smartstep": "ldcnd.sim.smartstep.family:SIMULATED_SMARTSTEP"}
"""The module of each family's simulation, and behind the colon its name there."""
SIMULATED: Mapping[str, SimulatedFamily[Any, Any]] = ByName(HOMES)


def line_config(table: Mapping[str, Any]) -> type[SimulatedLineConfig]:
    """Return the model that reads a `[[sim]]` table: the one whose drives are in it.

    Raises:
        ValueError: there are none. Drives of several families are refused by the model of the first.
    """
    for family in SIMULATED.values():
        if table.get(family.key):
            found: type[SimulatedLineConfig] = family.line_config
            return found
    keys = " or ".join(f"{family.key}s" for family in SIMULATED.values())
    raise ValueError(f"a simulated line has either {keys}")


def line_configs() -> dict[str, type[SimulatedLineConfig]]:
    """Return the models of `[[sim]]` tables, by family."""
    return {name: family.line_config for name, family in SIMULATED.items()}


def refuse_other_drives(settings: BusConfig, line: SimulatedLineConfig) -> None:
    """Refuse a simulated line that has drives of another family than the line that it is.

    Raises:
        ValueError: says what its drives are called.
    """
    family = SIMULATED.get(settings.family)
    if family is None:
        raise ValueError(f"bus {settings.name}: drives of family {settings.family} are not simulated")
    if not isinstance(line, family.line_config):
        raise ValueError(  # noqa: TRY004 - of the configuration
            f"bus {settings.name}: drives of family {settings.family} are simulated by {family.key}s"
        )


def opener_of(settings: BusConfig, lines: Sequence[SimulatedLineConfig], chain: Chain | None = None) -> Opener:
    """Return what opens the simulated line that a line of a rig is, instead of a port.

    Args:
        settings: a line whose port is simulated.
        lines: of the rig.
        chain: the simulated line, where it exists already.
    """
    family = SIMULATED[settings.family]
    if chain is None:
        line = next(line for line in lines if line.name == settings.simulated)
        chain = family.chain(line, settings, asyncio.get_running_loop().time())
    return family.opener(chain, settings)
