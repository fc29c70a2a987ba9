"""What all simulated modules share: the chain, addresses, packets, rate, reset."""

import pytest

from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.ldcn.packet import CommandCode, Packet, StatusFlag, StatusItem, encode_packet
from ldcnd.drives.ldcn.profiles import LS_182AP, PIC_SERVO_V1, PIC_SERVO_V4
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S
from ldcnd.sim.ldcn.chain import MODELS, ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.quirks import CommandBuffer, ModuleSettings
from tests.support.simulated_host import SimulatedHost, little

IDENTITY = StatusItem.IDENTITY
NULLS = bytes(16)


def host_on(*names, addressed=True, settings=None, **options):
    modules = tuple(ModuleSpec(name, settings=settings) for name in names)
    host = SimulatedHost(build_chain(ChainSpec(modules, **options)))
    if addressed:
        host.address_all()
    return host


# -- addresses ---------------------------------------------------------------------------------------------------------


def test_daisy_chain_is_addressed_in_order_and_then_silent():
    host = host_on("ls182ap", "picservo-v4", "ls173ap", addressed=False)

    replies = [host.send(0, CommandCode.SET_ADDRESS, address, 0xFF) for address in (1, 2, 3, 4)]

    assert [len(reply) for reply in replies] == [2, 2, 2, 0]
    assert [module.address for module in host.chain.modules] == [1, 2, 3]


def test_modules_tell_their_identity():
    names = tuple(MODELS)
    host = host_on(*names)

    identities = []
    for address in range(1, len(names) + 1):
        reply = host.send(address, CommandCode.READ_STATUS, IDENTITY)
        assert len(reply) == 4
        identities.append((reply[1], reply[2]))

    assert identities == [
        (90, 20),
        (90, 1),
        (0, 1),
        (0, 2),
        (0, 3),
        (0, 4),
        (0, 5),
        (0, 10),
        (2, 1),
        (3, 1),
        (0, 20),
        (2, 52),
    ]


def test_second_set_address_renames_a_module():
    host = host_on("ls182ap", "ls182ap")

    host.send(1, CommandCode.SET_ADDRESS, 7, 0xFF)

    assert host.send(1, CommandCode.NO_OPERATION) == b""
    assert len(host.send(7, CommandCode.NO_OPERATION)) == 2


def test_absent_addresses_stay_silent():
    host = host_on("ls182ap", "ls182ap")

    answering = [address for address in range(33) if host.send(address, CommandCode.NO_OPERATION)]

    assert answering == [1, 2]


def test_group_command_reaches_its_members_and_only_the_leader_answers():
    host = host_on("ls182ap", "ls182ap", "ls182ap")
    host.send(1, CommandCode.SET_ADDRESS, 1, 0x81)
    host.send(2, CommandCode.SET_ADDRESS, 2, 0x01)

    reply = host.send(0x81, CommandCode.DEFINE_STATUS, StatusItem.POSITION)

    assert len(reply) == 6
    assert len(host.send(1, CommandCode.NO_OPERATION)) == 6
    assert len(host.send(3, CommandCode.NO_OPERATION)) == 2


def test_group_without_a_leader_is_silent():
    host = host_on("ls182ap", "ls182ap")

    assert host.send(0xFF, CommandCode.SAVE_CURRENT_POSITION_AS_HOME) == b""


# -- packets -----------------------------------------------------------------------------------------------------------


def test_wrong_checksum_is_answered_and_not_executed():
    host = host_on("ls182ap")
    packet = bytearray(encode_packet(Packet(1, CommandCode.DEFINE_STATUS, b"\x01")))
    packet[-1] ^= 0x10

    host.chain.write(host.now_s, bytes(packet))
    reply = host.wait(0.03)

    assert len(reply) == 2
    assert reply[0] & StatusFlag.CHECKSUM_ERROR
    assert not host.send(1, CommandCode.NO_OPERATION)[0] & StatusFlag.CHECKSUM_ERROR


