"""The families that there are: the one list of them."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any, TypeVar

from ldcnd.drives.family import Family
from ldcnd.drives.line_config import BusConfig

DEFAULT = "ldcn"
HOMES = {DEFAULT: "ldcnd.drives.ldcn.family:LDCN", "smartstep": "ldcnd.drives.smartstep.family:SMARTSTEP"}
"""The module of each family, and behind the colon its name there."""


PartT = TypeVar("PartT")


class ByName(Mapping[str, PartT]):
    """A part of each family by the family's name, loaded when it is used first: a rig seldom has two families.

    Args:
        homes: the module of each part, and behind a colon its name there.
    """

    def __init__(self, homes: Mapping[str, str]) -> None:
        self._homes = homes

    def __getitem__(self, name: str) -> PartT:
        """Return the part of a family."""
        module, _, attribute = self._homes[name].partition(":")
        part: PartT = getattr(import_module(module), attribute)
        return part

    def __iter__(self) -> Iterator[str]:
        """Yield the names of families; loads nothing."""
        return iter(self._homes)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._homes)


FAMILIES: Mapping[str, Family[Any]] = ByName(HOMES)


def bus_config(table: Mapping[str, Any]) -> type[BusConfig]:
    """Return the model that reads a `[[bus]]` table.

    Raises:
        ValueError: there is no such family.
    """
    family = table.get("family", DEFAULT)
    if not isinstance(family, str) or family not in HOMES:
        raise ValueError(f"family {family!r} is not known; there are {', '.join(FAMILIES)}")
    return FAMILIES[family].bus_config


def bus_configs() -> dict[str, type[BusConfig]]:
    """Return the models of `[[bus]]` tables, by family."""
    return {name: family.bus_config for name, family in FAMILIES.items()}
