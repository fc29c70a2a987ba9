"""The parameters Pn: numbers, names, and what is known of their units, ranges and defaults.

Addresses and names are stated by the manual; units and ranges mostly are not. A value marked RECOLLECTED is a hint for
a person: the drive enforces its ranges itself (data error), so nothing here refuses a value that fits 16 bits.
Defaults, and what waits for the next power-on, are RECOLLECTED unless a comment says otherwise.
Source: manual 3, "Correspondence of addresses and user parameters for drivers"; 2.2, examples 2 and 6.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.smartstep.addresses import EEPROM_AREA, RAM_OFFSET

ValueT = TypeVar("ValueT")
LONGEST_NUMBER = 3
"""Hexadecimal digits of a parameter number."""
DIGITS = 4
UNIT_DIGIT = 2
"""The unit number is Pn000.2: digits count from the right (INFERRED_HIGH)."""


class Confidence(Enum):
    """Where a fact about a parameter comes from."""

    STATED = "S"
    """The manual says so."""
    RELATED = "X"
    """A public manual of a related drive says so."""
    RECOLLECTED = "M"
    """No source was found; a hint for people, never a reason to refuse."""


@dataclass(frozen=True, slots=True)
class Fact(Generic[ValueT]):
    """A value and where it comes from."""

    value: ValueT
    confidence: Confidence


@dataclass(frozen=True, slots=True)
class Limits:
    """Both ends belong to the range."""

    lowest: int
    highest: int


@dataclass(frozen=True, slots=True)
class Digit:
    """One of the four settings of a parameter that is read as hexadecimal digits.

    Attributes:
        place: from the right, 0 to 3.
        title: what it sets.
        values: what its values mean; empty where it is a number or not known.
        confidence: where title and values come from.
    """

    place: int
    title: str
    values: Mapping[int, str] = field(default_factory=dict)
    confidence: Confidence = Confidence.RECOLLECTED


@dataclass(frozen=True, slots=True)
class Parameter:
    """One Pn; a word without sign on the wire.

    Attributes:
        number: as the digits of its name: Pn10A is 010AH.
        name: as the manual gives it; empty for an unlisted parameter.
        unit: None where it has none or it is not known.
        power_cycle: whether a change takes effect only at the next power-on; a RAM write of such a parameter is
            useless.
        nibbles: four separate settings, shown as hexadecimal digits.
        digits: what is known of them.
    """

    number: int
    name: str
    unit: Fact[str] | None = None
    limits: Fact[Limits] | None = None
    default: int | None = None
    power_cycle: bool | None = None
    nibbles: bool = False
    digits: tuple[Digit, ...] = field(default=(), hash=False)

    @property
    def label(self) -> str:
        """The name on the drive's display, such as Pn10A."""
        return f"Pn{self.number:03X}"

    @property
    def eeprom_address(self) -> int:
        """Where the value is kept over power-off; endures 10,000 writes."""
        return self.number

    @property
    def ram_address(self) -> int:
        """Where the value in use is."""
        return self.number + RAM_OFFSET


def parameter_at(number: int) -> Parameter:
    """Return the parameter with this number, 0 to FFFH: the listed one, or one without a name.

    The only way to a `Parameter` that is not in the table, so a listed number never comes without what is known of it.

    Raises:
        ValueOutOfRange: the number is outside the parameter area.
    """
    if number not in EEPROM_AREA:
        raise ValueOutOfRange(f"parameter number {number:X}H is not 0 to FFFH", value=number, limit=EEPROM_AREA[-1])
    return _BY_NUMBER.get(number) or Parameter(number, "")


def find_parameter(text: str) -> Parameter | None:
    """Return what a number (Pn100, pn10a, 100, Pn0) or the manual's name stands for, in any case; None for neither."""
    named = next((parameter for parameter in PARAMETERS if parameter.name.lower() == text.lower()), None)
    if named:
        return named
    digits = text.lower().removeprefix("pn")
    if not digits or digits.strip("0123456789abcdef") or len(digits.lstrip("0")) > LONGEST_NUMBER:
        return None
    return parameter_at(int(digits, 16))


def digit_of(word: int, digit: int) -> int:
    """Return one setting of a nibble parameter: `PnXXX.digit`, 0 is the rightmost."""
    return word >> 4 * digit & 0xF


def with_digit(word: int, digit: int, value: int) -> int:
    """Return the word of a nibble parameter with one setting replaced by 0 to 15."""
    return word & ~(0xF << 4 * digit) | (value & 0xF) << 4 * digit


def digit_texts(parameter: Parameter, word: int) -> tuple[str, ...]:
    """Return the digits of a word in plain text, from the right; none for a parameter that is a number."""
    if not parameter.nibbles:
        return ()
    known = {each.place: each for each in parameter.digits}
    texts = []
    for place in range(DIGITS):
        digit, value = known.get(place), digit_of(word, place)
        title = digit.title if digit else "not described"
        meaning = digit.values.get(value) if digit else None
        mark = f" [{digit.confidence.value}]" if digit else ""
        texts.append(f"{parameter.label}.{place} = {value:X}: {title}{f', {meaning}' if meaning else ''}{mark}")
    return tuple(texts)


def unit_number(basic_switch_1: int) -> int:
    """Return the unit number that Pn000 gives the drive at its next power-on."""
    return digit_of(basic_switch_1, UNIT_DIGIT)


_X, _M = Confidence.RELATED, Confidence.RECOLLECTED
_NEEDS_CYCLE, _AT_ONCE = True, False


