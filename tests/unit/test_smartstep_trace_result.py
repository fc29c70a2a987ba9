import pytest

from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.contract.traces import TraceTrigger, TriggerKind
from ldcnd.drives.smartstep.profiles import SMARTSTEP
from ldcnd.drives.smartstep.trace_data import TraceConstants
from ldcnd.drives.smartstep.trace_result import CHANNELS, assign, trigger_condition, trigger_operand
from ldcnd.sim.smartstep.variant import BENCH_TRIGGER_MAP

MAPPED = SMARTSTEP.with_trace(trigger_map=BENCH_TRIGGER_MAP)
CONSTANTS = TraceConstants(cyclec_us=250, maxtrqc=300, osvelcc=4500)


@pytest.mark.parametrize(
    ("channels", "objects", "used"),
    [
        (("speed_feedback", "inp"), (0x8101, 0x8101), 1),
        (("speed_feedback", "position_deviation", "inp", "alm"), (0x8101, 0x8004), 2),
        (("position_deviation", "bkir", "reset"), (0x8704, 0x0604), 2),
        (("run",), (0x0000, 0x0000), 1),
        (("inp", "run"), (0x8100, 0x0000), 2),
        (("torque_reference", "command_pulse_speed"), (0x0000, 0x0003), 2),
    ],
)
def test_channels_find_their_memories(channels, objects, used):
    assignment = assign("a", channels)

    assert (assignment.objects, assignment.used) == (objects, used)


def test_every_channel_can_be_traced_alone():
    assert [assign("a", (channel,)).memory(channel) for channel in CHANNELS] == [0] * len(CHANNELS)


def test_three_signals_are_too_many():
    with pytest.raises(ValueOutOfRange, match="3 signals at once; the drive traces 2"):
        assign("a", ("run", "reset", "inp"))


@pytest.mark.parametrize(
    ("channel", "kind", "word"),
    [
        ("speed_feedback", TriggerKind.RISING, 0x0100),
        ("position_deviation", TriggerKind.FALLING, 0x0201),
        ("inp", TriggerKind.EITHER, 0x0302),
        ("alm", TriggerKind.RISING, 0x0102),
    ],
)
def test_trigger_watches_the_memory_of_its_channel(channel, kind, word):
    assignment = assign("a", ("speed_feedback", "position_deviation", "inp", "alm"))

    condition = trigger_condition("a", MAPPED, assignment, TraceTrigger(channel=channel, kind=kind))

    assert condition == word


@pytest.mark.parametrize(
    ("channel", "level", "operand"),
    [("speed_feedback", 450.0, 1500), ("position_deviation", -3.0, 0xFFFD), ("inp", 5.0, 0), ("alm", 5.0, 1)],
)
def test_operand_is_a_level_in_trace_data_or_the_memory_of_the_signal(channel, level, operand):
    assignment = assign("a", ("speed_feedback", "position_deviation", "inp", "alm"))
    trigger = TraceTrigger(channel=channel, kind=TriggerKind.RISING, level=level)

    assert trigger_operand(SMARTSTEP, CONSTANTS, assignment, trigger) == operand


def test_no_trigger_is_zero():
    assignment = assign("a", ("run",))

    assert trigger_condition("a", SMARTSTEP, assignment, None) == 0
    assert trigger_operand(SMARTSTEP, CONSTANTS, assignment, None) == 0


def test_without_a_map_there_is_no_trigger():
    with pytest.raises(NotSupported):
        trigger_condition("a", SMARTSTEP, assign("a", ("run",)), TraceTrigger(channel="run", kind=TriggerKind.RISING))
