"""Numbers of a configuration that measure something of an axis: where they stand, and in which units people read them.

A file has them in the units that people read for that axis; a configuration has them as they cross the network.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeGuard

from pydantic import BaseModel

from ldcnd.contract.number_text import NotANumber
from ldcnd.contract.units import DIMENSIONS, AxisUnits, Dimension, converts, quantity_text, read_quantity
from ldcnd.drives.axis_config import QUANTITIES, units_of_table

_OF_RULE = {"above": Dimension.VELOCITY}
_OF_REQUIREMENT = {"below": Dimension.VELOCITY, "min": Dimension.POSITION, "max": Dimension.POSITION}


@dataclass(frozen=True, slots=True)
class ReadQuantity:
    """A number of an axis, which reads as people read it; equal to another one as numbers are."""

    value: float
    text: str

    def __eq__(self, other: object) -> bool:
        return self.value == (other.value if isinstance(other, ReadQuantity) else other)

    def __hash__(self) -> int:
        return hash(self.value)

    def __str__(self) -> str:
        return self.text


def with_units(document: dict[str, Any]) -> dict[str, Any]:
    """Put numbers that are written with a unit, or meant in another one than that of their axis, into that of the axis.

    Raises:
        NotANumber: a text is none, or its unit does not fit; says where.
    """
    for place in _places(document):
        value = place.value
        if not (isinstance(value, str) or (_is_number(value) and converts(place.units, place.dimension))):
            continue
        try:
            place.table[place.key] = read_quantity(str(value), place.units, place.dimension)
        except NotANumber as error:
            raise NotANumber(f"{place.where}: {error}") from None
    return document


def as_people_read(config: BaseModel) -> dict[str, Any]:
    """Return a configuration as a document in which each number of an axis is a `ReadQuantity`."""
    document = config.model_dump(mode="json", serialize_as_any=True)
    for place in _places(document):
        if _is_number(value := place.value):
            # ten digits: all that was typed, without the rounding of the conversion
            place.table[place.key] = ReadQuantity(value, quantity_text(value, place.units, place.dimension, ".10g"))
    return document


@dataclass(frozen=True, slots=True)
class _Place:
    """A place of a document where a number of an axis may stand; `where` names it for people."""

    table: dict[str, Any]
    key: str
    units: AxisUnits
    dimension: Dimension
    where: str

    @property
    def value(self) -> object:
        return self.table[self.key]


def _places(document: dict[str, Any]) -> Iterator[_Place]:
    known: dict[str, AxisUnits] = {}

    def units_of(name: object) -> AxisUnits | None:
        return known.get(name) if isinstance(name, str) else None  # what is no name is refused later

    for bus_at, bus in _tables(document, "bus"):
        for axis_at, axis in _tables(bus, "axis"):
            name = axis.get("name")
            with suppress(ValueError):  # what is wrong with its units is refused with the rest
                if isinstance(name, str):
                    known[name] = units_of_table(axis)
            yield from _within(axis, units_of(name), QUANTITIES, f"bus[{bus_at}].axis[{axis_at}]")
    for rule_at, rule in _tables(document, "interlock"):
        where = f"interlock[{rule_at}]"
        yield from _within(rule, units_of(rule.get("of")), _OF_RULE, where)
        for at, each in _tables(rule, "requires"):
            yield from _within(each, units_of(each.get("axis")), _OF_REQUIREMENT, f"{where}.requires[{at}]")
    for at, position in _tables(document, "position"):
        places = position.get("axes")
        for axis in places if isinstance(places, dict) else ():
            yield from _within(position, units_of(axis), {f"axes.{axis}": Dimension.POSITION}, f"position[{at}]")
    for at, sequence in _tables(document, "sequence"):
        for step_at, step in _tables(sequence, "step"):
            if isinstance(given := step.get("arguments"), dict):
                where = f"sequence[{at}].step[{step_at}].arguments"
                yield from _within(given, units_of(step.get("axis")), DIMENSIONS, where)


def _within(
    table: dict[str, Any], units: AxisUnits | None, quantities: Mapping[str, Dimension], where: str
) -> Iterator[_Place]:
    for path, dimension in quantities.items() if units else ():
        *inner, key = path.split(".")
        holder = table.get(inner[0]) if inner else table
        if units and isinstance(holder, dict) and key in holder:
            yield _Place(holder, key, units, dimension, f"{where}.{path}")


def _tables(document: dict[str, Any], key: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the tables of a list with their places; what is none is refused later."""
    found = document.get(key)
    for at, each in enumerate(found if isinstance(found, list) else ()):
        if isinstance(each, dict):
            yield at, each


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
