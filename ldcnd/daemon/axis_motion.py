"""How any command moves one axis: plan, load, ask whether it is still wanted, start, bring to rest."""

import asyncio
from collections.abc import Awaitable, Callable

from ldcnd.axis_config import AxisConfig
from ldcnd.daemon.axis_telemetry import AxisTelemetry
from ldcnd.daemon.axis_tracker import ActiveCommand, AxisTracker, Completion
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.motion_plan import MotionPlan, MotionPlanner
from ldcnd.daemon.procedure import Turn
from ldcnd.drivers.driver import AxisDriver, AxisReading
from ldcnd.drivers.scaling import Scale
from ldcnd.errors import BusError, OutcomeUnknown, WrongState
from ldcnd.model.axes import AxisState
from ldcnd.model.replies import CommandReply
from ldcnd.model.requests import Verb


class AxisMotion:
    """The ways of one axis to move, shared by its commands and their procedures.

    Attributes:
        reading: the latest; None before the first.
        target_counts: where the last motion was told to end; None when it had no end or something came after it.
    """

    def __init__(
        self,
        config: AxisConfig,
        driver: AxisDriver,
        scale: Scale,
        tracker: AxisTracker,
        telemetry: AxisTelemetry,
        clock: Clock,
        read: Callable[[], Awaitable[AxisReading]],
    ) -> None:
        """Take what an axis consists of.

        Args:
            config: of the axis.
            driver: of its drive.
            scale: between counts and axis units.
            tracker: of its state.
            telemetry: publishes it.
            clock: of the daemon.
            read: reads the drive's state at once.
        """
        self.config = config
        self.driver = driver
        self.scale = scale
        self.tracker = tracker
        self.telemetry = telemetry
        self.clock = clock
        self.read = read
        self.planner = MotionPlanner(config, driver, scale)
        self.reading: AxisReading | None = None
        self.target_counts: int | None = None
        self._loop = asyncio.get_running_loop()

    def reconfigure(self, config: AxisConfig) -> None:
        """Plan with other limits and speeds from now on."""
        self.config = config
        self.planner = MotionPlanner(config, self.driver, self.scale)

    def latest(self) -> AxisReading:
        """Return the latest reading.

        Raises:
            WrongState: there is none yet.
        """
        if self.reading is None:
            raise WrongState(
                f"axis {self.config.name}: its position has not been read yet",
                axis=self.config.name,
                remedy="wait a moment",
            )
        return self.reading

    def counts_of(self, position: float) -> int:
        """Return the count of the drive that a position in axis units stands for."""
        return round(self.scale.to_counts(position) + self.telemetry.origin_counts)

    def plan_to(self, position: float, velocity: float | None, acceleration: float | None) -> MotionPlan:
        """Plan a trapezoid from where the axis is to a position in axis units; raises as `MotionPlanner`."""
        return self.planner.to_position(
            self.tracker.view(),
            position,
            from_counts=self.latest().position_counts,
            origin_counts=self.telemetry.origin_counts,
            velocity=velocity,
            acceleration=acceleration,
        )

    async def start(
        self,
        turn: Turn,
        state: AxisState,
        completion: Completion,
        *,
        opens_loop: bool = False,
        plan: MotionPlan | None = None,
    ) -> None:
        """Start what was loaded, unless a stop has come meanwhile; the state says so before the drive does."""
        turn.still_wanted()
        self.begin(turn.command_id, turn.verb, state, completion, opens_loop=opens_loop, plan=plan)
        try:
            await self.driver.start()
        except OutcomeUnknown:
            self.tracker.started(self.clock.now_s())  # the next readings tell
            raise
        except BusError as error:
            self.tracker.finished(error.message)
            self.publish_state()
            raise
        self.tracker.started(self.clock.now_s())

    def begin(
        self,
        command_id: str,
        verb: Verb,
        state: AxisState,
        completion: Completion,
        *,
        opens_loop: bool = False,
        plan: MotionPlan | None = None,
    ) -> None:
        """Say what the axis is about to do; readings count again once `AxisTracker.started` was called."""
        self.target_counts = None
        target, duration_s = (plan.position, plan.duration_s) if plan else (None, None)
        now_ns = self.clock.now_ns()
        command = ActiveCommand(command_id, verb, now_ns, state, completion, opens_loop, target, duration_s)
        self.tracker.begin(command, float("inf"))
        self.publish_state()

    def stopping(
        self,
        command_id: str,
        verb: Verb,
        state: AxisState = AxisState.STOPPING,
        completion: Completion = Completion.REST,
    ) -> None:
        """The drive acknowledged a stop: watch the axis come to rest; only reset leads out of error_stop, though."""
        if self.tracker.energised and self.tracker.state is not AxisState.ERROR_STOP:
            self.begin(command_id, verb, state, completion)
            self.tracker.started(self.clock.now_s())

    def publish_state(self) -> None:
        """Publish the state if it changed, once what is under way waits for the drive or its answer is on its way."""
        self._loop.call_soon(self._tell_state)

    def _tell_state(self) -> None:
        self.telemetry.state(self.clock.now_ns())

    def reply(self, turn: Turn) -> CommandReply:
        """Return the bare reply to a command."""
        return CommandReply(command_id=turn.command_id, axis=self.config.name, verb=turn.verb)
