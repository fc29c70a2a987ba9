"""Motion of one axis, for all commands: load a plan, check the permit, start, bring to rest."""

import asyncio
import math
from collections.abc import Awaitable, Callable

from ldcnd.axis.clock import Clock
from ldcnd.axis.course import ROOM_COUNTS, Pace, Way, pace_of
from ldcnd.axis.events import (
    CommandBegun,
    CommandFailing,
    CommandGoesOn,
    CommandOver,
    LookTaken,
    LoopSwitched,
    MotionStarted,
    StopAcknowledged,
    StopDue,
)
from ldcnd.axis.following import OUTPUT_SCALE, Following, Leeway, Push, RunningProfile, Sighting
from ldcnd.axis.guards import check_does_not_coast
from ldcnd.axis.outcome import why_beside
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import AxisPlans, MotionPlan
from ldcnd.axis.reference import ReferenceKeeper
from ldcnd.axis.rest import SensorEnd, Settling, window_counts
from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import ActiveCommand, Completion, Unsure
from ldcnd.axis.telemetry import AxisTelemetry
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.commands import CommandReply, Verb
from ldcnd.contract.errors import (
    BusError,
    OutcomeUnknown,
    RequestRefused,
)
from ldcnd.contract.samples import AxisState
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import AxisReading, CountsMotion, Gains, QuietDrive, StopMode

BEHIND_SHARE = 1.5
"""Most by which friction holds a shaft behind the end of its profile, as a multiple of its settle window."""
LEAST_FOLLOWED_COUNTS = 30.0
"""Way of a profile behind which a shaft was seen to move, whatever its settle window: friction holds it for less."""
STICKS_SHARE = 8.0
"""Least lag of a shaft that does not stick only, however long it has, as a multiple of the way behind which it was seen
to move."""
FULL_OUTPUT = 255
"""Steps of PWM."""
GOES_ON = "sent because the motion that was to be replaced went on"
LOOK_AGAIN_S = 0.02
"""From one look at a shaft that turns to the next one, seconds."""


