"""A simulated PIC-I/O and PIC-STEP, as hosts see them; frames of the data sheet's kind for address 2."""

import pytest

from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.pic_io import (
    IoItem,
    IoNode,
    SetDirection,
    SetOutput,
    SetPwmOutputs,
    SetSynchOutput,
    SetTimerMode,
    SynchInput,
    SynchOutput,
    decode_io_status,
    encode_io_command,
    send_io_command,
)
from ldcnd.sim.ldcn.chain import Analog, ChainSpec, ModuleSpec, OutsideLevel, TimedEvent, build_chain, model
from ldcnd.sim.ldcn.io import IoWiring
from ldcnd.sim.ldcn.simulation import SimulatedChainConfig
from tests.support.simulated_host import SimulatedHost

ALL = 0x0FFF


class IoHost(SimulatedHost):
    """A host with one PIC-I/O at address 1."""

    def __init__(self, wiring=None, events=(), **quirks):
        settings = model("pic-io")[1].model_copy(update=quirks)
        spec = ModuleSpec("pic-io", settings=settings, wiring=wiring or IoWiring())
        super().__init__(build_chain(ChainSpec((spec,), events=tuple(events))))
        self.address_all()
        self.module = self.chain.modules[0]

    def do(self, command):
        self.chain.write(self.now_s, encode_io_command(1, command))
        return decode_io_status(IoItem(0), self.wait(0.03))

    def look(self, items=0xFF):
        return decode_io_status(IoItem(items), self.send(1, CommandCode.READ_STATUS, items))


# -- lines (2.2) ------------------------------------------------------------------------------------------------------


def test_after_a_reset_all_lines_are_pulled_up_inputs():
    status = IoHost().look()

    assert (status.levels, status.counter, status.device_id, status.version) == (ALL, 0, 2, 1)


def test_outputs_read_back_what_was_commanded_and_inputs_ignore_it():
    host = IoHost()
    host.do(SetDirection(0xFF7))

    host.do(SetOutput(0x000))
    low = host.look(1).levels
    host.do(SetOutput(0x008))
    high = host.look(1).levels

    assert (low, high) == (0xFF7, ALL)
    assert host.module.latch == 0x008


def test_the_frames_of_a_centrifuges_cabinet_are_obeyed():
    host = IoHost(IoWiring(low=(4,), wires=((10, 7),)))
    for data in ("20 ff 0f", "20 df 0f", "20 df 0e", "20 df 0c", "20 df 08", "26 00 00", "12 03"):
        command, *values = bytes.fromhex(data)
        reply = host.send(1, CommandCode(command & 0x0F), *values)

    assert len(reply) == 5
    assert decode_io_status(IoItem(3), reply).levels == ALL & ~0b0111_0110_1000
    host.send(1, CommandCode.SET_GAIN, 0x00, 0x02)  # output 10 opens the door, which the input 7 sees
    assert decode_io_status(IoItem(3), host.send(1, CommandCode.NO_OPERATION)).levels >> 6 & 1


def test_a_line_follows_the_output_that_is_wired_to_it_and_else_its_own_level():
    host = IoHost(IoWiring(low=(2,), wires=((9, 2),)))
    as_input = host.look(1).levels
    host.do(SetDirection(ALL & ~0x100))
    host.do(SetOutput(0x100))
    high = host.look(1).levels
    host.do(SetOutput(0))

    assert as_input == ALL & ~0x002
    assert high == ALL
    assert host.look(1).levels == ALL & ~0x102


def test_an_output_moves_a_cylinder_with_a_sensor_at_either_end():
    host = IoHost(IoWiring(wires=((9, 1),), inverted_wires=((9, 2),)))
    host.do(SetDirection(ALL & ~0x100))

    seen = []
    for output in (0, 0x100, 0):
        host.do(SetOutput(output))
        seen.append(host.look(1).levels & 0b11)

    assert seen == [0b10, 0b01, 0b10]


def test_levels_and_voltages_change_when_the_schedule_says():
    events = [
        TimedEvent(0.5, 1, OutsideLevel(3), present=False),
        TimedEvent(0.5, 1, Analog(2, 77), present=True),
        TimedEvent(1.0, 1, OutsideLevel(3), present=True),
    ]
    host = IoHost(IoWiring(adc=(1, 2, 3)), events)
    before = host.look()
    host.wait(0.5)
    during = host.look()
    host.wait(0.5)

    assert (before.levels, before.adc1, before.adc2, before.adc3) == (ALL, 1, 2, 3)
    assert (during.levels, during.adc2) == (ALL & ~0x004, 77)
    assert host.look().levels == ALL


