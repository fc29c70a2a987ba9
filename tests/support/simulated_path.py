"""Path mode on a simulated axis: what a host sends, in points of counts and cycles."""

from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, StatusPacket
from ldcnd.drives.ldcn.registers import FRACTION, SERVO_CYCLE_S
from ldcnd.drives.ldcn.trajectory import PathPoint, encode_points
from ldcnd.sim.ldcn.chain import model
from ldcnd.sim.plant import MotorPlant
from tests.support.simulated_axis import SimulatedAxis

LONG = 64
"""Servo cycles of a point at the nominal 30 Hz."""


class PathAxis(SimulatedAxis):
    """A PIC-SERVO SC, or another device with path mode, with its loop closed."""

    def __init__(self, name: str = "pic-servo-sc", plant: MotorPlant | None = None, **quirks: object) -> None:
        settings = model(name)[1].model_copy(update=quirks)
        super().__init__(name, plant=plant, settings=settings)

    def add(self, *steps: int, cycles: int = LONG, fast_path: bool = False) -> None:
        """Send path points, in packets as full as possible."""
        for at in range(0, len(steps), 7):
            points = [PathPoint(step, cycles) for step in steps[at : at + 7]]
            self.send(1, CommandCode.ADD_PATH_POINTS, *encode_points(self.drive.dialect, points, fast_path=fast_path))

    def start(self) -> None:
        """Start the path."""
        self.send(1, CommandCode.ADD_PATH_POINTS)

    def look(self) -> StatusPacket:
        """Read position, aux, position error and points left at once, as hosts of path mode do."""
        return self.read(1, self.drive.dialect, 0xC9)

    def walks(self) -> bool:
        """Tell whether a path runs, by its auxiliary bit."""
        aux = self.look().aux
        assert aux is not None
        return bool(aux & AuxFlag.PATH_MODE)

    def cycles(self, count: int) -> None:
        """Let so many servo cycles of the drive pass."""
        self.wait(count * SERVO_CYCLE_S * (1.0 + self.drive.settings.drift_ppm * 1e-6))

    @property
    def commanded(self) -> float:
        """Where the drive wants its motor to be, counts."""
        self.drive.catch_up(self.now_s)
        return self.drive.loop.trajectory.position / FRACTION
