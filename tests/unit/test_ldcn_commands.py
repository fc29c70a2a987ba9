"""Commands as the host builds them: LS-182AP manual, "Command Description"; PIC-SERVO manual, 5.2."""

from dataclasses import replace

import pytest

from ldcnd.contract.errors import BadReply, NotSupported, ValueOutOfRange
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import LeaderlessGroup, Node
from ldcnd.drives.ldcn.controls import LimitPins, StopControl
from ldcnd.drives.ldcn.packet import StatusFlag, StatusItem, StatusPacket
from ldcnd.drives.ldcn.profiles import PROFILES, HomingControl
from ldcnd.drives.ldcn.registers import BaudCodes, actual_baud
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.line.exchange import PacketEffect, ReplyVerdict

LS_182AP = PROFILES["ls-182ap"]
V1, V2, V3, V4 = (PROFILES[f"pic-servo-v{version}"] for version in (1, 2, 3, 4))
SC = PROFILES["pic-servo-sc"]
NODE = Node(1, LS_182AP)
GAINS = Gains(kp=100, kd=1024, ki=0, il=0, ol=255, cl=0, el=2048, sr=1)
QUIET_S = 0.000512


# -- replies ---------------------------------------------------------------------------------------------------------


def test_a_reply_carries_what_the_node_sends_by_default():
    node = Node(1, LS_182AP, StatusItem.POSITION | StatusItem.ADC)

    exchange = commands.start_motion(node)

    assert exchange.reply_bytes == 1 + 4 + 2 + 1
    assert exchange.response_s == QUIET_S


def test_a_status_command_is_answered_with_the_items_it_carries():
    node = Node(1, LS_182AP, StatusItem.AUX)

    for exchange in (
        commands.read_status(node, StatusItem.POSITION),
        commands.define_status(node, StatusItem.POSITION),
    ):
        assert exchange.reply_bytes == 6
        assert exchange.decode(bytes.fromhex("09 00 28 00 00 31")) == StatusPacket(StatusFlag(9), position=0x2800)


def test_the_reply_is_checked_and_decoded_as_a_status_packet():
    exchange = commands.no_operation(NODE)

    assert exchange.check(b"\x0b\x0b") is ReplyVerdict.REJECTED
    with pytest.raises(BadReply):
        exchange.decode(b"\x09\x08")


def test_a_group_without_a_leader_stays_silent_for_a_servo_cycle():
    exchange = commands.start_motion(LeaderlessGroup(0xFF))

    assert exchange.request == bytes.fromhex("aa ff 05 04")
    assert (exchange.reply_bytes, exchange.response_s, exchange.node) == (0, commands.group_quiet_s(), 0xFF)
    assert exchange.decode(b"") is None


def test_a_group_with_a_leader_answers_in_the_leaders_layout():
    exchange = commands.save_home(Node(0x81, LS_182AP, StatusItem.ADC))

    assert exchange.request == bytes.fromhex("aa 81 0c 8d")
    assert exchange.reply_bytes == 4


def test_hard_reset_is_never_answered():
    assert commands.hard_reset(NODE).reply_bytes == 0
    assert commands.hard_reset(LeaderlessGroup(0xFF)).request == bytes.fromhex("aa ff 0f 0e")


@pytest.mark.parametrize("address", [0x7F, 0x100])
def test_a_group_has_bit_7_in_its_address(address):
    with pytest.raises(ValueOutOfRange):
        LeaderlessGroup(address)


@pytest.mark.parametrize("address", [-1, 0x100])
def test_a_node_address_is_a_byte(address):
    with pytest.raises(ValueOutOfRange):
        Node(address, LS_182AP)


