"""The unit numbers of the drives of one line, of which no two may be alike: what each has, and what it is to have.

A drive takes the number that its EEPROM holds at its next power-on, which may come to any of them first.
Source: manual 2.2 (6).
"""

from collections.abc import Mapping


class UnitNumbers:
    """One book for all drives of a line."""

    def __init__(self, axes: Mapping[int, str]) -> None:
        """Begin with what is configured.

        Args:
            axes: the axes of the line, by unit number.
        """
        self._axes = axes
        self._stored: dict[str, frozenset[int]] = {}

    def stores(self, axis: str, *numbers: int) -> None:
        """Take note of the number in the EEPROM of an axis: it is one of these."""
        self._stored[axis] = frozenset(numbers)

    def objection(self, axis: str, number: int) -> str:
        """Say why an axis is not to get a number; empty when nothing is against it."""
        if (holder := self._axes.get(number, axis)) != axis:
            return f"unit number {number} is that of axis {holder}"
        # "single-axle mode and transmission is always enabled"
        if number == 0 and len(self._axes) > 1:
            return "a drive with unit number 0 never releases its transmitter, so it must be alone on its line"
        others = (other for other, numbers in self._stored.items() if other != axis and number in numbers)
        return next((f"unit number {number} is that of axis {other} from its next power-on on" for other in others), "")
