"""What must hold for any simulated SmartStep, whatever happens to it."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ldcnd.drives.smartstep.monitors import Counter, CounterReading
from ldcnd.drives.smartstep.packet import CommandPacket, Function, decode_reply
from ldcnd.drives.smartstep.parameters import PN000
from ldcnd.sim.smartstep.drive import SimulatedMotor
from ldcnd.sim.smartstep.unit import SimulatedUnit

commands = st.builds(
    CommandPacket,
    st.integers(0, 2),
    st.sampled_from(Function),
    st.sampled_from([0x0100, 0x1100, 0x2000, 0x2001, 0x3000, 0x5000, 0x5002, 0x5003, 0x5004, 0x8000, 0x8008, 0xC000])
    | st.integers(0, 0xFFFF),
    st.sampled_from([0, 1, 2, 1000, 0x2000, 0x2003, 0x8101]) | st.integers(0, 0xFFFF),
)


@settings(max_examples=60)
@given(st.lists(commands, max_size=20), st.booleans())
def test_unit_answers_each_command_of_its_own_once_and_no_other(sent, turning):
    unit = SimulatedUnit(stored={PN000: 0x0100})
    unit.drive.set_run(0.0, on=True)
    unit.drive.set_pulse_rate(50_000.0 if turning else 0.0, 0.0)
    at_s = 0.0
    for command in sent:
        at_s += 3.0
        unit.receive(command.encode(), at_s)
        answers = unit.transmissions(at_s + 0.2)

        assert len(answers) == (1 if command.unit == 1 else 0)
        for answer in answers:
            assert answer.characters[:2] == b"W1"
            assert answer.characters[3:7] == command.encode()[3:7]
            if len(answer.characters) == 14:
                assert decode_reply(answer.characters).status.function == command.function
            else:
                assert command.function is Function.STRING_REFERENCE


@given(
    st.floats(-100_000, 100_000),
    st.lists(st.floats(0.0001, 1.0), min_size=1, max_size=8),
    st.booleans(),
    st.booleans(),
)
def test_motor_does_not_care_how_time_is_cut(rate, steps_s, servo_on, jammed):
    at_once = SimulatedMotor(pulse_rate=rate, servo_on=servo_on, jammed=jammed, speed=1000.0)
    in_steps = SimulatedMotor(pulse_rate=rate, servo_on=servo_on, jammed=jammed, speed=1000.0)

    to_s = 0.0
    for step_s in steps_s:
        to_s += step_s
        in_steps.advance(to_s)
    at_once.advance(to_s)

    assert in_steps.position == pytest.approx(at_once.position, rel=1e-6, abs=1e-3)
    assert in_steps.deviation == pytest.approx(at_once.deviation, rel=1e-6, abs=1e-3)
    assert in_steps.speed == pytest.approx(at_once.speed, rel=1e-6, abs=1e-3)


@given(st.integers(0, 2**32 - 1), st.integers(-32_767, 32_767))
def test_evenly_moving_counter_is_read_as_it_was_at_one_of_the_reads(start, step):
    reading = CounterReading(Counter.COMMAND)
    seen = []
    while reading.wanted:
        seen.append((start + len(seen) * step) & 0xFFFF_FFFF)
        word = seen[-1] >> 16 if reading.wanted is Counter.COMMAND.high else seen[-1] & 0xFFFF
        reading.take(word, len(seen))

    assert reading.value is not None
    assert reading.value.raw in seen
