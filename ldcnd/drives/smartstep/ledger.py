"""How often the EEPROM of each drive was written, kept on disk: as a whole it endures 10,000 writes.

A write is entered before it is sent and withdrawn only when the drive has proven that it did not carry it out, so a
crash in between makes the count too high, never too low.
Source: manual 2.2, note on EEPROM.
"""

import json
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from ldcnd import durable
from ldcnd.contract.errors import ConfigError, EepromBudgetSpent, Remedy, step
from ldcnd.log import get_logger
from ldcnd.own_thread import OwnThread

log = get_logger("eeprom")

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

        Of one that is damaged nothing is known: what it counted is not written until somebody says how often it was.
        """
        self._path = path
        self._damaged = path.with_name(f"{path.name}.damaged")
        """Where a damaged one was put when the first count was restarted; it stands for those that were not."""
        self._worker = OwnThread("eeprom ledger")  # one: the file is replaced in the order of the counts
        self._counts: dict[str, dict[str, int]] = {}
        self._lost = f"a damaged one is kept as {self._damaged}" if os.path.lexists(self._damaged) else ""
        try:
            self._counts = durable.read(path, _parse) or {}
        except durable.DamagedFile as error:
            self._lost = str(error)
            log.error("EEPROM writes are not known: EEPROM is not written", reason=self._lost)

    def writes(self, axis: str, parameter: str) -> int:
        """Return how often a parameter was written."""
        return self._counts.get(axis, {}).get(parameter, 0)

    def is_known(self, axis: str) -> bool:
        """Tell whether it is known how often the EEPROM of a drive was written."""
        return not self._lost or axis in self._counts

    def total(self, axis: str) -> int:
        """Return how many writes a drive has taken in all, as far as is known."""
        return sum(self._counts.get(axis, {}).values())

    async def enter(self, axis: str, parameter: str, budget: int) -> None:
        """Count a write that is about to be sent; it is on disk when this returns.

        Raises:
            EepromBudgetSpent: the drive's EEPROM has taken as many writes as it may, or perhaps more.
        """
        if not self.is_known(axis):
            raise EepromBudgetSpent(
                f"axis {axis}: it is not known how often its EEPROM was written: {self._lost}",
                axis=axis,
                limit=budget,
                remedy=Remedy(
                    "restore the file from a backup and start the daemon again, or {} with the writes that you know of",
                    step("restart_eeprom_count"),
                ),
            )
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
        # before it is on disk, so that a write of another axis meanwhile does not lose it
        self._counts[axis] = counts
        text = json.dumps(self._counts, indent=1, sort_keys=True)
        try:
            await self._worker.run(partial(self._write, text), durable.DISK_TIME_S)
        except OSError as error:  # also a TimeoutError, after which the disk may have a higher count
            self._counts[axis] = before
            raise ConfigError(
                f"{self._path}: the EEPROM ledger cannot be written: {error.strerror or 'the disk does not answer'}",
                axis=axis,
                remedy="make state_dir writable",
            ) from error

    def _write(self, text: str) -> None:
        if self._lost and not os.path.lexists(self._damaged) and os.path.lexists(self._path):
            self._path.rename(self._damaged)
        durable.replace(self._path, text)


def _parse(text: str) -> dict[str, dict[str, int]]:
    return {str(axis): _counts(counts) for axis, counts in json.loads(text).items()}


def _counts(document: Mapping[str, object]) -> dict[str, int]:
    counts = {}
    for parameter, writes in document.items():
        # `isinstance` would take true for 1
        if type(writes) is not int or writes < 0:
            raise ValueError(f"{parameter}: {writes!r} is not a number of writes")
        counts[parameter] = writes
    return counts