@pytest.mark.parametrize(
    ("buffer", "earlier", "length"),
    [
        (CommandBuffer.OVERWRITTEN, (1, CommandCode.READ_STATUS, StatusItem.IDENTITY), 4),
        (CommandBuffer.OVERWRITTEN, (2, CommandCode.READ_STATUS, StatusItem.IDENTITY), 4),
        (CommandBuffer.OVERWRITTEN, (1, CommandCode.NO_OPERATION), 3),
        (CommandBuffer.KEPT, (2, CommandCode.READ_STATUS, StatusItem.IDENTITY), 3),
    ],
)
def test_missing_data_bytes_are_those_of_an_earlier_packet_in_the_receive_buffer(buffer, earlier, length):
    host = host_on("ls182ap", "ls182ap", settings=ModuleSettings(version=20, command_buffer=buffer))
    host.send(1, CommandCode.READ_STATUS, StatusItem.AUX)

    host.send(*earlier)

    assert len(host.send(1, CommandCode.DEFINE_STATUS)) == length


def test_after_a_reset_the_receive_buffer_holds_zeros():
    host = host_on("ls182ap")
    host.send(1, CommandCode.READ_STATUS, StatusItem.AUX)

    host.send(1, CommandCode.HARD_RESET)

    assert len(host.send(0, CommandCode.DEFINE_STATUS)) == 2


def test_unknown_commands_are_answered_like_no_operation():
    host = host_on("ls182ap")

    assert len(host.send(1, CommandCode.IO_CONTROL, 0x0F)) == 2
    assert len(host.send(1, CommandCode.ADD_PATH_POINTS, 1, 2)) == 2


def test_nulls_complete_a_half_received_packet():
    host = host_on("ls182ap")
    host.chain.write(host.now_s, encode_packet(Packet(1, CommandCode.SET_GAIN, bytes(14)))[:5])
    host.wait(0.01)

    host.chain.write(host.now_s, NULLS)
    host.wait(0.03)

    assert len(host.send(1, CommandCode.NO_OPERATION)) == 2


def test_noise_and_nulls_between_packets_do_not_matter():
    host = host_on("ls182ap")
    packet = encode_packet(Packet(1, CommandCode.NO_OPERATION))

    host.chain.write(host.now_s, b"\x00\x55" + packet)

    assert len(host.wait(0.03)) == 2


def test_bytes_may_come_one_by_one_with_gaps():
    host = host_on("ls182ap")

    replies = b""
    for value in encode_packet(Packet(1, CommandCode.NO_OPERATION)):
        host.chain.write(host.now_s, bytes([value]))
        replies += host.wait(0.01)

    assert len(replies) == 2


def test_burst_of_packets_to_different_modules_is_executed_by_each():
    host = host_on("ls182ap", "ls182ap")
    burst = b"".join(encode_packet(Packet(address, CommandCode.DEFINE_STATUS, b"\x01")) for address in (1, 2))

    host.chain.write(host.now_s, burst)
    reply = host.wait(0.05)

    assert len(reply) >= 6  # the first reply was cut short by the second packet
    assert len(host.send(1, CommandCode.NO_OPERATION)) == 6
    assert len(host.send(2, CommandCode.NO_OPERATION)) == 6


# -- time --------------------------------------------------------------------------------------------------------------


def test_reply_starts_at_the_end_of_the_modules_servo_cycle():
    settings = ModuleSettings(version=20, phase_s=0.0001, drift_ppm=40.0)
    host = host_on("ls182ap", settings=settings)
    reply_s = 20 / 19_531.25 * (1 + 40e-6)
    cycle_s = SERVO_CYCLE_S * (1 + 40e-6)

    for _ in range(20):
        sent_s = host.now_s
        host.send(1, CommandCode.NO_OPERATION)
        starts_s = host.heard[0][0] - reply_s
        cycles = (starts_s - 0.0001) / cycle_s
        assert cycles == pytest.approx(round(cycles), abs=1e-6)
        assert 0 < starts_s - (sent_s + 40 / 19_200) <= cycle_s
        host.wait(0.00123)


