"""Scan x in steps and write where it stood: `scan.py FILE`. What goes wrong in mid-scan leaves the rows so far."""

import asyncio
import csv
import sys
from pathlib import Path

import ldcnd


async def scan(rig: ldcnd.Rig, file: Path, start: float = 0.0, stop: float = 90.0, points: int = 10) -> None:
    """Home x, visit the points, and write a row for each."""
    with file.open("w", newline="") as opened:
        rows = csv.writer(opened)
        rows.writerow(("asked", "there"))
        async with rig.control("x", client="scan") as x:
            await x.power(on=True)
            await (await x.home()).done()
            for number in range(points):
                place = start + (stop - start) * number / (points - 1)
                await (await x.move_absolute(place)).done()
                rows.writerow((place, round(x.position.value, 4)))


async def main() -> None:
    async with ldcnd.connect() as rig:
        await scan(rig, Path(sys.argv[1]))


if __name__ == "__main__":
    asyncio.run(main())