# -- what may be sent again ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("to", [NODE, LeaderlessGroup(0x81, LS_182AP)])
def test_a_packet_says_what_it_does(to):
    standing = Trajectory(velocity=0, acceleration=1, mode=ProfileMode.VELOCITY)
    amplifier = StopControl.AMP_ENABLE
    told = {
        PacketEffect.READS: (commands.read_status(to, StatusItem.AUX), commands.no_operation(to)),
        PacketEffect.RELIEVES: (
            commands.stop_motor(to, StopControl.MOTOR_OFF),
            commands.stop_motor(to, amplifier | StopControl.SMOOTH),
            commands.stop_motor(to, amplifier | StopControl.ABRUPT),
        ),
        PacketEffect.ARRANGES: (
            commands.hard_reset(to),
            commands.set_address(to, 1, 0x81),
            commands.define_status(to, StatusItem(0)),
        ),
        PacketEffect.CHANGES: (
            commands.start_motion(to),
            commands.load_trajectory(to, standing),
            commands.set_gain(to, GAINS),
            commands.close_loop(to),
            commands.stop_motor(to, amplifier),
            commands.stop_motor(to, amplifier | StopControl.HERE, 5),
            commands.clear_sticky_bits(to),
            commands.reset_position(to),
            commands.set_homing(to, HomingControl(0)),
            commands.save_home(to),
            commands.unanswered(0xFF, b"", QUIET_S, repeatable=False),
        ),
    }

    assert {effect: {exchange.effect for exchange in exchanges} for effect, exchanges in told.items()} == {
        effect: {effect} for effect in told
    }


def test_what_could_act_twice_is_never_repeated():
    exchanges = (
        commands.reset_position(NODE),
        commands.set_address(NODE, 2, 0xFF),
        commands.load_trajectory(NODE, Trajectory(position=5, start_now=True)),
        commands.start_motion(NODE),
        commands.save_home(NODE),
        commands.set_baud(LeaderlessGroup(0xFF), 115_200),
        commands.hard_reset(NODE),
    )

    assert not any(exchange.repeatable for exchange in exchanges)


def test_what_only_sets_or_reads_may_be_repeated():
    exchanges = (
        commands.define_status(NODE, StatusItem.AUX),
        commands.read_status(NODE, StatusItem.AUX),
        commands.load_trajectory(NODE, Trajectory(position=5)),
        commands.set_gain(NODE, GAINS),
        commands.stop_motor(NODE, StopControl.SMOOTH),
        commands.stop_motor(NODE, StopControl.HERE, 100),
        commands.set_homing(NODE, HomingControl.INDEX),
        commands.clear_sticky_bits(NODE),
        commands.no_operation(NODE),
        commands.io_control(Node(1, V4), LimitPins.LIMIT1_HIGH),
    )

    assert all(exchange.repeatable for exchange in exchanges)


# -- addresses -------------------------------------------------------------------------------------------------------


def test_a_group_leader_is_marked_by_bit_7_of_its_group():
    exchange = commands.set_address(NODE, 1, 0x81, leader=True)

    assert exchange.request == bytes.fromhex("aa 01 21 01 01 24")


@pytest.mark.parametrize(("address", "group"), [(0, 0xFF), (128, 0xFF), (1, 0x7F), (1, 0x100)])
def test_addresses_outside_their_ranges_are_refused(address, group):
    with pytest.raises(ValueOutOfRange):
        commands.set_address(NODE, address, group)


# -- trajectory ------------------------------------------------------------------------------------------------------


def test_the_pwm_field_has_the_width_of_the_device():
    trajectory = Trajectory(pwm_or_target=5, servo=False)

    assert commands.load_trajectory(NODE, trajectory).request[2:-1] == bytes.fromhex("34 08 05 00")
    assert commands.load_trajectory(Node(1, V4), trajectory).request[2:-1] == bytes.fromhex("24 08 05")


@pytest.mark.parametrize(
    ("field", "value", "limit"),
    [
        ("position", 0x8000_0000, 0x7FFF_FFFF),
        ("position", -0x8000_0000, -0x7FFF_FFFF),
        ("velocity", -1, 0),
        ("velocity", 0x8000_0000, 0x7FFF_FFFF),
        ("acceleration", -1, 0),
        ("acceleration", 0x8000_0000, 0x7FFF_FFFF),
        ("pwm_or_target", -1, 0),
        ("pwm_or_target", 1024, 1023),
    ],
)
def test_a_trajectory_register_refuses_what_it_cannot_hold(field, value, limit):
    with pytest.raises(ValueOutOfRange) as refusal:
        commands.load_trajectory(NODE, replace(Trajectory(mode=ProfileMode.VELOCITY), **{field: value}))

    assert (refusal.value.value, refusal.value.limit) == (value, limit)


def test_a_pwm_value_is_a_byte_even_in_a_wide_field():
    with pytest.raises(ValueOutOfRange) as refusal:
        commands.load_trajectory(NODE, Trajectory(pwm_or_target=256, servo=False))

    assert refusal.value.limit == 255