def test_reply_latency_is_added():
    fast = host_on("ls182ap", settings=ModuleSettings(version=20))
    slow = host_on("ls182ap", settings=ModuleSettings(version=20, reply_latency_s=0.002))

    fast.send(1, CommandCode.NO_OPERATION)
    slow.send(1, CommandCode.NO_OPERATION)

    assert slow.heard[0][0] - fast.heard[0][0] == pytest.approx(0.002)


def test_host_that_sends_before_the_reply_loses_it_but_not_the_command():
    settings = ModuleSettings(version=20, reply_latency_s=0.005)
    host = host_on("ls182ap", settings=settings)

    host.chain.write(host.now_s, encode_packet(Packet(1, CommandCode.DEFINE_STATUS, b"\x01")))
    early = host.wait(0.005)
    host.chain.write(host.now_s, b"\x00")
    late = host.wait(0.05)

    assert early == late == b""
    assert len(host.send(1, CommandCode.NO_OPERATION)) == 6


def test_two_modules_at_one_address_collide():
    host = host_on("ls182ap", "ls182ap")
    alone = host.send(1, CommandCode.READ_STATUS, 0x7F)
    host.send(2, CommandCode.SET_ADDRESS, 1, 0xFF)

    together = host.send(1, CommandCode.READ_STATUS, 0x7F)

    assert together
    assert together != alone


# -- rate --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("divisor", "baud"),
    [(0x81, 9600), (127, 9600), (0x3F, 19_200), (64, 19_200), (0x14, 57_600), (21, 57_600), (0x0A, 115_200)],
)
def test_group_changes_its_rate_together(divisor, baud):
    host = host_on("ls182ap", "picservo-v4")

    host.send(0xFF, CommandCode.SET_BAUD_RATE, divisor)
    host.chain.baud = baud

    assert len(host.send(1, CommandCode.NO_OPERATION)) == 2
    assert len(host.send(2, CommandCode.NO_OPERATION)) == 2


def test_module_at_another_rate_hears_garbage():
    host = host_on("ls182ap")
    host.chain.baud = 115_200

    assert host.send(1, CommandCode.NO_OPERATION) == b""

    host.chain.baud = 19_200
    host.chain.write(host.now_s, NULLS)
    host.wait(0.03)
    assert len(host.send(1, CommandCode.NO_OPERATION)) == 2


def test_one_module_may_be_left_behind_at_another_rate():
    host = host_on("ls182ap", "ls182ap")

    host.send(1, CommandCode.SET_BAUD_RATE, 0x0A)

    assert host.send(1, CommandCode.NO_OPERATION) == b""
    assert len(host.send(2, CommandCode.NO_OPERATION)) == 2


# -- reset and power ---------------------------------------------------------------------------------------------------


def test_hard_reset_is_silent_and_restores_the_power_up_state():
    host = host_on("ls182ap", "picservo-v4")
    host.send(1, CommandCode.DEFINE_STATUS, 0xFF)

    assert host.send(0xFF, CommandCode.HARD_RESET) == b""

    assert host.send(1, CommandCode.NO_OPERATION) == b""
    host.address_all()
    assert len(host.send(1, CommandCode.NO_OPERATION)) == 2


def test_host_may_address_a_tenth_of_a_millisecond_after_the_reset_where_that_takes_no_time():
    host = host_on("ls182ap", "picservo-v4", settings=ModuleSettings(version=20, reset_dead_s=0.0))

    host.chain.write(host.now_s, encode_packet(Packet(0xFF, CommandCode.HARD_RESET)))
    host.wait(40 / 19_200 + 0.0001)

    host.address_all()


