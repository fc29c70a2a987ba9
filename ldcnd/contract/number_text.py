"""Numbers that people type, on a command line or in an answer: read by one rule wherever they are typed.

The console's pages read by the same rules in `console/static/parts/number_text.js`; one table of cases tests both.
Files, payloads and programs have numbers of their own syntax (TOML, JSON, Python); a text is none there: `is_number`.
"""

import math
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from numbers import Real
from typing import TypeGuard

_NUMBER = re.compile(r"([+\-\u2212]?)([0-9]*)(?:([.,])([0-9]*))?(?:[eE]([+\-\u2212]?[0-9]+))?\s*(.*)", re.DOTALL)
_NOT_FINITE = re.compile(r"[+\-\u2212]?\s*(?:inf|nan|∞)", re.IGNORECASE)
_HEXADECIMAL = re.compile(r"[+\-\u2212]?0[xX]")
_SEPARATED = re.compile(r"[.,'\u2019_\s]*[0-9]")
"""What follows a number that has separators of thousands, as somewhere in the world, or is one of several."""
_UNIT = re.compile(r"[^\W\d_]+(?:/[a-z]+[2\u00b2]?)+")
"""A unit that may have a digit, such as mm/s2."""
_WORD = re.compile(r"0x([0-9a-f]{1,4})|([0-9a-f]{1,4})h|([0-9]{1,5})", re.IGNORECASE)
_LONGEST_QUOTE = 40
_LARGEST_WHOLE = 2**53 - 1
"""The largest whole number that a binary64 keeps apart from its neighbours."""
LARGEST_WORD = 0xFFFF


class NotANumber(ValueError):
    """A text is not taken as a number; the message says why."""


@dataclass(frozen=True, slots=True)
class _Parts:
    sign: str
    whole: str
    mark: str
    fraction: str
    power: str
    rest: str


def is_number(value: object) -> TypeGuard[Real | Decimal]:
    """Tell whether a program has given a number: Python's, NumPy's scalars, fractions, decimals; no text, no truth.

    A text that Python reads as a number (`"1_000"`, `" 5 "`) can be another one by the rule for what people type.
    """
    return isinstance(value, Real | Decimal) and not isinstance(value, bool)


def read_number(text: str, *units: str) -> float:
    """Return the number that a text stands for.

    A decimal point or comma, a sign (`+`, `-` or the Unicode minus), an exponent and spaces around are taken.

    Args:
        text: what was typed.
        units: one of them may stand behind the number.

    Raises:
        NotANumber: it is empty, more than one number, not finite, hexadecimal, in another unit, or ambiguous: `1,234`,
            thousands separators.
    """
    written = text.strip()
    if not written:
        raise NotANumber("a number is missing")
    quote = _quoted(written)
    if _NOT_FINITE.match(written):
        raise NotANumber(f"{quote} is not a finite number")
    if _HEXADECIMAL.match(written):
        raise NotANumber(f"{quote} is not a decimal number")
    if any(each.isdecimal() and not each.isascii() for each in written):
        raise NotANumber(f"{quote} has other digits than 0 to 9")
    parts = _parts_of(written)
    digits = parts.whole + parts.fraction
    if not digits:
        raise NotANumber(f"{quote} is not a number")
    is_other = bool(parts.rest) and not any(same_unit(parts.rest, unit) for unit in units)
    if is_other and (several := _about_several(written, parts.rest)):
        raise NotANumber(several)
    if parts.mark == "," and re.fullmatch(r"[1-9][0-9]{0,2}", parts.whole) and len(parts.fraction) == len("000"):
        one, other = f"{parts.sign}{parts.whole}.{parts.fraction}", f"{parts.sign}{digits}"
        raise NotANumber(f"{quote} can mean {one} or {other}: type one of them")
    if is_other:
        raise NotANumber(f"{_quoted(parts.rest)} {_about_unit(parts, units)}")
    value = float(f"{parts.sign}{parts.whole or '0'}.{parts.fraction or '0'}e{parts.power}")
    if not math.isfinite(value):
        raise NotANumber(f"{quote} is too large")
    if not value and digits.strip("0"):
        raise NotANumber(f"{quote} is too close to 0")
    return value or 0.0  # no minus zero


