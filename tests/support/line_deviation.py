"""How straight lines are, predicted and drawn on the simulator: `python -m tests.support.line_deviation`.

Two LS-182AP of one group go 40 mm and 15 mm. "Commanded" is what the profile generators of the drives draw, "moved" is
what the shafts draw, with what their servos lag behind.
"""

import argparse
import asyncio
import math

from ldcnd.contract.commands import Power
from ldcnd.contract.rig_commands import AxisMove, MoveTogether, PreviewTogether
from ldcnd.contract.samples import LinkState
from ldcnd.drives.ldcn.registers import FRACTION
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.chain_rig import drive, rig_on, simulated_config

TO = {"x": 40.0, "y": 15.0}
SPEEDS = (2.0, 10.0, 20.0)
LOOK_S = 0.002


def off_line(point: tuple[float, ...]) -> float:
    """Return how far a point is from the line, mm."""
    x, y = point
    return abs(TO["y"] * x - TO["x"] * y) / math.hypot(*TO.values())


async def drawn(speed: float, path: str) -> tuple[float | None, float, float, float]:
    """Return the deviation that was predicted, that of the profiles and that of the shafts, mm, and the duration."""
    chain = build_chain(
        ChainSpec(tuple(ModuleSpec(model) for model in ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))
    )
    loop = asyncio.get_running_loop()
    async with rig_on(chain, simulated_config(group=[{"name": "table", "axes": ["x", "y"]}])) as rig:
        for name in TO:
            await rig.until(name, lambda state: state.link is LinkState.UP)
            await rig.client.command(name, Power(on=True))
        moves = tuple(AxisMove(axis=axis, position=to, velocity=speed) for axis, to in TO.items())
        said = await rig.client.ask(PreviewTogether(moves=moves, path=path))
        await rig.client.ask(MoveTogether(moves=moves, path=path))
        commanded = moved = 0.0
        until_s = loop.time() + said.duration_s + 0.5
        while loop.time() < until_s:
            await asyncio.sleep(LOOK_S)
            drives = [drive(chain, address) for address in (1, 2)]
            for each in drives:
                each.catch_up(loop.time())
            profiles = tuple(each.loop.trajectory.position / FRACTION / 1000 for each in drives)
            shafts = tuple(each.shaft.position_counts / 1000 for each in drives)
            commanded, moved = max(commanded, off_line(profiles)), max(moved, off_line(shafts))
    return said.deviation, commanded, moved, said.duration_s


def main() -> None:
    """Print the table."""
    print("| speed of x | path | duration | predicted | commanded | moved |")
    print("|---|---|---|---|---|---|")
    for speed in SPEEDS:
        for path in ("linear", "independent"):
            with asyncio.Runner(loop_factory=JumpingLoop) as runner:
                predicted, commanded, moved, duration_s = runner.run(drawn(speed, path))
            said = "-" if predicted is None else f"{predicted * 1e3:.1f} um"
            print(
                f"| {speed:g} mm/s | {path} | {duration_s:.2f} s | {said} | {commanded * 1e3:.1f} um"
                f" | {moved * 1e3:.1f} um |"
            )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    main()
