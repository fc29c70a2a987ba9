"""What a simulated drive takes from its manual to the letter, and the switches for what else it might do."""

from dataclasses import replace
from itertools import pairwise

import pytest

from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, Packet, StatusFlag, encode_packet
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain, model
from ldcnd.sim.ldcn.power import FaultCondition, Trip
from ldcnd.sim.ldcn.quirks import AnalogEnd, CommandBuffer
from ldcnd.sim.plant import MotorPlant
from tests.support.simulated_axis import ON, ONE, SimulatedAxis
from tests.support.simulated_host import SimulatedHost


def axis_with(name, *, plant=None, closed=True, gains=None, **quirks):
    settings = model(name)[1].model_copy(update=quirks)
    options = {} if gains is None else {"gains": gains}
    return SimulatedAxis(name, plant=plant, settings=settings, closed=closed, **options)


# -- the servo rate divisor (PIC-SERVO manual, 4.5; LS-182AP manual, "Power-up and Reset Conditions") ------------------


@pytest.mark.parametrize("name", ["ls-182ap", "pic-servo-v4", "pic-servo-cmc", "pic-servo-sc"])
def test_before_the_first_set_gain_a_tick_is_one_cycle(name):
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec(name),))))
    host.address_all()
    module = host.chain.modules[0]

    host.send(1, CommandCode.STOP_MOTOR, ON | StopControl.MOTOR_OFF)
    host.send(1, CommandCode.LOAD_TRAJECTORY, 0x88, *([60, 0] if name == "ls-182ap" else [60]))
    host.wait(0.5)
    velocity = host.read(1, module.dialect, 0x04).velocity

    assert velocity == pytest.approx(module.shaft.velocity_counts, abs=1)


# -- motion to an analog target (LS-182AP manual, "Absolute positioning mode") ----------------------------------------


def analog_move(axis, target, acceleration=2000):
    axis.load(
        Trajectory(
            velocity=5 * ONE, acceleration=acceleration, pwm_or_target=target, mode=ProfileMode.VELOCITY, start_now=True
        )
    )


def analog_arrival(end, target):
    """Run past a target at six counts of the converter in each tick; tell whether the motion ended there."""
    plant = MotorPlant(pot_span_counts=(-400, 400))
    axis = axis_with("ls-182ap", plant=plant, analog_end=end)
    analog_move(axis, target, acceleration=ONE // 2)
    axis.wait(1.0)
    axis.drive.catch_up(axis.now_s)
    return axis.drive.stage.latched is None  # else the sensor ran out of its range behind the target


def test_a_motion_to_an_analog_target_stops_at_the_equal_value_only():
    targets = range(690, 702)

    literal = [analog_arrival(model("ls-182ap")[1].analog_end, target) for target in targets]
    lenient = [analog_arrival(AnalogEnd.REACHED_OR_PASSED, target) for target in targets]

    assert all(lenient)
    assert 1 <= sum(literal) <= 4


def test_a_sensor_lost_after_the_arrival_still_trips():
    axis = axis_with("ls-182ap")
    analog_move(axis, 520)
    arrived = axis.finish()

    axis.suffer(FaultCondition.SENSOR_LOST)
    axis.wait(0.01)

    assert arrived.aux & AuxFlag.SERVO_ON
    assert not axis.status().aux & AuxFlag.SERVO_ON
    assert axis.drive.stage.latched is Trip.SENSOR


def test_stop_motor_ends_the_check_of_the_sensor():
    axis = axis_with("ls-182ap")
    analog_move(axis, 520)
    axis.finish()

    axis.stop(ON | StopControl.ABRUPT)
    axis.suffer(FaultCondition.SENSOR_LOST)
    axis.wait(0.01)

    assert axis.status().aux & AuxFlag.SERVO_ON


# -- the command buffer (PIC-SERVO manual, 4.1) -----------------------------------------------------------------------

STOP_GROUP_81 = bytes.fromhex("aa 81 17 09 a1")
STOP_GROUP_82 = bytes.fromhex("aa 82 17 09 a2")
NOP_TO_NOBODY = bytes.fromhex("aa 20 0e 2e")


def two_groups(at_s=0.0001, **quirks):
    """Two modules, each alone in a group without a leader, at 115200; their servo cycles end at a known phase."""
    settings = model("pic-servo-v4")[1].model_copy(update={"phase_s": at_s, **quirks})
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("pic-servo-v4", settings=settings),) * 2)))
    host.address_all()
    for address in (1, 2):
        host.send(address, CommandCode.SET_ADDRESS, address, 0x80 + address)
    host.chain.write(host.now_s, bytes.fromhex("aa 81 1a 0a a5"))
    host.wait(0.01)
    host.chain.write(host.now_s, bytes.fromhex("aa 82 1a 0a a6"))
    host.wait(0.01)
    host.chain.baud = 115_200
    return host


def after_a_cycle(host, margin_s):
    """Let time pass until so long after the end of one of the modules' servo cycles."""
    phase_s = host.chain.modules[0].settings.phase_s
    cycles = (host.now_s - phase_s) // SERVO_CYCLE_S + 1
    host.wait(phase_s + cycles * SERVO_CYCLE_S + margin_s - host.now_s)