def test_an_analog_target_needs_absolute_positioning():
    target = Trajectory(pwm_or_target=10, mode=ProfileMode.VELOCITY)
    commands.load_trajectory(Node(1, PROFILES["ls-173ap"]), target)

    with pytest.raises(NotSupported):
        commands.load_trajectory(Node(1, V4), target)


def test_a_trapezoid_has_no_reverse_bit():
    with pytest.raises(NotSupported):
        commands.load_trajectory(NODE, Trajectory(position=5, reverse=True))


def test_a_group_needs_a_profile_for_what_differs_between_dialects():
    with pytest.raises(NotSupported):
        commands.load_trajectory(LeaderlessGroup(0xFF), Trajectory(position=1))

    assert commands.load_trajectory(LeaderlessGroup(0xFF, V4), Trajectory(position=1)).reply_bytes == 0


# -- gains -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("profile", "nibble"), [(V1, 0xD), (V3, 0xD), (V4, 0xE), (LS_182AP, 0xE), (SC, 0xF)])
def test_set_gain_has_as_many_bytes_as_the_device_takes(profile, nibble):
    request = commands.set_gain(Node(1, profile), GAINS).request

    assert request[2] == nibble << 4 | 6
    assert len(request) == 4 + nibble


@pytest.mark.parametrize(
    ("field", "value", "limit"),
    [
        ("kp", 0x8000, 0x7FFF),
        ("kp", -1, 0),
        ("kd", 0x8000, 0x7FFF),
        ("ki", 0x8000, 0x7FFF),
        ("il", 0x8000, 0x7FFF),
        ("ol", 0x100, 0xFF),
        ("cl", 1, 0),
        ("el", 0x4000, 0x3FFF),
        ("sr", 0, 1),
        ("sr", 0x100, 0xFF),
        ("deadband", 0x100, 0xFF),
    ],
)
def test_a_gain_register_refuses_what_it_cannot_hold(field, value, limit):
    with pytest.raises(ValueOutOfRange) as refusal:
        commands.set_gain(NODE, replace(GAINS, **{field: value}))

    assert (refusal.value.value, refusal.value.limit) == (value, limit)


def test_the_current_limit_exists_on_pic_servo():
    assert commands.set_gain(Node(1, V4), replace(GAINS, cl=53)).request[12] == 53


def test_registers_that_a_device_lacks_must_keep_their_defaults():
    with pytest.raises(NotSupported):
        commands.set_gain(Node(1, V3), replace(GAINS, deadband=3))
    with pytest.raises(NotSupported):
        commands.set_gain(NODE, replace(GAINS, step_multiplier=5))


# -- stopping and homing ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("control", "position", "data"),
    [
        (StopControl.AMP_ENABLE, None, "17 01"),
        (StopControl.AMP_ENABLE | StopControl.MOTOR_OFF, None, "17 03"),
        (StopControl.AMP_ENABLE | StopControl.ABRUPT, None, "17 05"),
        (StopControl.AMP_ENABLE | StopControl.SMOOTH, None, "17 09"),
        (StopControl.AMP_ENABLE | StopControl.HERE, -2, "57 11 fe ff ff ff"),
        (StopControl.AMP_ENABLE | StopControl.LOCK_DISABLE, None, "17 81"),
        (StopControl(0), None, "17 00"),
    ],
)
def test_each_way_to_stop(control, position, data):
    assert commands.stop_motor(NODE, control, position).request[2:-1] == bytes.fromhex(data)


@pytest.mark.parametrize(
    ("control", "position"),
    [
        (StopControl.ABRUPT | StopControl.SMOOTH, None),
        (StopControl.MOTOR_OFF | StopControl.HERE, 5),
        (StopControl.HERE, None),
        (StopControl.SMOOTH, 5),
        (StopControl.HERE, 0x8000_0000),
        (StopControl(0x40), None),
    ],
)
def test_a_contradictory_stop_is_refused(control, position):
    with pytest.raises(ValueOutOfRange):
        commands.stop_motor(NODE, control, position)


def test_only_the_cmc_has_advanced_features_to_turn_on():
    control = StopControl.AMP_ENABLE | StopControl.ABRUPT | StopControl.ADVANCED

    assert commands.stop_motor(Node(1, PROFILES["pic-servo-cmc"]), control).request == bytes.fromhex("aa 01 17 25 3d")
    for profile in (LS_182AP, V4, SC):
        with pytest.raises(NotSupported):
            commands.stop_motor(Node(1, profile), control)