def read_exact(text: str, unit: str = "") -> Fraction:
    """Return the number that a text stands for, as exactly as it was typed; see `read_number`."""
    read_number(text, unit)
    parts = _parts_of(text.strip())
    return Fraction(f"{parts.sign}{parts.whole or '0'}.{parts.fraction or '0'}e{parts.power}")


def behind_number(text: str) -> str:
    """Return what stands behind a number, such as its unit; empty where there is no number."""
    parts = _parts_of(text.strip())
    return parts.rest.strip() if parts.whole + parts.fraction else ""


def _about_unit(parts: _Parts, units: Sequence[str]) -> str:
    """Return why what stands behind a number is not taken there, and what to type."""
    if len(units) > 1:
        return f"is not a unit here: type the value in {', '.join(units[:-1])} or {units[-1]}"
    if any(units):
        return f"is not the unit here, which is {units[0]}: type the value in {units[0]}"
    plain = f"{parts.sign}{parts.whole or '0'}{f'.{parts.fraction}' if parts.fraction else ''}"
    power = "" if parts.power == "0" else f"e{parts.power}"
    return f"is not taken behind the number: type {plain}{power}, in the unit that is named here"


def same_unit(written: str, unit: str) -> bool:
    """Compare as units look: a superscript 2 is a 2, micro is also written u, degrees with their sign, RPM, x g."""
    return bool(unit) and _plain(written) == _plain(unit)


def _plain(unit: str) -> str:
    plain = unicodedata.normalize("NFKC", unit).replace("\u03bc", "u").replace("\u00b0", "deg")
    plain = re.sub("rpm", "rpm", plain, flags=re.IGNORECASE).replace(" ", "")
    return "g" if plain in ("xg", "\u00d7g") else plain  # as the force in a centrifuge is written


def read_whole(text: str, unit: str = "") -> int:
    """Return the whole number that a text stands for; `1e3` and `5.0` are whole.

    Raises:
        NotANumber: as for `read_number`, or it has a fraction.
    """
    value = read_number(text, unit)
    if not value.is_integer() or abs(value) > _LARGEST_WHOLE:
        raise NotANumber(f"{_quoted(text.strip())} is not a whole number")
    return int(value)


def read_word(text: str) -> int:
    """Return a word of 16 bits without sign: decimal, or hexadecimal as `0x0101` or `0101H`.

    Raises:
        NotANumber: it is none.
    """
    found = _WORD.fullmatch(text.strip())
    prefixed, suffixed, decimal = found.groups() if found else (None, None, None)
    word = int(decimal) if decimal else int(prefixed or suffixed or "10000", 16)
    if decimal and decimal.startswith("0") and int(decimal, 16) != word:  # as digits of a parameter are shown
        raise NotANumber(f"{_quoted(decimal)} can mean {word} or 0x{decimal[-4:]}: type one of them")
    if word > LARGEST_WORD:
        raise NotANumber(f"{_quoted(text.strip())} is not 0 to {LARGEST_WORD}, nor 0x0000 to 0xFFFF")
    return word


def _parts_of(written: str) -> _Parts:
    found = _NUMBER.match(written)
    groups = found.groups() if found else ("", "", "", "", "", written)
    sign, whole, mark, fraction, power, rest = (each or "" for each in groups)
    return _Parts(
        sign.replace("\u2212", "-").replace("+", ""), whole, mark, fraction, power.replace("\u2212", "-") or "0", rest
    )


def _about_several(written: str, rest: str) -> str:
    """Return why a text is not one number; empty when one stands before something else."""
    if _SEPARATED.match(rest):
        return f"{_quoted(written)} is more than one number, or has thousands separators: type one number without them"
    if _UNIT.fullmatch(rest):
        return ""
    if any(each.isdecimal() for each in rest) or rest[0] in ".,+-\u2212":
        return f"{_quoted(written)} is not one number"
    return ""


def _quoted(text: str) -> str:
    return f"\u201c{text[:_LONGEST_QUOTE]}\u2026\u201d" if len(text) > _LONGEST_QUOTE else f"\u201c{text}\u201d"