ENDS_BEFORE_THE_CYCLE = 0.00002
"""A packet of 0.434 ms that begins so long after the end of a cycle is complete when the next one ends,"""
ENDS_AFTER_THE_CYCLE = 0.0001
"""and this one is not: its command waits nearly a whole cycle."""


def enabled(host):
    return [module.stage.enabled for module in host.chain.modules]


@pytest.mark.parametrize("second", [STOP_GROUP_82, NOP_TO_NOBODY])
def test_a_packet_for_anybody_overwrites_a_group_command_that_waits(second):
    host = two_groups()
    after_a_cycle(host, ENDS_AFTER_THE_CYCLE)

    host.chain.write(host.now_s, STOP_GROUP_81 + second)
    host.wait(0.01)

    assert enabled(host) == [False, second is STOP_GROUP_82]
    assert host.chain.modules[0].overwritten == 1


def test_a_group_command_is_executed_when_its_cycle_ends_before_the_next_address_byte():
    host = two_groups()
    after_a_cycle(host, ENDS_BEFORE_THE_CYCLE)

    host.chain.write(host.now_s, STOP_GROUP_81 + STOP_GROUP_82)
    host.wait(0.01)

    assert enabled(host) == [True, True]


def test_a_group_command_followed_by_a_pause_of_a_cycle_is_executed():
    host = two_groups()
    after_a_cycle(host, ENDS_AFTER_THE_CYCLE)

    host.chain.write(host.now_s, STOP_GROUP_81)
    host.wait(5 * 10 / 115_200 + 0.00052)
    host.chain.write(host.now_s, STOP_GROUP_82)
    host.wait(0.01)

    assert enabled(host) == [True, True]


def test_the_header_alone_overwrites_nothing_and_nulls_do_not_either():
    host = two_groups()
    after_a_cycle(host, ENDS_AFTER_THE_CYCLE)

    host.chain.write(host.now_s, STOP_GROUP_81 + bytes(3) + b"\xaa")
    host.wait(0.01)

    assert enabled(host) == [True, False]


def test_in_the_other_variant_only_a_whole_packet_for_the_same_module_replaces_a_command():
    host = two_groups(command_buffer=CommandBuffer.KEPT)
    after_a_cycle(host, ENDS_AFTER_THE_CYCLE)

    host.chain.write(host.now_s, STOP_GROUP_81 + STOP_GROUP_82)
    host.wait(0.01)

    assert enabled(host) == [True, True]


def test_a_burst_at_19200_overwrites_nothing_because_two_bytes_take_longer_than_a_cycle():
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("pic-servo-v4"),) * 2)))
    host.address_all()

    host.chain.write(
        host.now_s, b"".join(encode_packet(Packet(at, CommandCode.STOP_MOTOR, b"\x05")) for at in (1, 2, 1, 2))
    )
    host.wait(0.05)

    assert [module.overwritten for module in host.chain.modules] == [0, 0]
    assert all(module.loop.servo_on for module in host.chain.modules)


# -- replies and hosts that do not wait for them ----------------------------------------------------------------------


@pytest.mark.parametrize("yields", [True, False])
def test_whether_a_reply_is_dropped_when_the_host_sends_is_a_switch(yields):
    settings = model("ls-182ap")[1].model_copy(update={"yields_to_host": yields, "reply_latency_s": 0.002})
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("ls-182ap", settings=settings),))))
    host.chain.write(0.0, encode_packet(Packet(0, CommandCode.SET_ADDRESS, b"\x01\xff")))
    host.wait(0.0045)

    host.chain.write(host.now_s, bytes(4))
    replies = host.wait(0.03)

    assert len(replies) == (0 if yields else 2)
    assert host.chain.modules[0].address == 1


# -- the encoder (PIC-SERVO manual, 3.2; LS-182AP manual, "Features") -------------------------------------------------


@pytest.mark.parametrize(("name", "most"), [("pic-servo-v4", 256), ("ls-182ap", 1024), ("pic-servo-sc", 1280)])
def test_transitions_faster_than_the_encoder_input_are_lost(name, most):
    plant = MotorPlant(counts_per_rev=200_000, forward_limit_counts=1 << 30)  # up to 5100 counts per cycle
    axis = axis_with(name, plant=plant, closed=False)
    axis.stop(ON | StopControl.MOTOR_OFF)

    axis.drive_pwm(255)
    axis.wait(1.0)
    velocity = axis.status().velocity

    assert axis.drive.shaft.velocity_counts > most + 100
    assert velocity == most
    assert axis.status().position < axis.drive.shaft.position_counts - 10_000


def test_the_encoder_rate_can_be_configured_and_switched_off():
    plant = MotorPlant(counts_per_rev=200_000, forward_limit_counts=1 << 30)
    slow = axis_with("pic-servo-v4", plant=plant, closed=False, encoder_counts_per_s=100_000.0)
    endless = axis_with("pic-servo-v4", plant=plant, closed=False, encoder_counts_per_s=0.0)

    for axis in (slow, endless):
        axis.drive_pwm(255)
        axis.stop(ON | StopControl.MOTOR_OFF)
        axis.drive_pwm(255)
        axis.wait(1.0)

    assert slow.status().velocity == 51
    assert endless.status().velocity > 4000


