"""The families that there are: the one list of them."""

import asyncio
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any

from ldcnd.drives.family import Family
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.simulated_line import SimulatedLineConfig
from ldcnd.sim.chain import Chain

DEFAULT = "ldcn"
HOMES = {DEFAULT: "ldcnd.drives.ldcn.family:LDCN", "smartstep": "ldcnd.drives.smartstep.family:SMARTSTEP"}
"""The module of each family, and behind the colon its name there."""


class Families(Mapping[str, Family[Any, Any]]):
    """The families by name, each loaded when it is used first: a rig seldom has two, and one is a tenth of a daemon."""

    def __getitem__(self, name: str) -> Family[Any, Any]:
        """Return a family."""
        module, _, attribute = HOMES[name].partition(":")
        family: Family[Any, Any] = getattr(import_module(module), attribute)
        return family

    def __iter__(self) -> Iterator[str]:
        """Yield their names; loads none."""
        return iter(HOMES)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(HOMES)


FAMILIES = Families()


def bus_config(table: Mapping[str, Any]) -> type[BusConfig]:
    """Return the model that reads a `[[bus]]` table.

    Raises:
        ValueError: there is no such family.
    """
    family = table.get("family", DEFAULT)
    if family not in HOMES:
        raise ValueError(f"family {family!r} is not known; there are {', '.join(FAMILIES)}")
    return FAMILIES[family].bus_config


def bus_configs() -> dict[str, type[BusConfig]]:
    """Return the models of `[[bus]]` tables, by family."""
    return {name: family.bus_config for name, family in FAMILIES.items()}


def simulated_line(table: Mapping[str, Any]) -> type[SimulatedLineConfig]:
    """Return the model that reads a `[[sim]]` table: the one whose drives are in it.

    Raises:
        ValueError: there are none. Drives of several families are refused by the model of the first.
    """
    for family in FAMILIES.values():
        if table.get(family.simulated_key):
            return family.simulated_line
    keys = " or ".join(f"{family.simulated_key}s" for family in FAMILIES.values())
    raise ValueError(f"a simulated line has either {keys}")


def chain_of(settings: BusConfig, lines: Sequence[SimulatedLineConfig]) -> Chain | None:
    """Return the simulated line that a line of a rig is; None for a real one."""
    if not settings.simulated:
        return None
    line = next(line for line in lines if line.name == settings.simulated)
    return FAMILIES[settings.family].simulate(line, settings, asyncio.get_running_loop().time())


def simulated_lines() -> dict[str, type[SimulatedLineConfig]]:
    """Return the models of `[[sim]]` tables, by family."""
    return {name: family.simulated_line for name, family in FAMILIES.items()}
