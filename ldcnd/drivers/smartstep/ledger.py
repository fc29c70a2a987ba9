"""How often the EEPROM of each drive was written, kept on disk: as a whole it endures 10,000 writes.

A write is entered before it is sent and withdrawn only when the drive has proven that it did not carry it out, so a
crash in between makes the count too high, never too low.
Source: manual 2.2, note on EEPROM.
"""

import asyncio
import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ldcnd import durable
from ldcnd.errors import ConfigError, EepromBudgetSpent, Remedy, step

EEPROM_LIFE = 10_000
WARNING_WRITES = 1000
"""From this number of writes on, every further one is remarked upon."""
EARLIER = "earlier"
"""Stands for the parameters of writes that a replaced drive had taken before it was counted here."""


class EepromLedger:
    """The counts of one rig, by axis and parameter; an axis stands for its drive.

    Counts of single parameters say where the writes went; the budget is that of the whole memory (manual 2.2, note).
    """

    def __init__(self, path: Path) -> None:
        """Take up the ledger that is there, or begin an empty one.

        Raises:
            ConfigError: there is one and it cannot be read; it is not replaced, because counts would be lost.
        """
        self._path = path
        self._worker = ThreadPoolExecutor(1, "eeprom ledger")  # one: the file is replaced in the order of the counts
        self._counts = _load(path)

    def writes(self, axis: str, parameter: str) -> int:
        """Return how often a parameter was written."""
        return self._counts.get(axis, {}).get(parameter, 0)

    def total(self, axis: str) -> int:
        """Return how many writes a drive has taken in all."""
        return sum(self._counts.get(axis, {}).values())

    async def enter(self, axis: str, parameter: str, budget: int) -> None:
        """Count a write that is about to be sent; it is on disk when this returns.

        Raises:
            EepromBudgetSpent: the drive's EEPROM has taken as many writes as it may.
        """
        total = self.total(axis)
        if total >= budget:
            raise EepromBudgetSpent(
                f"axis {axis}: its EEPROM was written {total} times, all parameters together; the budget is {budget}",
                axis=axis,
                value=total,
                limit=budget,
                remedy=Remedy(
                    f"write RAM, raise eeprom_budget (the memory endures {EEPROM_LIFE} writes), or, if the drive was"
                    " replaced, {}",
                    step("restart_eeprom_count"),
                ),
            )
        await self._set(axis, parameter, self.writes(axis, parameter) + 1)

    async def withdraw(self, axis: str, parameter: str) -> None:
        """Remove a write that the drive has not carried out."""
        await self._set(axis, parameter, max(0, self.writes(axis, parameter) - 1))

    async def restart(self, axis: str, writes: int) -> int:
        """Restart the count of an axis, because its drive was replaced; return the old drive's count.

        Args:
            axis: whose drive.
            writes: what the drive that is there now has taken already.

        Raises:
            ConfigError: the file cannot be written; the old count stands.
        """
        previous = self.total(axis)
        await self._replace(axis, {EARLIER: writes} if writes else {})
        return previous

    async def _set(self, axis: str, parameter: str, writes: int) -> None:
        await self._replace(axis, {**self._counts.get(axis, {}), parameter: writes})

    async def _replace(self, axis: str, counts: dict[str, int]) -> None:
        before = self._counts.get(axis, {})
        self._counts[axis] = counts
        text = json.dumps(self._counts, indent=1, sort_keys=True)
        loop = asyncio.get_running_loop()
        try:
            await loop.run_in_executor(self._worker, durable.replace, self._path, text)
        except OSError as error:
            self._counts[axis] = before
            raise ConfigError(
                f"{self._path}: the EEPROM ledger cannot be written: {error.strerror}",
                axis=axis,
                remedy="make state_dir writable",
            ) from error


def _load(path: Path) -> dict[str, dict[str, int]]:
    if not path.exists():
        return {}
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return {str(axis): _counts(counts) for axis, counts in document.items()}
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise ConfigError(
            f"{path}: not an EEPROM ledger: {error}", remedy="restore it from a backup, or move it away"
        ) from error


def _counts(document: Mapping[str, object]) -> dict[str, int]:
    counts = {}
    for parameter, writes in document.items():
        if type(writes) is not int or writes < 0:
            raise ValueError(f"{parameter}: {writes!r} is not a number of writes")
        counts[parameter] = writes
    return counts