def test_version_1_cannot_stop_here_and_others_have_no_lock():
    with pytest.raises(NotSupported):
        commands.stop_motor(Node(1, V1), StopControl.HERE, 5)
    with pytest.raises(NotSupported):
        commands.stop_motor(Node(1, V4), StopControl.LOCK_DISABLE)


def test_everybody_can_be_stopped_at_once_whatever_they_are():
    assert commands.stop_motor(LeaderlessGroup(0xFF), StopControl.SMOOTH).request == bytes.fromhex("aa ff 17 08 1e")


def test_homing_combines_sources_and_one_stop():
    control = HomingControl.LIMIT1 | HomingControl.LIMIT2 | HomingControl.INDEX | HomingControl.STOP_ABRUPT

    assert commands.set_homing(NODE, control).request[3] == 0x1B
    assert commands.set_homing(NODE, HomingControl(0)).request == bytes.fromhex("aa 01 19 00 1a")


@pytest.mark.parametrize(
    "control",
    [HomingControl.INDEX | HomingControl.STOP_ABRUPT | HomingControl.STOP_SMOOTH, HomingControl.STOP_SMOOTH],
)
def test_a_contradictory_homing_is_refused(control):
    with pytest.raises(ValueOutOfRange):
        commands.set_homing(NODE, control)


@pytest.mark.parametrize(
    ("profile", "control"),
    [
        (LS_182AP, HomingControl.CURRENT),
        (PROFILES["ls-173ap"], HomingControl.LIMIT1),
        (V2, HomingControl.INDEX | HomingControl.STOP_SMOOTH),
    ],
)
def test_homing_that_a_device_cannot_do_is_refused(profile, control):
    with pytest.raises(NotSupported):
        commands.set_homing(Node(1, profile), control)


# -- what only some devices have -------------------------------------------------------------------------------------


def test_command_8_sets_limit_pins_on_version_4_alone():
    pins = LimitPins.LIMIT1_HIGH | LimitPins.LIMIT2_INPUT

    assert commands.io_control(Node(1, V4), pins).request[2:-1] == b"\x18\x09"
    for profile in (LS_182AP, V3, SC):
        with pytest.raises(NotSupported):
            commands.io_control(Node(1, profile), pins)


def test_a_module_that_is_only_identified_is_never_moved():
    module = Node(3, PROFILES["pic-io"])

    assert commands.read_status(module, StatusItem.IDENTITY).reply_bytes == 4
    assert commands.no_operation(module).reply_bytes == 2
    for build in (
        lambda: commands.start_motion(module),
        lambda: commands.load_trajectory(module, Trajectory(position=1)),
        lambda: commands.stop_motor(module, StopControl.AMP_ENABLE),
        lambda: commands.set_gain(module, GAINS),
        lambda: commands.read_status(module, StatusItem.POSITION),
        lambda: commands.define_status(module, StatusItem.AUX),
    ):
        with pytest.raises(NotSupported):
            build()


# -- baud rate -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("baud", "code"), [(9600, 0x81), (19_200, 0x3F), (57_600, 0x14), (115_200, 0x0A)])
def test_the_baud_codes_of_the_manuals(baud, code):
    exchange = commands.set_baud(LeaderlessGroup(0xFF), baud)

    assert exchange.request[3] == code
    assert actual_baud(code) == pytest.approx(baud, rel=0.034)


def test_the_slower_code_for_57600_is_selectable():
    assert commands.set_baud(LeaderlessGroup(0xFF), 57_600, BaudCodes.ALTERNATE).request[3] == 21
    assert actual_baud(20) / 57_600 == pytest.approx(1.033, abs=0.001)
    assert actual_baud(21) / 57_600 == pytest.approx(0.986, abs=0.001)


def test_only_sc_reaches_230400():
    assert commands.set_baud(LeaderlessGroup(0xFF, SC), 230_400).request[3] == 5
    for group in (LeaderlessGroup(0xFF), LeaderlessGroup(0xFF, V4)):
        with pytest.raises(ValueOutOfRange) as refusal:
            commands.set_baud(group, 230_400)
        assert refusal.value.nearest == 125_000
