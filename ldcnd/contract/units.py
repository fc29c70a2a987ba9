"""Units of an axis: which are taken and shown for its positions, velocities and accelerations, and their conversion.

What crosses the network is in the unit of the axis, that unit a second, and that unit a second squared. The description
of an axis has a table of the others; whatever people type, and whatever is shown to them, is converted here.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from types import MappingProxyType
from typing import Protocol, Self

from ldcnd.contract.number_text import NotANumber, behind_number, read_exact, read_number, same_unit


class Dimension(StrEnum):
    """What a number of an axis measures."""

    POSITION = "position"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"


POSITION, VELOCITY, ACCELERATION = Dimension
DIMENSIONS: Mapping[str, Dimension] = MappingProxyType(
    {
        **dict.fromkeys(("position", "distance", "move_to", "via", "max_deviation"), POSITION),
        **dict.fromkeys(("velocity", "find_velocity", "speed"), VELOCITY),
        "acceleration": ACCELERATION,
    }
)
"""What the fields of commands measure, by their names."""
PER: Mapping[Dimension, str] = MappingProxyType({POSITION: "", VELOCITY: "/s", ACCELERATION: "/s2"})
"""What follows the unit of an axis on the network."""
UnitTable = Mapping[Dimension, Mapping[str, str]]
EARTH_M_S2 = 9.80665
"""Standard gravity, metres a second squared; exact by definition (3rd CGPM, 1901)."""
_TURN = Fraction(1)
_KNOWN: tuple[Mapping[str, Fraction], ...] = (
    {"rev": _TURN, "deg": _TURN / 360, "rad": Fraction(1 / math.tau), "mrad": Fraction(1 / math.tau) / 1000},
    {
        "m": Fraction(1),
        "cm": Fraction(1, 100),
        "mm": Fraction(1, 1000),
        "um": Fraction(1, 10**6),
        "in": Fraction(254, 10**4),
    },
)
"""Turns and metres in units that can be converted: exact ones, and radians to the last digit of a binary64."""


class Described(Protocol):
    """What is read of the description of an axis."""

    @property
    def unit(self) -> str: ...  # noqa: D102
    @property
    def units(self) -> UnitTable: ...  # noqa: D102
    @property
    def g_velocity(self) -> float | None: ...  # noqa: D102


class Ratio(float):
    """A number that is given as a ratio of whole numbers, such as 10000/360: nothing of it is lost by rounding.

    Attributes:
        written: as it was given.
    """

    __slots__ = ("written",)
    written: str

    def __new__(cls, written: str) -> Self:
        """Return the number nearest to a ratio.

        Raises:
            ValueError: it is none above 0, or too large.
        """
        try:
            number = super().__new__(cls, ratio(written))
        except OverflowError:
            raise ValueError(f"{written!r} is too large") from None
        number.written = written
        return number

    @property
    def exact(self) -> Fraction:
        """The ratio itself."""
        return ratio(self.written)


@dataclass(frozen=True, slots=True)
class AxisUnits:
    """The units of an axis that is not described yet: see `AxisInfo`."""

    unit: str
    units: UnitTable
    g_velocity: float | None = None


def unit_table(
    unit: str, counts_per_unit: float | None, velocity: str | None, acceleration: str | None, own: Mapping[str, str]
) -> UnitTable:
    """Return the units that are taken for an axis, each with how many units of the axis it is; first the one shown.

    Args:
        unit: of the axis.
        counts_per_unit: encoder counts in it, exact where it is a `Ratio`; None for an axis in counts.
        velocity: the unit in which velocities are shown and typed; None for `unit` a second.
        acceleration: likewise.
        own: further units, each with how many of `unit` it is, such as 1/3.

    Raises:
        ValueError: one of them does not measure that; lists those that do.
    """
    places = {unit: Fraction(1)}
    for known in _KNOWN:
        for name, scale in known.items() if _like(unit, known) else ():
            places.setdefault(name, scale / known[_like(unit, known)])
    if counts_per_unit:
        counts = counts_per_unit.exact if isinstance(counts_per_unit, Ratio) else Fraction(counts_per_unit)
        places.setdefault("count", 1 / counts)
    for name, written in own.items():
        if not name.isalpha() or name in ("g", "rpm", *places):
            raise ValueError(f"units: {name!r} is the name of another unit, or has other characters than letters")
        places[name] = ratio(written)
    speeds = {f"{name}/{time}": scale / s for time, s in (("s", 1), ("min", 60)) for name, scale in places.items()}
    gains = {f"{name}/s2": scale for name, scale in places.items()}
    if "rev" in places:
        speeds["rpm"] = places["rev"] / 60
        gains["rpm/s"] = places["rev"] / 60
    if "m" in places:
        gains["g"] = places["m"] * Fraction(str(EARTH_M_S2))
    return {
        POSITION: _table(places, unit),
        VELOCITY: _table(speeds, velocity or f"{unit}/s"),
        ACCELERATION: _table(gains, acceleration or f"{unit}/s2"),
    }


def si(unit: str) -> float | None:
    """Return the metres or radians in a unit; None in a unit of anything else."""
    turns, metres = _KNOWN
    if name := _like(unit, turns):
        return {"rad": 1.0, "mrad": 1e-3}.get(name, float(turns[name]) * math.tau)
    return float(metres[name]) if (name := _like(unit, metres)) else None


def ratio(written: str) -> Fraction:
    """Return a ratio of whole numbers above 0, or a decimal number.

    Raises:
        ValueError: it is none.
    """
    try:
        value = Fraction(written)
    except (ValueError, ZeroDivisionError):
        value = Fraction(0)
    if value <= 0:
        raise ValueError(f"{written!r} is not a ratio above 0, such as 1/3 or 0.25")
    return value


def g_velocity(units: UnitTable, radius_m: float) -> float:
    """Return the velocity at which 1 g acts at a radius, in units of the axis a second.

    Raises:
        ValueError: the axis does not turn.
    """
    if "rev/s" not in units[VELOCITY]:
        raise ValueError("radius_m: only an axis that turns has one: its unit is rev, deg or rad, or `units` has rev")
    return math.sqrt(EARTH_M_S2 / radius_m) / math.tau * float(Fraction(units[VELOCITY]["rev/s"]))


def units_of(info: Described, dimension: Dimension) -> tuple[str, ...]:
    """Return the units that are taken; the first is the one that is shown, and meant where none is typed."""
    units = tuple(_scales(info, dimension))
    return (*units, "g") if dimension is VELOCITY and info.g_velocity else units


def read_quantity(text: str, info: Described, dimension: Dimension) -> float:
    """Return what was typed as a number of the network; without a unit it is in the one that is shown.

    Raises:
        NotANumber: it is none, or its unit does not measure that; lists the units that do.
    """
    known = units_of(info, dimension)
    read_number(text, *known)
    unit = next((each for each in known if same_unit(behind_number(text), each)), known[0])
    scales = _scales(info, dimension)
    if unit not in scales:  # g of a rotor: it grows with the square of the velocity
        acting = read_number(text, unit)
        return math.copysign((info.g_velocity or 0.0) * math.sqrt(abs(acting)), acting)
    value = read_exact(text, unit) * Fraction(scales[unit])
    try:
        return float(value)
    except OverflowError:
        raise NotANumber(f"\u201c{text.strip()}\u201d is too large") from None


def quantity_in(value: float, unit: str, info: Described, dimension: Dimension) -> float:
    """Return a number of the network in a unit that is taken for the axis, as it would be typed."""
    scale = next((each for name, each in _scales(info, dimension).items() if same_unit(unit, name)), None)
    if scale is None:  # g of a rotor
        return math.copysign((value / (info.g_velocity or math.nan)) ** 2, value)
    return float(Fraction(value) / Fraction(scale))


def converts(info: Described, dimension: Dimension) -> bool:
    """Tell whether numbers are shown in another unit than they have on the network."""
    return next(iter(_scales(info, dimension).values())) != "1"


def shown_quantity(value: float, info: Described, dimension: Dimension) -> tuple[float, str]:
    """Return a number of the network as it is shown, and its unit."""
    unit, scale = next(iter(_scales(info, dimension).items()))
    if scale == "1":
        return value, unit
    try:
        return float(Fraction(value) / Fraction(scale)), unit
    except OverflowError:  # it is told in a refusal of that number
        return math.copysign(math.inf, value), unit


def quantity_text(value: float, info: Described, dimension: Dimension, form: str = ".4g") -> str:
    """Return a number of the network for people, with its unit, and with g where the axis has a radius."""
    shown, unit = shown_quantity(value, info, dimension)
    share = value / info.g_velocity if dimension is VELOCITY and info.g_velocity else None
    acts = "" if share is None else f" ({share * share:.4g} g)"  # a power would raise where this is infinite
    return f"{shown:{form}} {unit}{acts}".replace("/s2", "/s\u00b2")


def _scales(info: Described, dimension: Dimension) -> Mapping[str, str]:
    """Return the table of a description; of a daemon of before there is none."""
    return info.units.get(dimension) or {f"{info.unit}{PER[dimension]}": "1"}


def _like(unit: str, known: Mapping[str, Fraction]) -> str:
    return next((name for name in known if same_unit(unit, name)), "")


def _table(scales: Mapping[str, Fraction], shown: str) -> dict[str, str]:
    """Return scales as text, that of the unit that is shown first."""
    first = next((name for name in scales if same_unit(name, shown)), None)
    if first is None:
        raise ValueError(f"{shown!r} does not fit: it is one of {', '.join(scales)}")
    return {first: str(scales[first])} | {name: str(scale) for name, scale in scales.items()}
