"""The unit numbers of the drives of one line, of which no two may be alike: what each has, and what it is to have.

A drive takes the number that its EEPROM holds at its next power-on, which may come to any of them first. Handheld units
and other hosts write there, too, so it is read whenever it matters.
Source: manual 2.2 (6).
"""

import asyncio
from collections.abc import Mapping

from ldcnd.contract.errors import LdcndError, WrongState
from ldcnd.drives.smartstep.parameters import PN000, unit_number
from ldcnd.drives.smartstep.words import Words


class UnitNumbers:
    """Those of all drives of a line.

    Attributes:
        changing: held while a drive is given another number, from the question whether that is free on.
    """

    def __init__(self, axes: Mapping[int, str]) -> None:
        """Begin with what is configured.

        Args:
            axes: the axes of the line, by unit number.
        """
        self.changing = asyncio.Lock()
        self._axes = axes
        self._drives: list[Words] = []

    def enter(self, words: Words) -> None:
        """Take a drive of the line."""
        self._drives.append(words)

    async def stored_by_others(self, axis: str) -> dict[str, int]:
        """Read which numbers the EEPROMs of all drives hold but that of an axis.

        Raises:
            WrongState: one cannot be read: it may hold any.
        """
        stored = {}
        for words in self._drives:
            if words.axis != axis:
                try:
                    stored[words.axis] = unit_number(await words.read(PN000.eeprom_address))
                except LdcndError as error:
                    raise WrongState(
                        f"axis {axis}: which unit number axis {words.axis} gets at its next power-on cannot be read:"
                        f" {error.message}",
                        axis=axis,
                        value=words.axis,
                        remedy=f"have axis {words.axis} answer, or take it off the line and out of the configuration",
                    ) from error
        return stored

    def objection(self, axis: str, number: int, stored: Mapping[str, int]) -> str:
        """Say why an axis is not to get a number; empty when nothing is against it.

        Args:
            axis: which.
            number: the number.
            stored: what the EEPROMs of axes hold.
        """
        if (holder := self._axes.get(number, axis)) != axis:
            return f"unit number {number} is that of axis {holder}"
        # "single-axle mode and transmission is always enabled"
        if number == 0 and len(self._axes) > 1:
            return "a drive with unit number 0 never releases its transmitter, so it must be alone on its line"
        others = (other for other, held in stored.items() if other != axis and held == number)
        return next((f"unit number {number} is that of axis {other} from its next power-on on" for other in others), "")
