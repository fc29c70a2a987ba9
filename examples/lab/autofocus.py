"""Find the focus by the analog input of its drive: `autofocus.py`. Never leaves the axis away from a good place."""

import asyncio

import ldcnd

STEPS = (-0.4, -0.2, -0.1, 0.1, 0.2, 0.4)


async def autofocus(rig: ldcnd.Rig) -> float:
    """Return where the signal is highest, and leave the axis there; after a fault it stays where it was before."""
    async with rig.control("focus", client="autofocus") as focus:
        await focus.power(on=True)
        start = focus.target
        best, signal = start, await _signal(rig)
        for step in STEPS:
            await (await focus.move_absolute(start + step)).done()
            if (seen := await _signal(rig)) > signal:
                best, signal = start + step, seen
        await (await focus.move_absolute(best)).done()
        return best


async def _signal(rig: ldcnd.Rig) -> float:
    async with rig.samples("focus", "adc") as samples:
        async for _, sample in samples:
            if isinstance(sample, ldcnd.AdcSample):
                return float(sample.counts)
    raise RuntimeError("no sample came")


async def main() -> None:
    async with ldcnd.connect() as rig:
        print(f"in focus at {await autofocus(rig):.3f} mm")


if __name__ == "__main__":
    asyncio.run(main())
