"""Numbers that people type, on a command line or in an answer: read by one rule wherever they are typed.

The console's pages read by the same rules in `console/static/parts/number_text.js`; one table of cases tests both.
Files, payloads and programs have numbers of their own syntax (TOML, JSON, Python); a text is none there: `is_number`.
"""

import math
import re
import unicodedata
from dataclasses import dataclass
from decimal import Decimal
from numbers import Real
from typing import TypeGuard

_NUMBER = re.compile(r"([+\-\u2212]?)([0-9]*)(?:([.,])([0-9]*))?(?:[eE]([+\-\u2212]?[0-9]+))?\s*(.*)", re.DOTALL)
_NOT_FINITE = re.compile(r"[+\-\u2212]?\s*(?:inf|nan|∞)", re.IGNORECASE)
_HEXADECIMAL = re.compile(r"[+\-\u2212]?0[xX]")
_SEPARATED = re.compile(r"[.,'\u2019_\s]*[0-9]")
"""What follows a number that has separators of thousands, as somewhere in the world, or is one of several."""
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


def read_number(text: str, unit: str = "") -> float:
    """Return the number that a text stands for.

    A decimal point or comma, a sign (`+`, `-` or the Unicode minus), an exponent and spaces around are taken.

    Args:
        text: what was typed.
        unit: may stand behind the number.

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
    is_other = bool(parts.rest) and not _same_unit(parts.rest, unit)
    if is_other and (several := _about_several(written, parts.rest)):
        raise NotANumber(several)
    if parts.mark == "," and re.fullmatch(r"[1-9][0-9]{0,2}", parts.whole) and len(parts.fraction) == len("000"):
        one, other = f"{parts.sign}{parts.whole}.{parts.fraction}", f"{parts.sign}{digits}"
        raise NotANumber(f"{quote} can mean {one} or {other}: type one of them")
    if is_other and unit:
        raise NotANumber(f"{_quoted(parts.rest)} is not the unit here, which is {unit}: type the value in {unit}")
    if is_other:
        plain = f"{parts.sign}{parts.whole or '0'}{f'.{parts.fraction}' if parts.fraction else ''}"
        power = "" if parts.power == "0" else f"e{parts.power}"
        raise NotANumber(
            f"{_quoted(parts.rest)} is not taken behind the number: type {plain}{power}, in the unit that is named here"
        )
    value = float(f"{parts.sign}{parts.whole or '0'}.{parts.fraction or '0'}e{parts.power}")
    if not math.isfinite(value):
        raise NotANumber(f"{quote} is too large")
    if not value and digits.strip("0"):
        raise NotANumber(f"{quote} is too close to 0")
    return value or 0.0  # no minus zero


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
    if any(each.isdecimal() for each in rest) or rest[0] in ".,+-\u2212":
        return f"{_quoted(written)} is not one number"
    return ""


def _same_unit(written: str, unit: str) -> bool:
    """Compare as units look: a superscript 2 is a 2, and there are two characters for micro."""
    return bool(unit) and unicodedata.normalize("NFKC", written) == unicodedata.normalize("NFKC", unit)


def _quoted(text: str) -> str:
    return f"\u201c{text[:_LONGEST_QUOTE]}\u2026\u201d" if len(text) > _LONGEST_QUOTE else f"\u201c{text}\u201d"