def test_a_reset_makes_everything_an_input_again_and_stops_the_outputs():
    host = IoHost()
    host.do(SetDirection(0))
    host.do(SetOutput(0))
    host.do(SetPwmOutputs(200, 100))

    host.send(0xFF, CommandCode.HARD_RESET)
    host.address_all()

    assert host.look(1).levels == ALL
    assert host.module.pwm == (0, 0)


def test_pwm_values_are_taken_and_a_wrong_checksum_changes_nothing():
    host = IoHost()
    host.do(SetPwmOutputs(128, 64))
    damaged = bytearray(encode_io_command(1, SetPwmOutputs(1, 1)))
    damaged[-1] ^= 1

    host.chain.write(host.now_s, bytes(damaged))
    reply = decode_io_status(IoItem(0), host.wait(0.03))

    assert reply.rejected
    assert host.module.pwm == (128, 64)


def test_undefined_bits_of_the_status_byte_may_be_anything():
    host = IoHost(undefined_status_bits=0xFF)

    reply = host.send(1, CommandCode.NO_OPERATION)

    assert reply[0] == 0xFD
    assert not decode_io_status(IoItem(0), reply).rejected


# -- synch (3.1) ------------------------------------------------------------------------------------------------------


def test_stored_outputs_take_effect_with_the_start_of_a_servo_group():
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("pic-io"), ModuleSpec("pic-servo-v4")))))
    host.address_all()
    io = host.chain.modules[0]
    for address in (1, 2):
        host.send(address, CommandCode.SET_ADDRESS, address, 0x81)
    for command in (SetDirection(0xEF7), SetSynchOutput(0x108, 200, 7)):
        host.chain.write(host.now_s, encode_io_command(1, command))
        host.wait(0.03)
    before = (io.levels & 0x108, io.pwm)

    host.send(0x81, CommandCode.START_MOTION)

    assert before == (0, (0, 0))
    assert (io.levels & 0x108, io.pwm) == (0x108, (200, 7))


def test_synch_input_captures_levels_and_timer_where_servos_save_home():
    host = IoHost(IoWiring(low=(1,)))
    host.do(SetTimerMode(enabled=True))
    host.wait(0.25)

    host.do(SynchInput())
    captured = host.look(0xC0)
    host.module.drive_line(1, high=True, at_s=host.now_s)
    host.wait(0.1)
    later = host.look()

    assert captured.captured_levels == ALL & ~1
    assert (later.captured_levels, later.captured_counter) == (captured.captured_levels, captured.captured_counter)
    assert captured.captured_counter == pytest.approx(0.28 * 5_000_000, rel=0.02)


def test_synch_output_before_anything_was_stored_sets_zeros():
    host = IoHost()
    host.do(SetPwmOutputs(9, 9))

    host.do(SynchOutput())

    assert host.module.pwm == (0, 0)


@pytest.mark.parametrize("once", [True, False])
def test_whether_stored_outputs_are_applied_again_is_a_switch(once):
    host = IoHost(synch_output_once=once)
    host.do(SetSynchOutput(0, 200, 7))
    host.do(SynchOutput())
    host.do(SetPwmOutputs(9, 9))

    host.do(SynchOutput())

    assert host.module.pwm == ((9, 9) if once else (200, 7))


def test_the_unused_half_of_the_inputs_may_be_anything():
    host = IoHost(undefined_level_bits=0xF)

    reply = host.send(1, CommandCode.READ_STATUS, 0x01)

    assert reply[2] >> 4 == 0xF
    assert host.look(1).levels == ALL


# -- counter and timer (2.2, 3.1) -------------------------------------------------------------------------------------


@pytest.mark.parametrize("prescale", [1, 2, 4, 8])
def test_the_timer_runs_on_the_modules_clock(prescale):
    host = IoHost()
    host.do(SetTimerMode(enabled=True, prescale=prescale))
    first = host.look(0x10).counter

    host.wait(1.0)

    assert host.look(0x10).counter - first == pytest.approx(1.03 * 5_000_000 / prescale, rel=0.002)


def test_the_counter_counts_rising_edges_of_line_10_while_it_is_an_input():
    host = IoHost(IoWiring(low=(10,)))
    host.do(SetTimerMode(enabled=True, counter=True, prescale=2))
    for _ in range(6):
        host.module.drive_line(10, high=True, at_s=host.now_s)
        host.wait(0.001)
        host.module.drive_line(10, high=False, at_s=host.now_s)
        host.wait(0.001)
    counted = host.look(0x10).counter

    host.do(SetDirection(ALL & ~0x200))
    for level in (0x200, 0, 0x200):
        host.do(SetOutput(level))

    assert counted == 3
    assert host.look(0x10).counter == 3