def test_reset_dead_time_swallows_what_comes_too_early():
    host = host_on("ls182ap", settings=ModuleSettings(version=20, reset_dead_s=0.05))
    host.wait(0.1)
    remarks = []
    host.chain.on_remark = remarks.append
    host.send(0xFF, CommandCode.HARD_RESET)

    too_early = host.send(0, CommandCode.SET_ADDRESS, 1, 0xFF)
    host.wait(0.05)

    assert too_early == b""
    assert remarks == ["module 1: lost: the module is still resetting"]
    host.address_all()


def test_a_reset_takes_a_millisecond_unless_something_else_is_said():
    host = host_on("ls182ap")
    host.chain.write(host.now_s, encode_packet(Packet(0xFF, CommandCode.HARD_RESET)))
    host.wait(40 / 19_200 + 0.0001)

    too_early = host.send(0, CommandCode.SET_ADDRESS, 1, 0xFF)

    assert too_early == b""
    host.address_all()


@pytest.mark.parametrize(("name", "obeys"), [("ls182ap", True), ("picservo-v4", False), ("picservo-sc", True)])
def test_module_in_another_group_may_ignore_the_global_reset(name, obeys):
    host = host_on(name)
    host.send(1, CommandCode.SET_ADDRESS, 1, 0x85)

    host.send(0xFF, CommandCode.HARD_RESET)

    assert (host.send(1, CommandCode.NO_OPERATION) == b"") is obeys


def test_module_without_power_is_silent_and_mutes_the_next_one():
    host = host_on("ls182ap", "ls182ap", "ls182ap")

    host.chain.modules[0].power(on=False, at_s=host.now_s)

    assert [len(host.send(address, CommandCode.NO_OPERATION)) for address in (1, 2, 3)] == [0, 0, 2]


def test_module_comes_back_unaddressed_and_may_rejoin():
    host = host_on("ls182ap", "ls182ap")
    host.chain.modules[0].power(on=False, at_s=host.now_s)
    host.wait(1.0)
    host.chain.modules[0].power(on=True, at_s=host.now_s)

    assert host.send(1, CommandCode.NO_OPERATION) == b""
    assert len(host.send(0, CommandCode.SET_ADDRESS, 1, 0xFF)) == 2
    assert [len(host.send(address, CommandCode.NO_OPERATION)) for address in (1, 2)] == [2, 2]


# -- status layouts and modules without a motor ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "data_bytes"),
    [("picservo-v1", 14), ("picservo-v4", 14), ("picservo-sc", 17), ("ls173ap", 16), ("ls182ap", 17)],
)
def test_whole_status_has_the_length_of_the_device(name, data_bytes):
    assert len(host_on(name).send(1, CommandCode.READ_STATUS, 0xFF)) == data_bytes + 2


def test_power_up_status_of_ls_182ap():
    status = host_on("ls182ap").read(1, LS_182AP)

    assert status.flags == (
        StatusFlag.MOVE_DONE | StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR | StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    )
    assert (status.position, status.velocity, status.home, status.position_error) == (0, 0, 0, 0)


def test_power_up_status_of_pic_servo():
    status = host_on("picservo-v4").read(1, PIC_SERVO_V4)

    assert status.flags == StatusFlag.MOVE_DONE | StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR


def test_io_module_keeps_its_place_in_the_chain():
    host = host_on("ls182ap", "picio", "ls182ap")

    assert len(host.send(2, CommandCode.READ_STATUS, 0xFF)) == 2 + 17
    assert host.send(2, CommandCode.READ_STATUS, IDENTITY)[1:3] == bytes([2, 1])
    assert len(host.send(2, CommandCode.LOAD_TRAJECTORY, 0x91, *little(100, 4))) == 2
    assert len(host.send(3, CommandCode.NO_OPERATION)) == 2