class AxisMotion:
    """Motions of one axis, shared by its commands and their procedures.

    Attributes:
        config: of the axis, as it is now.
        plans: its motions before they are loaded.
        window_counts: how far from its target an axis may be that has settled.
        driver: its drive.
        tracker: of its state.
        telemetry: publishes it.
        clock: of the daemon.
        reference: keeps its reference.
    """

    def __init__(
        self,
        config: AxisConfig,
        driver: QuietDrive,
        tracker: AxisTracker,
        telemetry: AxisTelemetry,
        clock: Clock,
        read: Callable[[], Awaitable[AxisReading]],
        reference: ReferenceKeeper,
    ) -> None:
        """Take what an axis consists of.

        Args:
            config: of the axis.
            driver: of its drive.
            tracker: of its state.
            telemetry: publishes it.
            clock: of the daemon.
            read: reads the drive's state at once.
            reference: keeps its reference.
        """
        self.reference = reference
        self.config = config
        self.plans = AxisPlans(config, driver, tracker, self.latest)
        self.window_counts = window_counts(config)
        self.driver = driver
        self.tracker = tracker
        self.telemetry = telemetry
        self.clock = clock
        self._read = read
        self._looked: tuple[AxisReading, float] | None = None  # the last reading out of turn, and when it was asked for
        self._loop = asyncio.get_running_loop()

    def reconfigure(self, config: AxisConfig) -> None:
        """Plan with other limits and speeds from now on."""
        self.config = self.plans.config = config
        self.window_counts = window_counts(config)

    async def check_does_not_coast(self, within_s: float = 0.0) -> None:
        """Refuse to close the loop of a shaft that turns: by a reading of now where its rest or a stop is not proven.

        Args:
            within_s: how long to wait until it stands.

        Raises:
            WrongState: it turns.
            BusError: the line failed.
        """
        until_s = self._loop.time() + within_s
        while not self.tracker.status.enabled and (self.tracker.status.braking or not self.tracker.status.at_rest):
            self.tracker.take(LookTaken(await self.read()))
            if not (self.tracker.status.coasts or self.tracker.status.unseen) or self._loop.time() >= until_s:
                break
            await asyncio.sleep(LOOK_AGAIN_S)
        check_does_not_coast(self.tracker)

    @property
    def scale(self) -> AxisScale:
        """Its coordinates."""
        return self.tracker.status.scale

    async def read(self) -> AxisReading:
        """Read the drive's state at once; `latest` is that reading until a poll brings a newer one.

        Raises:
            BusError: as `ReadingOutOfTurn`.
        """
        asked_at_s = self.clock.now_s()
        reading = await self._read()
        self._looked = reading, asked_at_s
        return reading

    def latest(self) -> AxisReading:
        """Return the latest reading, of a poll or out of turn; see `AxisTracker.latest`."""
        if self._looked and self._looked[1] > self.tracker.read_at_s:
            return self._looked[0]
        return self.tracker.latest()

    @property
    def latest_at_s(self) -> float:
        """When the latest reading was asked for, in loop time."""
        return max(self._looked[1] if self._looked else -math.inf, self.tracker.read_at_s)

    # -- motions -----------------------------------------------------------------------------------------------------

    async def start(
        self,
        permit: Permit,
        state: AxisState,
        completion: Completion,
        *,
        opens_loop: bool = False,
        plan: MotionPlan | None = None,
        sensor_end: SensorEnd | None = None,
        follows: bool = True,
    ) -> None:
        """Start what was loaded, if that is still permitted; the state says so before the drive does.

        Args:
            permit: of the command.
            state: the axis state while it runs.
            completion: what ends it.
            opens_loop: it runs or ends with the position loop open.
            plan: with its target.
            sensor_end: where its analog sensor ends it.
            follows: its shaft is to be seen to move; false for one that may run onto a stop that it stands at.
        """
        permit.ask_to_move()
        in_motion = self.tracker.status.command is not None and not self.tracker.status.at_rest
        self.begin(
            permit.command_id, permit.verb, state, completion, opens_loop=opens_loop, plan=plan, sensor_end=sensor_end
        )
        asked_s = self.clock.now_s()
        loaded = permit.loaded if isinstance(permit.loaded, CountsMotion) else None
        endless = loaded is not None and loaded.target_counts is None
        try:
            await permit.start()
        except (OutcomeUnknown, asyncio.CancelledError) as error:
            why = error.message if isinstance(error, OutcomeUnknown) else "its start was cut short"
            unsure = Unsure(why, from_rest=not in_motion)  # the next readings tell
            self.tracker.take(MotionStarted(permit.command_id, self.clock.now_s(), unsure=unsure, endless=endless))
            raise
        except (BusError, RequestRefused) as error:  # refused when the turn of the packet came: it was not sent
            if in_motion:
                await self._end_what_went_before(permit, error)
            else:
                self.tracker.take(CommandOver(permit.command_id, error.message))
            self.publish_state()
            raise
        # the end of a motion at a velocity is only there for a host that dies
        target_counts = plan.motion.target_counts if plan and state is not AxisState.CONTINUOUS_MOTION else None
        # a procedure goes on from the end of this one
        approached = state is AxisState.DISCRETE_MOTION and completion is Completion.PROFILE
        pace = self.pace(permit) if in_motion else None
        self.tracker.take(
            MotionStarted(
                permit.command_id,
                self.clock.now_s(),
                target_counts=target_counts,
                approached=approached,
                pace=pace,
                following=self._following(permit, loaded, asked_s) if loaded and follows and not in_motion else None,
                profile=(abs(loaded.velocity_counts_per_s), loaded.acceleration_counts_per_s2) if loaded else None,
                onwards=loaded is not None and in_motion and self._turns_towards(loaded),
                endless=endless,
            )
        )

    def _turns_towards(self, motion: CountsMotion) -> bool:
        """Tell whether the shaft turns in the direction in which a motion leads."""
        reading, target = self.tracker.reading, motion.target_counts
        if reading is None:
            return False
        leads = motion.velocity_counts_per_s if target is None else target - reading.position_counts
        return reading.velocity_counts_per_s * leads > 0

    def _following(self, permit: Permit, motion: CountsMotion, asked_s: float) -> Following | None:
        """Return by what the encoder is to be seen to count in the motion that a permit has loaded and sent."""
        reading = self.tracker.reading
        if reading is None:
            return None
        target, begins = motion.target_counts, reading.position_counts
        rate, push = motion.acceleration_counts_per_s2, self._push()
        return Following(
            permit.command_id,
            RunningProfile(
                abs(motion.velocity_counts_per_s),
                rate,
                rate,
                way_counts=math.inf if target is None else abs(target - begins),
                asked_s=asked_s,
            ),
            Leeway(
                max(2 * self.window_counts, LEAST_FOLLOWED_COUNTS),
                held_counts=BEHIND_SHARE * self.window_counts if self._pulls() else math.inf,
                sticks_counts=self._sticks_counts(push),
                push=push,
                # what a search finds makes a reference: of an encoder that does not count it is none
                faults=self.config.settle.unsettled == "fault" or permit.verb is Verb.HOME,
                coasts=self.config.coast_s is not None,
            ),
            # one that is halted soon has its way behind it when it is read first
            Sighting(self.clock.now_s(), 0.0, low=begins, high=begins),
        )

    def _push(self) -> Push | None:
        gains, cycle_s = self.driver.wanted_gains, self.driver.capture_s
        if gains is None or not cycle_s or self.config.settle.stalls:
            return None
        # a machine is made for its configuration; who tunes it may set a limit below its friction
        half = gains.ol / 2 if self._are_configured(gains) else FULL_OUTPUT / 2
        half = OUTPUT_SCALE * half if gains.ol >= half else math.inf
        return Push(gains.kp, gains.ki, OUTPUT_SCALE * gains.il, half, cycle_s)

    def _sticks_counts(self, push: Push | None) -> float:
        """Return how far a shaft may lag that friction holds: until its loop pushes with half of what it may."""
        if self.config.settle.stalls:
            return math.inf
        least = STICKS_SHARE * max(2 * self.window_counts, LEAST_FOLLOWED_COUNTS)
        return max(least, push.half / push.kp) if push and push.kp else least

    @property
    def lags_counts(self) -> float:
        """How far its loop may lag, counts, before its drive opens it; infinite where it has no limit that is known."""
        gains = self.driver.wanted_gains
        return gains.el if gains and gains.el else math.inf

    @property
    def ended_elsewhere(self) -> bool:
        """Whether its latest reading shows that its drive has ended the motion under way before its target."""
        command, status = self.tracker.status.command, self.tracker.status
        if command is None or command.settling is None:
            return False
        if self.latest_at_s < status.effective_from_s:
            return False
        return command.settling.ended_elsewhere(self.latest())

    def ended_beside(self, goal_counts: int, reading: AxisReading) -> str | None:
        """Return why its drive has ended a motion of a procedure beside its goal; None where it has not.

        Args:
            goal_counts: where the motion was to end.
            reading: requested after the motion took effect.
        """
        if not reading.ended_beside(goal_counts, self.lags_counts, self.window_counts + ROOM_COUNTS):
            return None
        return why_beside(self.tracker.status, reading)

    def _pulls(self) -> bool:
        """Tell whether the loop pulls its shaft into the settle window, whatever friction holds it: it integrates.

        Of other gains that a client has set nothing tells; those of the configuration are made for the window.
        """
        gains = self.driver.wanted_gains
        return gains is not None and (bool(gains.ki and gains.il) or self._are_configured(gains))

    def _are_configured(self, gains: Gains) -> bool:
        sets = (self.config.gains, *self.config.gain_sets.values())
        return gains in [each.registers for each in sets if each]

    def pace(self, permit: Permit) -> Pace | None:
        """Return how fast the axis may be whose motion was given the speed of a permit; None if that is not known."""
        reading, deceleration = self.tracker.reading, self.driver.deceleration_counts_per_s2
        if reading is None or not deceleration or math.isinf(permit.most_counts_per_s):
            return None
        return pace_of(permit.most_counts_per_s, deceleration, reading, self.clock.now_s())

    async def _end_what_went_before(self, permit: Permit, error: BusError | RequestRefused) -> None:
        """The motion that was to be replaced still runs, and no command stands for it any more: bring it to rest."""
        if not self.tracker.status.is_at(permit.command_id):
            return  # a stop has taken over
        endless = not self.tracker.status.rest.commanded  # the drive runs what it ran before
        self.tracker.take(MotionStarted(permit.command_id, self.clock.now_s(), endless=endless))
        await self.must_end(permit, error.message, GOES_ON)

    async def must_end(self, permit: Permit, failure: str, how: str) -> None:
        """Bring to rest what runs for a command that has failed.

        Args:
            permit: of the command.
            failure: why it has failed.
            how: what is said of the stop where it is sent again.

        Raises:
            BusError: it is not confirmed, and its line sends it until it is.
        """
        self.tracker.take(CommandFailing(permit.command_id, failure))
        try:
            mode = await self.driver.stop(StopMode.SMOOTH)
        except BusError:
            self.tracker.take(StopDue(StopMode.SMOOTH, how, Verb.HALT))
            raise
        self.comes_to_rest(permit, failure, mode=mode)

    def begin(
        self,
        command_id: str,
        verb: Verb,
        state: AxisState,
        completion: Completion,
        *,
        opens_loop: bool = False,
        plan: MotionPlan | None = None,
        sensor_end: SensorEnd | None = None,
        goes_on: bool = False,
    ) -> None:
        """Say what the axis is about to do; readings count again once it has started, see `MotionStarted`.

        With `goes_on` a command under way is about to do it: one that is over begins nothing.
        """
        target, duration_s = (self.plans.shown(plan.position), plan.duration_s) if plan else (None, None)
        if state is AxisState.CONTINUOUS_MOTION and self.config.modulo:
            target = None  # turns lie between: within one it would be passed again and again
        now_ns = self.clock.now_ns()
        settling, way = self._ends(plan.motion) if plan and completion is Completion.PROFILE else (None, None)
        command = ActiveCommand(
            command_id, verb, now_ns, state, completion, opens_loop, target, duration_s, settling, way, sensor_end
        )
        self.tracker.take(CommandGoesOn(command) if goes_on else CommandBegun(command))
        self.publish_state()

    def _ends(self, motion: CountsMotion) -> tuple[Settling | None, Way | None]:
        """Return when a motion has settled, and the way that leads there; None of one without an end of its own."""
        target, settle, window, gains = (
            motion.target_counts,
            self.config.settle,
            self.window_counts,
            self.driver.wanted_gains,
        )
        if target is None:
            return None, None
        faults = settle.unsettled == "fault"
        settling = Settling(target, window, settle.time_s, settle.timeout_s, faults, self.lags_counts)
        # without a limit its drive follows no way, and nothing says how far beside is too far
        way = Way(target, gains.el + window, motion.acceleration_counts_per_s2) if gains and gains.el else None
        return settling, way

    def stopping(self, command_id: str, verb: Verb) -> None:
        """The drive acknowledged a stop: watch the axis come to rest; only reset leads out of error_stop, though."""
        if self.tracker.status.energised and self.tracker.status.state is not AxisState.ERROR_STOP:
            # PLCopen has DiscreteMotion for an axis that MC_Halt slows down; here whatever comes to rest is stopping
            self.begin(command_id, verb, AxisState.STOPPING, Completion.REST)
            self.tracker.take(MotionStarted(command_id, self.clock.now_s(), endless=False))
        self.stop_acknowledged(StopMode.SMOOTH)

    def comes_to_rest(
        self,
        permit: Permit | ActiveCommand,
        failure: str = "",
        *,
        mode: StopMode = StopMode.SMOOTH,
        state: AxisState = AxisState.STOPPING,
        completion: Completion = Completion.REST,
    ) -> None:
        """The drive acknowledged a stop that a command sent in its course: watch the axis come to rest.

        Without effect once another command has taken over, which sees to the drive by itself.

        Args:
            permit: of the command, or what is known of that.
            failure: why it has failed; empty when it has not.
            mode: how the drive was stopped.
            state: of the axis until it rests.
            completion: what ends the command.
        """
        status = self.tracker.status
        if status.command and not status.is_at(permit.command_id):
            return
        if status.energised:
            self.begin(permit.command_id, permit.verb, state, completion, goes_on=True)
            self.tracker.take(MotionStarted(permit.command_id, self.clock.now_s(), endless=False))
        self.stop_acknowledged(mode)
        if failure:
            self.tracker.take(CommandFailing(permit.command_id, failure))

    def let_go(self, permit: Permit, failure: str) -> None:
        """The drive has opened its loop by itself and acknowledged that its motor is off: its command has failed."""
        self.tracker.take(LoopSwitched(on=False, now_s=self.clock.now_s()))
        self.tracker.take(CommandOver(permit.command_id, failure))
        self.publish_state()

    def stop_acknowledged(self, mode: StopMode) -> None:
        """The drive acknowledged a stop: readings are to show it, and it is sent again if they show that it is not."""
        status = self.tracker.status
        if status.energised or status.driven_open or mode is StopMode.OFF:
            self.tracker.take(StopAcknowledged(mode, self.clock.now_s(), self.driver.deceleration_counts_per_s2))

    async def end(self, permit: Permit | ActiveCommand, failure: str = "") -> None:
        """Bring the motion of a command to rest; an axis that has lost its loop meanwhile is switched off instead.

        Args:
            permit: of the command, or what is known of that.
            failure: why the command has failed; empty when it has not.
        """
        mode = await self.driver.stop(StopMode.SMOOTH if self.tracker.status.enabled else StopMode.OFF)
        self.comes_to_rest(permit, failure, mode=mode)

    def publish_state(self) -> None:
        """Publish the state if it changed, once what is under way waits for the drive or its answer is on its way."""
        self._loop.call_soon(self._publish_now)

    def _publish_now(self) -> None:
        self.reference.woken.set()
        self.telemetry.publish_state(self.tracker.status, self.clock.now_ns())

    def reply(
        self, permit: Permit, plan: MotionPlan | None = None, *, ends: str | None = None, **values: float | None
    ) -> CommandReply:
        """Return the reply to a command: what is planned, and what it says besides or instead, by field."""
        planned: dict[str, float | None] = {}
        if plan:
            planned = {
                "position": self.plans.shown(plan.position),
                "velocity": plan.velocity,
                "acceleration": plan.acceleration,
                "duration_s": plan.duration_s,
            }
        command = self.tracker.status.command
        return CommandReply(
            command_id=permit.command_id,
            axis=self.config.name,
            verb=permit.verb,
            since=command.since_ns if command and command.command_id == permit.command_id else None,
            ends=ends,
            **{**planned, **values},
        )
