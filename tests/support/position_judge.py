"""Compares what a daemon publishes of positions with what its simulated machine does."""

from collections.abc import Callable
from dataclasses import dataclass, field

from ldcnd.contract.samples import PositionSample, Quality, TelemetryItem
from ldcnd.sim.ldcn.drive import SimulatedDrive
from tests.support.chain_rig import ChainRig

COUNTS_PER_MM = 1000
FASTEST_MM_S = 50.0


@dataclass
class PositionJudge:
    """Judges positions that are published as good.

    Attributes:
        rig: who publishes.
        axes: whose positions are judged.
        drive: returns the drive of an axis.
        late_s: returns how old a position may be that comes now.
        zero: the place of each axis, in counts of its shaft, that is its position 0 while it has a reference.
        wrong: what was published as good and was not true.
        judged: how many good positions were compared, while the axis had a reference and while it had none.
    """

    rig: ChainRig
    axes: tuple[str, ...]
    drive: Callable[[str], SimulatedDrive]
    late_s: Callable[[PositionSample], float]
    zero: dict[str, float] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    judged: dict[bool, int] = field(default_factory=lambda: {True: 0, False: 0})

    def set_zero(self, axis: str) -> None:
        """Take the place where the shaft is now for position 0."""
        self.zero[axis] = self.drive(axis).shaft.position_counts

    async def watch(self) -> None:
        """Judge every good position until cancelled: by the shaft with a reference, by the drive's counter without."""
        async with self.rig.client.samples("*", TelemetryItem.POSITION) as samples:
            async for axis, sample in samples:
                if isinstance(sample, PositionSample) and sample.quality is Quality.GOOD and axis in self.axes:
                    self._judge(axis, sample)

    def _judge(self, axis: str, sample: PositionSample) -> None:
        drive = self.drive(axis)
        referenced = axis in self.zero and self.rig.daemon.rig.axes[axis].tracker.status.referenced
        said, true = sample.counts / COUNTS_PER_MM, drive.loop.position / COUNTS_PER_MM
        if referenced:
            said, true = sample.value, (drive.shaft.position_counts - self.zero[axis]) / COUNTS_PER_MM
        self.judged[referenced] += 1
        if abs(said - true) > FASTEST_MM_S * self.late_s(sample):
            self.wrong.append(f"{axis}: {said:.3f} is {true:.3f} mm, referenced {referenced}")