def _nibbles(number: int, name: str, *digits: Digit) -> Parameter:
    return Parameter(number, name, power_cycle=_NEEDS_CYCLE, nibbles=True, digits=digits)


def _range(lowest: int, highest: int, confidence: Confidence = _M) -> Fact[Limits]:
    return Fact(Limits(lowest, highest), confidence)


_TIME = Fact("0.01 ms", _M)

PN000 = _nibbles(
    0x000,
    "Basic switch 1",
    Digit(0, "rotation direction", {0: "counter-clockwise is forward", 1: "clockwise is forward"}, _X),
    Digit(1, "control mode on related drives", confidence=_X),
    Digit(UNIT_DIGIT, "unit number", confidence=Confidence.STATED),
)
PN001 = _nibbles(
    0x001,
    "Basic switch 2",
    Digit(
        0,
        "stop at servo off or alarm",
        {0: "dynamic brake", 1: "dynamic brake, then released", 2: "coasting"},
    ),
)
# The manual's example 6 states the upper end, related drives the lower one.
PN100 = Parameter(0x100, "Speed loop gain", Fact("Hz", _X), _range(1, 2000, _X), 80, _AT_ONCE)
PN101 = Parameter(
    0x101,
    "Speed loop integral time constant",
    Fact("0.01 ms", _X),
    _range(15, 51200, _X),
    2000,  # of related drives
    _AT_ONCE,
)
PN102 = Parameter(0x102, "Position loop gain", Fact("1/s", _X), _range(1, 2000), 40, _AT_ONCE)
PN103 = Parameter(0x103, "Inertia rate", Fact("%", _X), _range(0, 10000, _X), 300, _AT_ONCE)
PN109 = Parameter(0x109, "Feed forward amount", Fact("%", _M), _range(0, 100), 0, _AT_ONCE)
PN10A = Parameter(0x10A, "Feed forward reference filter", _TIME, _range(0, 6400), 0, _AT_ONCE)
PN110 = _nibbles(
    0x110,
    "Online auto-tuning setting",
    Digit(0, "online auto-tuning", {0: "after power-on only", 1: "always", 2: "never"}),
    Digit(1, "speed feedback compensation", {0: "on", 1: "off"}),
    Digit(2, "friction compensation", {0: "off", 1: "small", 2: "large"}),
)
PN200 = _nibbles(
    0x200,
    "Position control setting 1",
    Digit(
        0,
        "command pulse form",
        {
            0: "pulse and direction, positive",
            1: "forward and reverse pulses, positive",
            2: "phase difference x1",
            3: "phase difference x2",
            4: "phase difference x4",
            5: "pulse and direction, negative",
            6: "forward and reverse pulses, negative",
        },
    ),
    Digit(1, "deviation counter reset", {0: "high level", 1: "rising edge", 2: "low level", 3: "falling edge"}),
    Digit(2, "deviation counter at alarm and servo off", {0: "reset", 1: "kept", 2: "reset at alarm only"}),
    Digit(3, "command pulse filter", {0: "for line drivers", 1: "for open collectors"}),
)
PN202 = Parameter(0x202, "Electronic gear ratio G1 (numerator)", None, _range(1, 65535), 4, _NEEDS_CYCLE)
PN203 = Parameter(0x203, "Electronic gear ratio G2 (denominator)", None, _range(1, 65535), 1, _NEEDS_CYCLE)
PN204 = Parameter(
    0x204,
    "Position reference filter time constant 1 (primary filter)",
    _TIME,
    _range(0, 6400),
    0,
    _AT_ONCE,
)
PN207 = _nibbles(
    0x207,
    "Position control setting 2",
    Digit(0, "position reference filter", {0: "primary (Pn204)", 1: "linear (Pn208)"}),
)
PN208 = Parameter(
    0x208,
    "Position reference filter time constant 2 (linear acceleration/deceleration)",
    _TIME,
    _range(0, 6400),
    0,
    _NEEDS_CYCLE,
)
# Example 2 states that 1000 is accepted.
PN304 = Parameter(0x304, "JOG speed", Fact("r/min", _M), _range(0, 10000), 500, _AT_ONCE)
PN401 = Parameter(0x401, "Torque reference filter time constant", _TIME, _range(0, 65535), 40, _AT_ONCE)
_TORQUE = Fact("%", _X)
# On related drives both limits act at once.
PN402 = Parameter(0x402, "Forward torque limit", _TORQUE, _range(0, 800, _X), 350, _AT_ONCE)
PN403 = Parameter(0x403, "Reverse torque limit", _TORQUE, _range(0, 800, _X), 350, _AT_ONCE)
PN500 = Parameter(0x500, "Position complete width", Fact("command units", _M), _range(0, 250), 3, _AT_ONCE)
PN505 = Parameter(
    0x505,
    "Deviation counter over level",
    Fact("256 command units", _M),
    _range(1, 32767),
    1024,
    _AT_ONCE,
)
PN600 = Parameter(0x600, "Regeneration resistance capacity", Fact("10 W", _M), None, 0, _AT_ONCE)

PARAMETERS: tuple[Parameter, ...] = (
    PN000,
    PN001,
    PN100,
    PN101,
    PN102,
    PN103,
    PN109,
    PN10A,
    PN110,
    PN200,
    PN202,
    PN203,
    PN204,
    PN207,
    PN208,
    PN304,
    PN401,
    PN402,
    PN403,
    PN500,
    PN505,
    PN600,
)
"""In the manual's order."""
_BY_NUMBER = {parameter.number: parameter for parameter in PARAMETERS}
