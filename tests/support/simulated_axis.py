"""One simulated servo drive at address 1 and what a host does with it, in virtual time without an event loop."""

from collections.abc import Callable

from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import CommandCode, StatusFlag, StatusPacket
from ldcnd.drives.ldcn.profiles import HomingControl
from ldcnd.drives.ldcn.registers import encode_gains
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory, encode_trajectory
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.plant import MotorPlant
from tests.support.simulated_host import SimulatedHost

UTILITY_GAINS = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1)
SOFT_GAINS = Gains(kp=100, kd=1000, ki=50, il=200, ol=250, cl=0, el=4000, sr=1)
ONE = 1 << 16
"""One count per tick, as programmed velocity."""
ON = StopControl.AMP_ENABLE


class SimulatedAxis(SimulatedHost):
    """A host with a single drive, its gains loaded and, unless told otherwise, its loop closed."""

    def __init__(
        self,
        name: str = "ls182ap",
        *,
        plant: MotorPlant | None = None,
        settings: ModuleSettings | None = None,
        gains: Gains = UTILITY_GAINS,
        closed: bool = True,
    ) -> None:
        super().__init__(build_chain(ChainSpec((ModuleSpec(name, plant or MotorPlant(), settings),))))
        drive = self.chain.modules[0]
        assert isinstance(drive, SimulatedDrive)
        self.drive = drive
        self.profile = drive.profile
        self.address_all()
        self.send(1, CommandCode.SET_GAIN, *encode_gains(self.profile, gains))
        if closed:
            self.stop(ON | StopControl.ABRUPT)
            self.clear()

    def stop(self, control: StopControl, *position: int) -> None:
        """Send Stop Motor."""
        self.send(1, CommandCode.STOP_MOTOR, control, *position)

    def clear(self) -> None:
        """Send Clear Sticky Bits."""
        self.send(1, CommandCode.CLEAR_STICKY_BITS)

    def load(self, trajectory: Trajectory) -> None:
        """Send Load Trajectory."""
        self.send(1, CommandCode.LOAD_TRAJECTORY, *encode_trajectory(self.profile, trajectory))

    def move(self, position: int, velocity: int = 5 * ONE, acceleration: int = 200) -> None:
        """Start a trapezoidal move."""
        self.load(Trajectory(position=position, velocity=velocity, acceleration=acceleration, start_now=True))

    def jog(self, velocity: int, acceleration: int = 2000) -> None:
        """Start velocity mode; the sign is the direction."""
        self.load(
            Trajectory(
                velocity=abs(velocity),
                acceleration=acceleration,
                mode=ProfileMode.VELOCITY,
                reverse=velocity < 0,
                start_now=True,
            )
        )

    def drive_pwm(self, pwm: int) -> None:
        """Start PWM mode; the sign is the direction."""
        self.load(Trajectory(pwm_or_target=abs(pwm), servo=False, reverse=pwm < 0, start_now=True))

    def arm(self, control: HomingControl) -> None:
        """Send Set Homing Mode."""
        self.send(1, CommandCode.SET_HOMING_MODE, control)

    def status(self) -> StatusPacket:
        """Read everything."""
        return self.read(1, self.profile)

    def pwm(self) -> int:
        """Look at the output without asking the drive."""
        self.drive.catch_up(self.now_s)
        return self.drive.loop.pwm

    def suffer(self, condition: FaultCondition) -> None:
        """Let something go wrong around the drive."""
        self.drive.set_condition(condition, present=True, at_s=self.now_s)

    def recover(self, condition: FaultCondition) -> None:
        """Let it be right again."""
        self.drive.set_condition(condition, present=False, at_s=self.now_s)

    def wait_for(self, condition: Callable[[StatusPacket], object], most_s: float = 20.0) -> StatusPacket:
        """Poll until the status fulfils the condition; return it."""
        ends_s = self.now_s + most_s
        while not condition(status := self.status()):
            assert self.now_s < ends_s, status
        return status

    def finish(self) -> StatusPacket:
        """Poll until the move is done."""
        return self.wait_for(lambda status: status.flags & StatusFlag.MOVE_DONE)
