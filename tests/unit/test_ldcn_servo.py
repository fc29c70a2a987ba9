"""What a servo drive is told and what is believed of it; exchanges go straight into a simulated drive."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import pytest

from ldcnd.contract.commands import HomeMethod, PinMode
from ldcnd.contract.errors import (
    BadReply,
    CommandAborted,
    DriveFault,
    OutcomeUnknown,
    PacketRejected,
    RegisterUnknown,
    ReplyTimeout,
    WrongState,
)
from ldcnd.drives.driver import AnalogMotion, AxisSpec, CountsMotion, Gains, HomeCapture, PwmOutput, StopMode
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.controls import LimitPins
from ldcnd.drives.ldcn.packet import CommandCode, StatusItem
from ldcnd.drives.ldcn.profiles import LS_182AP, PIC_SERVO_SC, PIC_SERVO_V4, HomingControl
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.line.exchange import Lane
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.plant import MotorPlant
from tests.support.direct_bus import DirectBus, packet_of
from tests.support.simulated_axis import SimulatedAxis

GAINS = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1, deadband=0)
THERE = CountsMotion(20_000, 20_000.0, 100_000.0)
JOG = CountsMotion(None, 5000.0, 100_000.0)
SWITCHES = MotorPlant(reverse_limit_counts=-20_000, forward_limit_counts=20_000)


class Drive:
    """A drive under test: the axis, the bus it speaks on, and the simulated module behind it."""

    def __init__(self, model: str = "ls182ap", profile=LS_182AP, plant=SWITCHES, **spec: object) -> None:
        self.host = SimulatedAxis(model, closed=False, plant=plant)
        self.bus = DirectBus(self.host)
        self.axis = LdcnAxis(AxisSpec("x", 1, "any", GAINS, **spec), profile, self.bus)
        self.axis.forget()

    @property
    def module(self) -> SimulatedDrive:
        self.host.drive.catch_up(self.host.now_s)
        return self.host.drive

    async def power_on(self) -> "Drive":
        await self.axis.power(on=True)
        return self

    async def runs(self) -> bool:
        """Return whether the shaft moves."""
        before = self.module.shaft.position_counts
        self.host.wait(0.5)
        return abs(self.module.shaft.position_counts - before) > 50


async def powered(**spec: object) -> Drive:
    return await Drive(**spec).power_on()


def ignored(bus: DirectBus) -> None:
    """Let the drive acknowledge the next Start Motion without starting."""

    def hold_back() -> None:
        execute, drive = bus.host.drive.execute, bus.host.drive
        drive.execute = lambda _command: setattr(drive, "execute", execute)

    bus.instead[CommandCode.START_MOTION] = hold_back


def rejected(bus: DirectBus, *, executed: bool) -> None:
    """Let the reply to the next Start Motion say that the packet was damaged."""

    def reject() -> None:
        if executed:
            bus.host.send(1, CommandCode.START_MOTION)
        raise PacketRejected("damaged")

    bus.instead[CommandCode.START_MOTION] = reject


# -- what registers hold -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("when", "least"), [("instead", 100_000.0), ("after", 20_000.0)], ids=["unsent", "unanswered"])
async def test_a_smooth_stop_brakes_at_least_as_the_lowest_acceleration_that_the_drive_may_hold(when, least):
    def fail() -> None:
        raise ReplyTimeout("the line failed")

    drive = await powered()
    await drive.axis.load(THERE)
    await drive.axis.start()
    drive.host.wait(3.0)
    getattr(drive.bus, when)[CommandCode.LOAD_TRAJECTORY] = fail

    with pytest.raises(ReplyTimeout):
        await drive.axis.load(replace(THERE, acceleration_counts_per_s2=20_000.0))

    assert drive.axis.deceleration_counts_per_s2 == pytest.approx(least, rel=0.01)


async def test_a_rate_that_was_loaded_and_not_started_may_be_that_of_a_stop_or_not():
    drive = await powered()
    await drive.axis.load(THERE)
    await drive.axis.start()
    drive.host.wait(3.0)

    for rate, least in ((20_000.0, 20_000.0), (50_000.0, 20_000.0), (200_000.0, 20_000.0)):
        await drive.axis.load(replace(THERE, target_counts=10_000, acceleration_counts_per_s2=rate))
        assert drive.axis.deceleration_counts_per_s2 == pytest.approx(least, rel=0.01)
    await drive.axis.start()

    assert drive.axis.deceleration_counts_per_s2 == pytest.approx(200_000.0, rel=0.01)


# -- gains -------------------------------------------------------------------------------------------------------------


async def test_gains_of_a_drive_that_does_not_come_to_rest_are_loaded_by_what_the_refusal_names():
    drive = await powered()
    await drive.axis.load(JOG)
    await drive.axis.start()
    drive.host.wait(0.5)
    status = await drive.bus.execute(commands.read_status(Node(1, LS_182AP), StatusItem.AUX))
    drive.axis.adopted(status, known=False)

    with pytest.raises(RegisterUnknown, match="register sr") as refusal:
        await drive.axis.load(THERE)

    assert [each.verb for each in refusal.value.remedy.steps] == ["halt", "power"]
    await drive.axis.stop(StopMode.OFF)
    drive.host.wait(2.0)
    await drive.axis.power(on=True)
    await drive.axis.load(THERE)
    assert drive.axis.holds_gains


async def test_a_motion_is_loaded_with_no_other_divisor_than_it_is_planned_with():
    drive = await powered()
    drive.axis.wanted_gains = replace(GAINS, sr=2)
    from_rest = drive.axis.quantise(THERE)
    await drive.axis.load(drive.axis.quantise(JOG, in_motion=True), stands_when_done=False)
    await drive.axis.start()
    drive.host.wait(0.5)

    with pytest.raises(WrongState, match="planned for the servo rate divisor 2, and the drive has 1") as refusal:
        await drive.axis.load(from_rest)
    faster = replace(JOG, velocity_counts_per_s=6000.0)
    await drive.axis.load(drive.axis.quantise(faster, in_motion=True), stands_when_done=False)

    assert [each.verb for each in refusal.value.remedy.steps] == ["halt", "power"]
    await drive.axis.stop(StopMode.SMOOTH)
    drive.host.wait(2.0)
    await drive.axis.load(from_rest)
    assert drive.module.loop.gains.sr == 2


# -- starting ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("motion", [THERE, JOG])
async def test_an_acknowledged_start_that_no_status_confirms_is_not_known_to_have_started(motion):
    drive = await powered()
    await drive.axis.load(motion)
    ignored(drive.bus)

    with pytest.raises(OutcomeUnknown, match="no sign"):
        await drive.axis.start()

    assert not await drive.runs()


async def test_a_start_is_sent_once_and_a_running_profile_needs_no_second_look():
    drive = await powered()
    await drive.axis.load(THERE)
    before = len(drive.bus.sent)

    await drive.axis.start()

    assert drive.bus.commands(before) == [CommandCode.START_MOTION]
    assert await drive.runs()


async def test_a_move_so_short_that_it_is_over_with_its_acknowledgement_has_started():
    drive = await powered()
    await drive.axis.load(replace(THERE, target_counts=10))
    ignored(drive.bus)

    await drive.axis.start()  # 10 counts off the target is there, started or not

    await drive.axis.load(replace(THERE, target_counts=17))
    ignored(drive.bus)
    with pytest.raises(OutcomeUnknown):
        await drive.axis.start()


async def test_how_near_the_target_is_counts_from_where_the_axis_is():
    drive = await powered()
    await drive.axis.load(replace(THERE, target_counts=5000))
    await drive.axis.start()
    drive.host.wait(3.0)

    await drive.axis.load(replace(THERE, target_counts=5010))
    ignored(drive.bus)
    await drive.axis.start()

    await drive.axis.load(replace(THERE, target_counts=-5000))
    ignored(drive.bus)
    with pytest.raises(OutcomeUnknown):
        await drive.axis.start()


async def test_a_start_whose_reply_alone_was_damaged_has_started():
    drive = await powered()
    await drive.axis.load(THERE)
    rejected(drive.bus, executed=True)

    await drive.axis.start()

    assert await drive.runs()


@pytest.mark.parametrize(
    ("model", "profile", "runs", "then"),
    [
        ("picservo-sc", PIC_SERVO_SC, THERE, replace(THERE, target_counts=-20_000)),
        ("ls182ap", LS_182AP, JOG, replace(JOG, velocity_counts_per_s=-2000.0)),
    ],
    ids=["another goal", "another velocity"],
)
@pytest.mark.parametrize("executed", [True, False])
async def test_a_damaged_start_of_what_replaces_a_motion_under_way_is_not_known_to_be_one(
    model, profile, runs, then, executed
):
    """That the drive is on its way tells nothing: it was before."""
    drive = await Drive(model, profile, plant=MotorPlant()).power_on()
    await drive.axis.load(runs)
    await drive.axis.start()
    drive.host.wait(0.5)
    await drive.bus.execute(drive.axis.reading(frozenset()))
    await drive.axis.load(then, stands_when_done=False)
    rejected(drive.bus, executed=executed)

    with pytest.raises(OutcomeUnknown, match="damaged on its way, or its reply was"):
        await drive.axis.start()


async def test_a_start_that_was_received_damaged_is_reported_and_not_sent_again():
    drive = await powered()
    await drive.axis.load(THERE)
    rejected(drive.bus, executed=False)
    before = len(drive.bus.sent)

    with pytest.raises(PacketRejected):
        await drive.axis.start()

    assert drive.bus.commands(before).count(CommandCode.START_MOTION) == 1
    assert not await drive.runs()


async def test_a_jog_too_slow_for_the_status_counts_as_started_by_its_acknowledgement_alone():
    drive = await powered()
    slow = CountsMotion(None, 100.0, 100_000.0)
    await drive.axis.load(slow)
    ignored(drive.bus)
    await drive.axis.start()

    await drive.axis.load(slow)
    rejected(drive.bus, executed=False)
    with pytest.raises(OutcomeUnknown, match="damaged on its way, or its reply was"):
        await drive.axis.start()


@pytest.mark.parametrize("motion", [PwmOutput(0.1, 100_000.0), AnalogMotion(900, 100.0, 100_000.0)])
async def test_a_duty_and_an_analog_motion_that_no_status_confirms_are_not_known_to_have_started(motion):
    drive = await powered()
    for stand_in, error in ((ignored, OutcomeUnknown), (partial(rejected, executed=False), PacketRejected)):
        await drive.axis.load(motion)
        stand_in(drive.bus)
        with pytest.raises(error):
            await drive.axis.start()
        assert not await drive.runs()

    await drive.axis.load(motion)
    await drive.axis.start()


async def test_an_analog_motion_that_is_over_with_its_acknowledgement_has_started():
    drive = await powered()
    status = await drive.bus.execute(commands.read_status(Node(1, LS_182AP), StatusItem.ADC))
    await drive.axis.load(AnalogMotion(status.adc, 100.0, 100_000.0))
    ignored(drive.bus)

    await drive.axis.start()


async def test_a_path_or_move_to_where_the_drive_commands_its_shaft_has_started_though_a_load_holds_it_beside():
    drive = await Drive("pic-servo-sc", PIC_SERVO_SC, plant=MotorPlant()).power_on()
    await drive.axis.load(THERE)
    await drive.axis.start()
    drive.host.wait(3.0)
    await drive.axis.load(THERE)
    ignored(drive.bus)
    hold_back = drive.bus.instead[CommandCode.START_MOTION]

    def hold_beside() -> None:
        hold_back()
        drive.module.shaft.position_counts -= 1500.0  # its loop has not pulled it back when it is read

    drive.bus.instead[CommandCode.START_MOTION] = hold_beside
    await drive.axis.start()


@pytest.mark.parametrize("during", [CommandCode.SET_HOMING_MODE, CommandCode.LOAD_TRAJECTORY])
async def test_a_motion_that_is_started_behind_its_limit_switch_is_stopped_at_once(during):
    drive = await powered(limit_stop=True)
    drive.bus.instead[during] = lambda: setattr(drive.module.shaft, "forward_stuck", True)
    await drive.axis.load(THERE)
    before = len(drive.bus.sent)

    await drive.axis.start()
    drive.host.wait(1.0)

    reading = await drive.bus.execute(drive.axis.reading(frozenset()))
    assert drive.bus.sent[before:][2] == (CommandCode.STOP_MOTOR, Lane.STOP)
    assert reading.cut_short == "the drive stopped at the forward limit switch"
    assert not await drive.runs()


@pytest.mark.parametrize("lost", [CommandCode.READ_STATUS, CommandCode.STOP_MOTOR])
async def test_a_motion_that_is_not_known_to_be_stopped_behind_its_limit_switch_may_have_started(lost):
    drive = await powered(limit_stop=True)
    drive.bus.instead[CommandCode.LOAD_TRAJECTORY] = lambda: setattr(drive.module.shaft, "forward_stuck", True)
    await drive.axis.load(THERE)

    async def lose() -> None:
        raise ReplyTimeout("the line failed")

    drive.bus.instead[lost] = lose
    with pytest.raises(OutcomeUnknown, match="behind its limit switch"):
        await drive.axis.start()


async def test_a_motion_away_from_a_limit_switch_runs():
    drive = await powered(limit_stop=True)
    drive.module.shaft.forward_stuck = True
    await drive.axis.load(replace(THERE, target_counts=-10_000))

    await drive.axis.start()

    assert await drive.runs()


# -- stopping and homing -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", StopMode)
async def test_a_stop_goes_out_in_the_lane_of_stops_and_disarms_a_search(mode):
    drive = await powered()
    await drive.axis.load(JOG, home=HomeCapture(HomeMethod.INDEX))
    await drive.axis.start()
    before = len(drive.bus.sent)

    await drive.axis.stop(mode)
    await drive.axis.stop(mode)

    assert drive.bus.sent[before:] == [
        (CommandCode.STOP_MOTOR, Lane.STOP), (CommandCode.SET_HOMING_MODE, Lane.STOP),
        (CommandCode.STOP_MOTOR, Lane.STOP),
    ]  # fmt: skip
    assert drive.module.loop.search is None
    assert drive.module.loop.servo_on is (mode is not StopMode.OFF)


async def test_a_stop_that_comes_while_a_search_is_being_armed_disarms_it():
    drive = await powered()

    async def stopped() -> None:
        await drive.axis.stop(StopMode.SMOOTH)
        raise ReplyTimeout("the line was taken for the stop")

    drive.bus.instead[CommandCode.SET_HOMING_MODE] = stopped
    before = len(drive.bus.sent)
    with pytest.raises(ReplyTimeout):
        await drive.axis.load(JOG, home=HomeCapture(HomeMethod.INDEX))

    assert drive.bus.sent[before:] == [
        (CommandCode.SET_HOMING_MODE, Lane.COMMAND), (CommandCode.STOP_MOTOR, Lane.STOP),
        (CommandCode.SET_HOMING_MODE, Lane.STOP),
    ]  # fmt: skip


async def test_a_stop_disarms_a_search_that_a_poll_of_just_before_did_not_show_yet():
    drive = await powered()
    altered = []

    async def polled() -> None:
        altered.append((await drive.bus.execute(drive.axis.reading(frozenset()))).altered)

    async def stopped() -> None:
        await polled()
        await drive.axis.stop(StopMode.SMOOTH)
        raise ReplyTimeout("the line was taken for the stop")

    drive.bus.instead[CommandCode.SET_HOMING_MODE] = polled
    drive.bus.after[CommandCode.SET_HOMING_MODE] = stopped
    with pytest.raises(ReplyTimeout):
        await drive.axis.load(JOG, home=HomeCapture(HomeMethod.INDEX))

    assert drive.module.loop.search is None
    assert altered == ["", ""]


async def test_a_motion_that_is_no_search_disarms_the_search_before_it():
    drive = await powered()
    await drive.axis.load(JOG, home=HomeCapture(HomeMethod.INDEX))

    await drive.axis.load(THERE)
    before = len(drive.bus.sent)
    await drive.axis.load(THERE)

    assert drive.module.loop.search is None
    assert {*drive.bus.commands(before)} == {CommandCode.LOAD_TRAJECTORY}  # nothing is armed, so nothing is disarmed


async def test_homing_on_a_pin_that_is_an_output_is_refused_before_anything_is_armed():
    drive = await powered(model="picservo-v4", profile=PIC_SERVO_V4)
    await drive.axis.set_outputs(PinMode.HIGH, None)
    before = len(drive.bus.sent)

    with pytest.raises(WrongState, match="is an output"):
        await drive.axis.load(JOG, home=HomeCapture(HomeMethod.REVERSE_LIMIT))

    assert drive.bus.commands(before) == []
    await drive.axis.load(JOG, home=HomeCapture(HomeMethod.FORWARD_LIMIT))


# -- limit switches that stop a motion ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("motion", "armed"),
    [
        (THERE, HomingControl.LIMIT2 | HomingControl.STOP_SMOOTH),
        (replace(THERE, target_counts=-20_000), HomingControl.LIMIT1 | HomingControl.STOP_SMOOTH),
        (JOG, HomingControl.LIMIT2 | HomingControl.STOP_SMOOTH),
        (replace(JOG, velocity_counts_per_s=-5000.0), HomingControl.LIMIT1 | HomingControl.STOP_SMOOTH),
        (PwmOutput(0.1, 100_000.0), HomingControl.LIMIT2 | HomingControl.MOTOR_OFF),
        (PwmOutput(-0.1, 100_000.0), HomingControl.LIMIT1 | HomingControl.MOTOR_OFF),
        (
            AnalogMotion(500, 5000.0, 100_000.0),
            HomingControl.LIMIT1 | HomingControl.LIMIT2 | HomingControl.STOP_SMOOTH,
        ),
    ],
)
async def test_only_the_switches_ahead_of_a_motion_are_armed(motion, armed):
    drive = await powered(limit_stop=True)

    await drive.axis.load(motion)

    assert drive.module.loop.search.control == armed


@pytest.mark.promise("stop-closes-no-loop")
@pytest.mark.parametrize("mode", [StopMode.SMOOTH, StopMode.ABRUPT])
@pytest.mark.parametrize(("model", "profile"), [("ls182ap", LS_182AP), ("picservo-v4", PIC_SERVO_V4)])
async def test_no_stop_closes_a_loop_that_was_not_closed_because_that_was_refused(mode, model, profile):
    drive = await powered(model=model, profile=profile)
    await drive.axis.power(on=False)

    def refused() -> None:
        raise CommandAborted("a stop came before it began")

    drive.bus.instead[CommandCode.STOP_MOTOR] = refused
    with pytest.raises(CommandAborted):
        await drive.axis.power(on=True)
    used = await drive.axis.stop(mode)

    assert used is StopMode.OFF
    assert not drive.module.loop.servo_on


async def test_a_loop_that_shows_that_it_was_closed_after_all_is_not_opened_by_a_stop():
    drive = await powered()
    await drive.axis.power(on=False)

    def lost() -> None:
        raise ReplyTimeout("the reply was lost")

    drive.bus.after[CommandCode.STOP_MOTOR] = lost
    with pytest.raises(ReplyTimeout):
        await drive.axis.power(on=True)
    await drive.bus.execute(drive.axis.reading(frozenset()))
    used = await drive.axis.stop(StopMode.SMOOTH)

    assert used is StopMode.SMOOTH
    assert drive.module.loop.servo_on


@pytest.mark.promise("stop-closes-no-loop")
@pytest.mark.parametrize("mode", [StopMode.SMOOTH, StopMode.ABRUPT])
async def test_no_stop_closes_the_loop_of_a_motor_that_was_switched_off_or_is_being(mode):
    drive = await powered()
    stopped = []

    async def stop() -> None:
        stopped.append(await drive.axis.stop(mode))

    drive.bus.instead[CommandCode.STOP_MOTOR] = stop  # it is on the line when the other one comes
    await drive.axis.stop(StopMode.OFF)
    assert not drive.module.loop.servo_on
    await stop()
    assert not drive.module.loop.servo_on
    assert stopped == [StopMode.OFF] * 2

    await drive.power_on()
    await stop()
    assert drive.module.loop.servo_on
    assert stopped[-1] is mode


@pytest.mark.parametrize(
    ("limit_stop", "guarded", "armed"),
    [
        (True, True, HomingControl.INDEX | HomingControl.LIMIT2 | HomingControl.STOP_SMOOTH),
        (True, False, HomingControl.INDEX | HomingControl.STOP_SMOOTH),
        (None, True, HomingControl.INDEX | HomingControl.STOP_SMOOTH),
    ],
)
async def test_a_guarded_search_ends_at_the_switch_ahead_where_switches_stop(limit_stop, guarded, armed):
    drive = await powered(limit_stop=limit_stop)

    await drive.axis.load(JOG, home=HomeCapture(HomeMethod.INDEX, StopMode.SMOOTH, guarded=guarded))

    assert drive.module.loop.search.control == armed


@pytest.mark.parametrize(
    ("plant", "way"), [(MotorPlant(forward_limit_counts=-1), 1), (MotorPlant(reverse_limit_counts=1), -1)]
)
async def test_a_motion_onto_the_switch_that_the_axis_stands_on_is_refused_and_one_away_from_it_is_not(plant, way):
    drive = await powered(limit_stop=True, plant=plant)

    with pytest.raises(WrongState, match="stands on its"):
        await drive.axis.load(replace(JOG, velocity_counts_per_s=way * 5000.0))

    await drive.axis.load(replace(JOG, velocity_counts_per_s=way * -5000.0))
    await drive.axis.load(AnalogMotion(500, 5000.0, 100_000.0))  # which way it goes is the drive's


# -- power -------------------------------------------------------------------------------------------------------------


async def test_a_loop_that_does_not_close_is_a_fault_with_its_cause():
    drive = Drive()
    drive.host.suffer(FaultCondition.STOP_INPUT)

    with pytest.raises(DriveFault, match="stop"):
        await drive.axis.power(on=True)

    assert not drive.module.loop.servo_on


async def test_a_drive_is_initialised_once_before_its_loop_is_closed():
    drive = await powered()
    first = drive.bus.commands()
    await drive.axis.power(on=False)
    before = len(drive.bus.sent)

    await drive.axis.power(on=True)

    assert first.index(CommandCode.LOAD_TRAJECTORY) < first.index(CommandCode.CLEAR_STICKY_BITS)
    assert CommandCode.LOAD_TRAJECTORY not in drive.bus.commands(before)
    assert drive.bus.commands(before).index(CommandCode.SET_GAIN) == 0  # it may have been reset meanwhile
    assert drive.module.loop.servo_on


async def test_a_set_point_and_a_start_are_never_repeated_by_the_line():
    drive = await powered()
    await drive.axis.load(THERE)
    execute, repeatable = drive.bus.execute, []

    async def noted(exchange, *args, **kwargs):
        repeatable.append(exchange.repeatable)
        return await execute(exchange, *args, **kwargs)

    drive.bus.execute = noted
    await drive.axis.track(100)
    await drive.axis.start()

    assert repeatable[:2] == [False, False]


@pytest.mark.parametrize("absolute", [True, False, None])
async def test_the_sensor_is_read_unless_the_drive_is_known_not_to_position_by_it(absolute) -> None:
    drive = Drive()
    drive.axis.state.known = replace(drive.axis.state.known, absolute=absolute)

    (mask,) = {packet_of(drive.axis.reading(frozenset()).request).data[0]}

    assert bool(mask & StatusItem.ADC) is (absolute is not False)


async def test_outputs_are_set_in_the_drive() -> None:
    drive = Drive(model="picservo-v4", profile=PIC_SERVO_V4)

    await drive.axis.set_outputs(PinMode.HIGH, None)

    assert drive.bus.packets[-1].command is CommandCode.IO_CONTROL
    assert drive.bus.packets[-1].data == bytes([LimitPins.LIMIT1_HIGH | LimitPins.LIMIT2_INPUT])


async def test_readings_ask_for_no_more_than_is_wanted() -> None:
    drive = Drive(model="picservo-v4", profile=PIC_SERVO_V4)
    mask: Mapping[frozenset[str], bytes] = {
        items: drive.axis.reading(frozenset(items)).request for items in (frozenset(), frozenset({"adc"}))
    }

    assert drive.axis.reading(frozenset()) is drive.axis.reading(frozenset())
    assert len(set(mask.values())) == 2


@pytest.mark.parametrize("missing", ["position", "home"])
async def test_half_a_status_proves_nothing(missing):
    drive = await powered()
    execute = drive.bus.execute

    async def half(exchange, lane):
        return replace(await execute(exchange, lane), **{missing: None})

    drive.bus.execute = half
    with pytest.raises(BadReply, match="lacks position or home"):
        await drive.axis.evidence()


@pytest.mark.parametrize("allowed", [True, False])
async def test_a_counter_is_set_back_only_once_what_is_kept_of_it_is_void(allowed):
    drive = await powered()
    drive.module.loop.renumber(2_000_000_000)
    since = len(drive.bus.packets)

    async def void() -> None:
        assert CommandCode.RESET_POSITION not in drive.bus.commands(since)
        if not allowed:
            raise WrongState("the disk cannot forget it")

    drive.axis.about_to_renumber = void
    beyond = CountsMotion(2_300_000_000, 20_000.0, 100_000.0)
    if allowed:
        await drive.axis.load(beyond)
    else:
        with pytest.raises(WrongState, match="cannot forget"):
            await drive.axis.load(beyond)

    assert (CommandCode.RESET_POSITION in drive.bus.commands(since)) is allowed
