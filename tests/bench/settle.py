"""How the axes of the simulated rig settle: `python -m tests.bench.settle`.

Time is virtual, so the figures are those of the simulated drives and of the line, not of this machine.
"""

import argparse
import asyncio
from dataclasses import dataclass

from ldcnd.axis.axis import AxisService
from ldcnd.contract.commands import MoveRelative, Power
from ldcnd.contract.events import ReadOutcome
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.driver import AxisReading
from ldcnd.line.exchange import Timing
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.rig import RunningRig, running_rig

DISTANCES = {"x": 5.0, "y": 5.0, "z": 5.0, "c": 90.0}


@dataclass(frozen=True, slots=True)
class SettleFigures:
    """One move.

    Attributes:
        axis: which.
        distance: in axis units.
        profile_ms: how long its profile takes.
        done_ms: from the end of the profile until the move was done.
        off_then: counts from the target at the first reading behind the profile.
        off: counts from the target when it was done.
    """

    axis: str
    distance: float
    profile_ms: int
    done_ms: int
    off_then: int
    off: int


async def settle_figures(rig: RunningRig, axis: str, distance: float) -> SettleFigures:
    """Move an axis and return how it has settled."""
    service: AxisService = rig.daemon.rig.axes[axis]
    scale = abs(service.config.signed_counts_per_unit)
    await rig.until(axis, lambda state: state.link == "up")
    await rig.client.command(axis, Power(on=True))
    at_end: list[float] = []
    observed = service.readings.accept

    def watch(reading: AxisReading, asked: frozenset[TelemetryItem], timing: Timing) -> None:
        command = service.tracker.status.command
        if (
            command
            and command.settling
            and reading.profile_done
            and service.tracker.status.concerns(timing)
            and not at_end
        ):
            at_end.extend((timing.sent_at_s, command.settling.target_counts - reading.position_counts))
        observed(reading, asked, timing)

    service.readings.accept = watch  # type: ignore[method-assign]
    reply = await rig.client.command(axis, MoveRelative(distance=distance))
    await rig.client.wait_for_end(axis, reply.command_id)
    done_s = asyncio.get_running_loop().time()
    outcome = await rig.client.ask(ReadOutcome(command_id=reply.command_id))
    service.readings.accept = observed  # type: ignore[method-assign]
    return SettleFigures(
        axis=axis,
        distance=distance,
        profile_ms=round((reply.duration_s or 0.0) * 1e3),
        done_ms=round((done_s - at_end[0]) * 1e3),
        off_then=round(at_end[1]),
        off=round((outcome.following_error or 0.0) * scale),
    )


async def table() -> None:
    """Print the figures as they stand in the documentation."""
    async with running_rig() as rig:
        print("| axis | move | profile | off at its end | done later | off then |")
        print("|---|---|---|---|---|---|")
        for axis, distance in DISTANCES.items():
            row, unit = await settle_figures(rig, axis, distance), rig.daemon.rig.axes[axis].config.unit
            print(
                f"| {axis} | {distance:g} {unit} | {row.profile_ms} ms | {row.off_then} counts | {row.done_ms} ms"
                f" | {row.off} counts |"
            )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        runner.run(table())