# -- overload (LS-182AP manual, "Overcurrent Protection") -------------------------------------------------------------

STIFF = Gains(kp=350, kd=3000, ki=0, il=0, ol=250, cl=0, el=16_000, sr=1)


def test_a_stall_becomes_overcurrent_after_the_overload_time():
    axis = axis_with("ls-182ap", gains=STIFF, overload_s=0.65)
    axis.suffer(FaultCondition.STALLED)
    axis.stop(ON | StopControl.HERE, *(2000).to_bytes(4, "little"))

    axis.wait(0.55)
    before = axis.status()
    axis.wait(0.2)
    status = axis.status()

    assert before.aux & AuxFlag.SERVO_ON
    assert axis.drive.stage.latched is Trip.OVERCURRENT
    assert not status.aux & AuxFlag.SERVO_ON
    assert not status.flags & (StatusFlag.POWER_ON | StatusFlag.LIMIT1 | StatusFlag.LIMIT2)


def test_a_current_below_the_peak_never_trips():
    axis = axis_with("ls-182ap", gains=STIFF, peak_current_a=20.0)
    axis.suffer(FaultCondition.STALLED)

    axis.stop(ON | StopControl.HERE, *(2000).to_bytes(4, "little"))
    axis.wait(5.0)

    assert axis.status().aux & AuxFlag.SERVO_ON


def test_a_pause_restarts_the_overload_time():
    axis = axis_with("ls-182ap", gains=STIFF, overload_s=0.65)
    for _ in range(5):
        axis.suffer(FaultCondition.STALLED)
        axis.stop(ON | StopControl.HERE, *(axis.status().position + 1500).to_bytes(4, "little", signed=True))
        axis.wait(0.4)
        axis.recover(FaultCondition.STALLED)
        axis.wait(0.6)

    assert axis.status().aux & AuxFlag.SERVO_ON


def test_the_peak_current_limits_the_torque_of_a_logosol_drive_only():
    weak = axis_with("ls-182ap", closed=False, peak_current_a=1.0, overload_s=60.0)
    pic = axis_with("pic-servo-v4", closed=False, peak_current_a=1.0)
    for axis in (weak, pic):
        axis.stop(ON | StopControl.MOTOR_OFF)
        axis.drive_pwm(255)
        axis.wait(0.03)

    assert weak.status().velocity < pic.status().velocity / 2


# -- Stop Motor (both manuals: "the goal velocity will be set to 0") --------------------------------------------------


@pytest.mark.parametrize(
    ("name", "clears"),
    [
        ("pic-servo-v1", True),
        ("pic-servo-v4", True),
        ("pic-servo-cmc", True),
        ("ls-182ap", True),
        ("pic-servo-sc", False),
    ],
)
def test_a_stop_clears_the_velocity_register_but_not_on_sc(name, clears):
    axis = SimulatedAxis(name)
    axis.move(500)
    axis.finish()

    axis.stop(ON | StopControl.ABRUPT)
    axis.load(Trajectory(position=1500, start_now=True))
    axis.wait(2.0)

    assert (axis.status().position < 510) is clears


def test_the_enable_bit_alone_leaves_the_velocity_register():
    axis = SimulatedAxis("pic-servo-v4")
    axis.move(500)
    axis.finish()

    axis.stop(ON)
    axis.load(Trajectory(position=1500, start_now=True))
    axis.wait(2.0)

    assert axis.status().position > 1490


# -- current limiting (PIC-SERVO manual, 4.3; PIC-SERVO SC data sheet, 4.7) -------------------------------------------


@pytest.mark.parametrize(("name", "step"), [("pic-servo-v4", 1), ("pic-servo-cmc", 1), ("pic-servo-sc", 2)])
def test_current_limiting_takes_its_steps(name, step):
    axis = axis_with(name, gains=replace(STIFF, cl=43))
    axis.suffer(FaultCondition.STALLED)
    axis.stop(ON | StopControl.HERE, *(2000).to_bytes(4, "little"))

    outputs = []
    for _ in range(20):
        axis.drive.loop.run(1)
        outputs.append(axis.drive.loop.pwm)

    falls = {before - after for before, after in pairwise(outputs[5:])}
    assert falls == {step}
    assert axis.status().flags & StatusFlag.OVERCURRENT


@pytest.mark.parametrize(("name", "limits"), [("pic-servo-v4", True), ("pic-servo-sc", False)])
def test_a_current_limit_of_255_is_off_on_sc(name, limits):
    axis = axis_with(name, gains=replace(STIFF, cl=255), sense_counts_per_a=13.0)
    axis.suffer(FaultCondition.STALLED)

    axis.stop(ON | StopControl.HERE, *(2000).to_bytes(4, "little"))
    axis.wait(0.2)

    assert bool(axis.status().flags & StatusFlag.OVERCURRENT) is limits