def test_the_counter_sees_an_output_that_is_wired_to_line_10():
    host = IoHost(IoWiring(wires=((1, 10),)))
    host.do(SetDirection(ALL & ~0x001))
    host.do(SetOutput(0))
    host.do(SetTimerMode(enabled=True, counter=True))

    for level in (1, 0, 1, 0, 1):
        host.do(SetOutput(level))

    assert host.look(0x10).counter == 3


def test_a_square_wave_at_the_counters_line_is_counted():
    host = IoHost(IoWiring(pulses_hz=10_000.0))
    host.do(SetTimerMode(enabled=True, counter=True))

    host.wait(1.0)

    assert host.look(0x10).counter == pytest.approx(10_000 * 1.05, rel=0.03)


@pytest.mark.parametrize("cleared", [True, False])
def test_whether_a_new_mode_clears_the_count_is_a_switch(cleared):
    host = IoHost(counter_cleared_by_mode=cleared)
    host.do(SetTimerMode(enabled=True))
    host.wait(0.1)

    host.do(SetTimerMode(enabled=False))
    first = host.look(0x10).counter
    host.wait(0.1)

    assert (first == 0) is cleared
    assert host.look(0x10).counter == first


# -- the codec for hosts ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command", [SetDirection(0x1000), SetOutput(-1), SetPwmOutputs(256, 0), SetTimerMode(enabled=True, prescale=3)]
)
def test_what_a_pic_io_does_not_have_is_refused(command):
    with pytest.raises(ValueOutOfRange):
        encode_io_command(1, command)


def test_only_the_common_moment_of_a_group_is_not_sent_again():
    assert send_io_command(IoNode(1), SetOutput(1)).repeatable
    assert send_io_command(IoNode(1), SynchOutput()).repeatable
    assert not send_io_command(IoNode(0x81), SynchOutput()).repeatable


# -- PIC-STEP ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mask", "length"), [(0x00, 2), (0x1F, 14), (0x20, 4), (0x3F, 16), (0x7F, 17), (0xFF, 17)])
def test_a_pic_step_answers_with_the_widths_that_its_hosts_expect(mask, length):
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("pic-step"),))))
    host.address_all()

    reply = host.send(1, CommandCode.DEFINE_STATUS, mask)

    assert len(reply) == length


# -- configuration ----------------------------------------------------------------------------------------------------


def test_wiring_and_schedule_come_from_the_configuration():
    config = SimulatedChainConfig.model_validate(
        {
            "module": [{"model": "picio", "io": {"low": [3], "wires": [[9, 2]], "adc": [5, 6, 7], "pulses_hz": 50}}],
            "event": [
                {"at_s": 0.2, "module": 1, "line": 3, "level": "high"},
                {"at_s": 0.2, "module": 1, "adc": 1, "value": 200},
            ],
        }
    )
    host = SimulatedHost(build_chain(config.spec()))
    host.address_all()
    before = decode_io_status(IoItem(3), host.send(1, CommandCode.READ_STATUS, 3))
    host.wait(0.2)
    after = decode_io_status(IoItem(3), host.send(1, CommandCode.READ_STATUS, 3))

    assert (before.levels, before.adc1) == (ALL & ~0x004, 5)
    assert (after.levels, after.adc1) == (ALL, 200)


@pytest.mark.parametrize(
    ("module", "event", "complaint"),
    [
        ({"model": "ls-182ap", "io": {"low": [1]}}, None, "a ls-182ap has no terminals"),
        ({"model": "pic-io", "io": {"low": [13]}}, None, "less than or equal to 12"),
        ({"model": "ls-182ap"}, {"line": 1, "level": "low"}, "is a ls-182ap and has no terminals"),
        ({"model": "pic-io"}, {"line": 1}, "line and level belong together"),
        ({"model": "pic-io"}, {"adc": 1}, "adc and value belong together"),
        ({"model": "pic-io"}, {"begins": "stalled"}, "has no motor"),
        ({"model": "pic-io"}, {"line": 1, "level": "low", "power": "off"}, "exactly one"),
    ],
)
def test_what_cannot_be_connected_is_refused(module, event, complaint):
    events = [{"at_s": 1.0, "module": 1} | event] if event else []

    with pytest.raises(ValueError, match=complaint):
        SimulatedChainConfig.model_validate({"module": [module], "event": events})