def test_settings_of_a_module_override_those_of_its_name():
    settings = MODELS["pic-servo-v1"][1].model_copy(update={"version": 1, "phase_s": 0.0002})

    host = host_on("pic-servo-v1", settings=settings)

    assert host.read(1, PIC_SERVO_V1, IDENTITY).version == 1
    assert host.chain.modules[0].settings is settings


def test_unknown_module_name_is_refused_with_the_known_ones():
    with pytest.raises(ValueOutOfRange, match="ls-182ap"):
        build_chain(ChainSpec((ModuleSpec("ls999"),)))
    with pytest.raises(ValueOutOfRange, match="at least one"):
        build_chain(ChainSpec(()))


def test_same_seed_gives_the_same_phases():
    def phases(seed):
        chain = build_chain(ChainSpec((ModuleSpec("ls182ap"), ModuleSpec("ls182ap")), seed=seed))
        return [module.settings.phase_s for module in chain.modules]

    assert phases(3) == phases(3)
    assert phases(3) != phases(4)
    assert len(set(phases(3))) == 2


# -- hosts that do what the manuals warn of ---------------------------------------------------------------------------


def led_group(*names):
    """Give the first module the lead of group 81 and let the others be members of it."""
    host = host_on(*names)
    for address in range(1, len(names) + 1):
        host.send(address, CommandCode.SET_ADDRESS, address, 0x01 if address == 1 else 0x81)
    return host


def test_a_leader_answers_set_baud_at_the_new_rate_which_the_host_does_not_understand():
    host = led_group("pic-servo-v4", "pic-servo-v4")

    reply = host.send(0x81, CommandCode.SET_BAUD_RATE, 0x0A)

    assert reply not in {b"", b"\x18\x18", b"\x19\x19"}
    assert host.send(1, CommandCode.NO_OPERATION) == b""


def test_set_baud_to_one_group_splits_the_line():
    host = host_on("pic-servo-v4", "pic-servo-v4", "ls-182ap")
    host.send(1, CommandCode.SET_ADDRESS, 1, 0x81)

    host.send(0x81, CommandCode.SET_BAUD_RATE, 0x0A)
    at_19200 = [address for address in (1, 2, 3) if host.send(address, CommandCode.NO_OPERATION)]
    host.chain.baud = 115_200
    at_115200 = [address for address in (1, 2, 3) if host.send(address, CommandCode.NO_OPERATION)]

    assert (at_19200, at_115200) == ([2, 3], [1])


@pytest.mark.parametrize(("drift_ppm", "follows"), [(0.0, True), (-20_000.0, False), (20_000.0, True)])
def test_a_drive_whose_clock_is_fast_does_not_follow_a_rate_that_its_divisor_misses(drift_ppm, follows):
    host = host_on("ls182ap", settings=ModuleSettings(version=20, drift_ppm=drift_ppm))
    host.send(0xFF, CommandCode.SET_BAUD_RATE, 0x14)  # 59,524

    host.chain.baud = 57_600

    assert (len(host.send(1, CommandCode.NO_OPERATION)) == 2) is follows


def test_a_reset_at_the_working_rate_leaves_behind_who_is_in_another_group():
    host = host_on("ls-182ap", "pic-servo-v4")
    host.send(2, CommandCode.SET_ADDRESS, 2, 0x81)
    host.send(0xFF, CommandCode.SET_BAUD_RATE, 0x0A)
    host.send(0x81, CommandCode.SET_BAUD_RATE, 0x0A)
    host.chain.baud = 115_200

    host.send(0xFF, CommandCode.HARD_RESET)
    host.chain.baud = 19_200

    assert [module.address for module in host.chain.modules] == [0, 2]
    assert host.chain.modules[1].baud == pytest.approx(113_636, rel=1e-4)
    assert len(host.send(0, CommandCode.SET_ADDRESS, 1, 0xFF)) == 2
    assert host.send(0, CommandCode.SET_ADDRESS, 2, 0xFF) == b""  # at the rate of a reset module 2 hears noise
