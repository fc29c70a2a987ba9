"""What single habits of hosts in the field do to a simulated chain, and what misprinted frames of the manual do."""

import pytest

from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.rough_host import BAUD_CODES, HARD_RESET, enumeration, frame, jog, powered
from tests.support.simulated_host import PATIENCE_S, SimulatedHost

MIXED = ("ls182ap", "picservo-v4", "picio", "picservo-sc")
ALIVE = {1: b"\x79\x79", 2: b"\x19\x19", 3: b"\x00\x00", 4: b"\x19\x19"}
CHECKSUM_ERROR = 0x02
MOVE_DONE = 0x01


class RawHost(SimulatedHost):
    """A host that sends bytes as they are."""

    def raw(self, data: bytes, for_s: float = PATIENCE_S) -> bytes:
        self.chain.write(self.now_s, data)
        return self.wait(for_s)

    def play(self, deeds) -> None:
        for deed in deeds:
            self.raw(deed.data, deed.pause_s + PATIENCE_S)

    def alive(self, address: int) -> bytes:
        return self.raw(frame(address, 0xE))

    def position(self, address: int) -> int:
        return int.from_bytes(self.raw(frame(address, 0x3, 0x01))[1:5], "little", signed=True)


@pytest.fixture
def host():
    """A host on a mixed chain whose modules have the addresses 1 to 4."""
    host = RawHost(build_chain(ChainSpec(tuple(map(ModuleSpec, MIXED)))))
    host.play(enumeration(len(MIXED)))
    return host


@pytest.fixture
def drive():
    """A host with a single LS-182AP at address 1 that holds its position."""
    host = RawHost(build_chain(ChainSpec((ModuleSpec("ls182ap"),))))
    host.play((*enumeration(1), *powered(1)))
    return host


def all_alive(host):
    return {address: host.alive(address) for address in ALIVE} == ALIVE


@pytest.mark.parametrize("gap_s", [0.0, 0.0003, 0.02])
def test_bytes_written_one_by_one_make_a_frame(host, gap_s):
    for value in frame(2, 0xE)[:-1]:
        assert host.raw(bytes([value]), gap_s) == b""

    assert host.raw(frame(2, 0xE)[-1:]) == ALIVE[2]


@pytest.mark.parametrize("nulls", [1, 16, 100])
def test_nulls_around_a_frame_are_nothing(host, nulls):
    assert host.raw(bytes(nulls) + frame(1, 0xE), 0.2) == ALIVE[1]
    assert host.raw(bytes(nulls), 0.2) == b""
    assert all_alive(host)


def test_a_burst_reaches_every_module_and_only_the_last_answers(host):
    group = [frame(address, 0x1, address, 0x90 + address) for address in (1, 2, 4)]

    answer = host.raw(b"".join(group))

    assert answer == ALIVE[4]
    assert [module.group for module in host.chain.modules] == [0x91, 0x92, 0xFF, 0x94]


def test_surplus_data_is_ignored(host):
    assert host.raw(frame(1, 0xE, *range(15))) == ALIVE[1]
    assert host.raw(frame(2, 0x3, 0x20, 0x55, 0xAA)) == host.raw(frame(2, 0x3, 0x20))
    assert host.raw(frame(3, 0x2, 0x00, 0xAA, 0xAA)) == ALIVE[3]


def test_nobody_answers_for_an_absent_address(host):
    assert host.raw(frame(9, 0xE)) == b""
    assert host.raw(frame(127, 0x5)) == b""
    assert all_alive(host)


@pytest.mark.parametrize("baud", [9600, 57_600, 115_200])
def test_a_single_module_can_have_a_rate_of_its_own(host, baud):
    host.raw(frame(2, 0xA, BAUD_CODES[baud]))

    assert host.alive(2) == b""
    assert host.alive(1) == ALIVE[1]
    host.chain.baud = baud
    assert host.alive(2) == ALIVE[2]
    assert host.alive(1) == b""


def test_a_module_can_be_given_another_address_later(host):
    assert host.raw(frame(2, 0x1, 30, 0xFF)) == ALIVE[2]

    assert host.alive(2) == b""
    assert host.alive(30) == ALIVE[2]
    assert host.alive(4) == ALIVE[4]


def test_stop_motor_with_the_enable_bit_alone_leaves_a_motion_alone(drive):
    drive.play(jog(1))

    drive.raw(frame(1, 0x7, 0x01))

    before = drive.position(1)
    assert drive.position(1) > before


def test_stop_motor_without_the_enable_bit_lets_the_motor_coast(drive):
    drive.play(jog(1))

    drive.raw(frame(1, 0x7, 0x04))

    drive.wait(1.0)
    stage = drive.chain.modules[0].stage
    assert (stage.enabled, stage.drives) == (False, False)
    at_rest = drive.position(1)
    assert drive.position(1) == at_rest


