"""The families that there are: the one list of them."""

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

from ldcnd.config.bus import BusConfig
from ldcnd.config.simulated_line import SimulatedLineConfig
from ldcnd.families.family import Family
from ldcnd.families.ldcn.family import LDCN
from ldcnd.families.smartstep.family import SMARTSTEP
from ldcnd.sim.chain import Chain

DEFAULT = LDCN.name
FAMILIES: dict[str, Family[Any, Any]] = {LDCN.name: LDCN, SMARTSTEP.name: SMARTSTEP}


def bus_config(table: Mapping[str, Any]) -> type[BusConfig]:
    """Return the model that reads a `[[bus]]` table.

    Raises:
        ValueError: there is no such family.
    """
    family = table.get("family", DEFAULT)
    if family not in FAMILIES:
        raise ValueError(f"family {family!r} is not known; there are {', '.join(FAMILIES)}")
    return bus_configs()[family]


def bus_configs() -> dict[str, type[BusConfig]]:
    """Return the models of `[[bus]]` tables, by family."""
    return {name: family.bus_config for name, family in FAMILIES.items()}


def simulated_line(table: Mapping[str, Any]) -> type[SimulatedLineConfig]:
    """Return the model that reads a `[[sim]]` table: the one whose drives are in it.

    Raises:
        ValueError: there are none, or drives of several families.
    """
    found = [family for family in FAMILIES.values() if table.get(family.simulated_key)]
    if len(found) != 1:
        keys = " or ".join(f"{family.simulated_key}s" for family in FAMILIES.values())
        raise ValueError(f"a simulated line has either {keys}")
    return simulated_lines()[found[0].name]


def chain_of(settings: BusConfig, lines: Sequence[SimulatedLineConfig]) -> Chain | None:
    """Return the simulated line that a line of a rig is; None for a real one."""
    if not settings.simulated:
        return None
    line = next(line for line in lines if line.name == settings.simulated)
    return FAMILIES[settings.family].simulate(line, settings, asyncio.get_running_loop().time())


def simulated_lines() -> dict[str, type[SimulatedLineConfig]]:
    """Return the models of `[[sim]]` tables, by family."""
    return {name: family.simulated_line for name, family in FAMILIES.items()}