def test_homing_armed_in_mid_motion_captures_the_next_index(drive):
    drive.play(jog(1))
    armed_at = drive.position(1)

    drive.raw(frame(1, 0x9, 0x08))
    drive.wait(1.0)

    answer = drive.raw(frame(1, 0x3, 0x10))
    home = int.from_bytes(answer[1:5], "little", signed=True)
    assert armed_at < home <= armed_at + 2000 + 100
    assert home % 2000 in range(700, 800)


def test_a_sweep_finds_those_that_are_there(host):
    found = [address for address in range(33) if host.alive(address)]

    assert found == [1, 2, 3, 4]


@pytest.mark.parametrize("pause_s", [0.0001, 2.0])
@pytest.mark.parametrize("seed", range(5))
def test_the_first_module_listens_as_soon_after_a_reset_as_hosts_expect(pause_s, seed):
    def at_once(settings):
        return settings.model_copy(update={"reset_dead_s": 0.0})

    modules = tuple(ModuleSpec(name, adjust=at_once) for name in MIXED)
    host = RawHost(build_chain(ChainSpec(modules, seed=seed)))
    host.play(enumeration(len(MIXED)))

    host.raw(HARD_RESET, len(HARD_RESET) * 10 / 19_200 + pause_s)

    assert len(host.raw(frame(0, 0x1, 1, 0xFF))) == 2
    assert host.alive(1) == ALIVE[1]


def test_frames_at_wrong_rates_do_nothing(host):
    for baud in (9600, 57_600, 115_200):
        host.chain.baud = baud
        for data in (HARD_RESET, frame(0, 0x1, 9, 0xFF), frame(1, 0x7, 0x00), bytes(16)):
            assert host.raw(data) == b""
    host.chain.baud = 19_200

    host.raw(bytes(16))
    assert all_alive(host)


def test_an_io_module_between_servos_keeps_its_place(host):
    identities = {address: host.raw(frame(address, 0x3, 0x20))[1:3] for address in ALIVE}

    assert identities == {1: bytes([90, 20]), 2: bytes([0, 4]), 3: bytes([2, 1]), 4: bytes([0, 10])}


# -- frames as the LS-182AP manual prints them -------------------------------------------------------------------------


def move_away(host):
    """Leave position 0, and stand."""
    trajectory = (5000).to_bytes(4, "little") + (5 << 16).to_bytes(4, "little") + (500).to_bytes(4, "little")
    host.raw(frame(1, 0x4, 0x97, *trajectory))
    host.wait(2.0)
    assert host.position(1) == pytest.approx(5000, abs=2)


def test_the_printed_set_address_with_a_wrong_checksum_is_refused(host):
    answer = host.raw(bytes.fromhex("aa 01 21 07 ff 21"))

    assert answer[0] & CHECKSUM_ERROR
    assert host.alive(7) == b""
    assert host.alive(1) == ALIVE[1]


def test_the_printed_trajectory_with_one_pwm_byte_moves_to_zero(drive):
    move_away(drive)

    answer = drive.raw(bytes.fromhex("aa 01 e4 9f 00 00 00 00 00 80 01 00 64 00 00 00 00 69"))

    assert not answer[0] & (CHECKSUM_ERROR | MOVE_DONE)
    drive.wait(10.0)
    assert drive.position(1) == pytest.approx(0, abs=2)
    assert drive.alive(1)[0] & MOVE_DONE


def test_the_printed_trajectory_without_velocity_is_taken_and_stands_still(drive):
    move_away(drive)

    answer = drive.raw(bytes.fromhex("aa 01 e4 9f 00 00 00 00 00 00 00 00 01 00 00 00 00 85"))

    assert not answer[0] & (CHECKSUM_ERROR | MOVE_DONE)
    drive.wait(1.0)
    assert drive.position(1) == pytest.approx(5000, abs=2)


def test_the_printed_position_bit_without_position_bytes_takes_the_velocity_for_it(drive):
    answer = drive.raw(bytes.fromhex("aa 01 94 37 25 06 01 00 58 01 00 00 51"))

    assert not answer[0] & CHECKSUM_ERROR
    (module,) = drive.chain.modules
    trajectory = module._trajectory
    assert (trajectory.position, trajectory.velocity) == (0x10625, 0x158)  # the acceleration is left from Set Gain


def test_the_printed_frame_with_a_byte_too_many_fails_its_checksum_and_the_rest_is_noise(drive):
    before = drive.chain.modules[0]._trajectory

    answer = drive.raw(bytes.fromhex("aa 01 a4 3e 25 06 01 00 58 01 00 00 64 01 cd"))

    # the surplus byte comes before the reply and takes it back
    assert answer == b""
    assert drive.chain.modules[0]._trajectory == before
    assert drive.send(1, CommandCode.NO_OPERATION)[0] & CHECKSUM_ERROR == 0
