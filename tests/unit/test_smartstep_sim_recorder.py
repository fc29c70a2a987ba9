import pytest

from ldcnd.drives.smartstep.profiles import TraceWordLayout
from ldcnd.drives.smartstep.trace_data import DataObject, IoObject, TracePoint, decode_word, first_point, unwrap
from ldcnd.sim.smartstep.recorder import SimulatedRecorder
from ldcnd.sim.smartstep.variant import BENCH_TRIGGER_MAP, SimulatedVariant

TRACE_1, TRACE_2, SMPTMS, PTRGNO, TRGC1, TRGC2, TRGADR = range(0x5000, 0x5007)
RISING, FALLING = BENCH_TRIGGER_MAP.rising, BENCH_TRIGGER_MAP.falling


class Ramp:
    """Trace 1 sees the number of the point, trace 2 its negative; the I/O bit is up from point 700 on."""

    def __init__(self) -> None:
        self.number = -1

    def __call__(self, data: DataObject, _io: IoObject) -> TracePoint:
        if data is DataObject.TORQUE_REFERENCE:
            self.number += 1
            return TracePoint(self.number, self.number >= 700)
        return TracePoint(-self.number, self.number >= 800)


def recorder_with(variant: SimulatedVariant | None = None, **registers: int) -> SimulatedRecorder:
    recorder = SimulatedRecorder(variant or SimulatedVariant())
    settings = {"trace_2": 0x0001, **registers}
    addresses = {"trace_1": TRACE_1, "trace_2": TRACE_2, "smptms": SMPTMS, "pre": PTRGNO, "word": TRGC1, "level": TRGC2}
    for name, value in settings.items():
        assert recorder.write(addresses[name], value)
    return recorder


def run(recorder: SimulatedRecorder, points: int = 5000) -> int:
    recorder.start(10.0)
    ramp = Ramp()
    for count in range(1, points + 1):
        if recorder.record(ramp):
            return count
    return 0


def values(recorder: SimulatedRecorder, trace: int = 0) -> list[int]:
    return [decode_word(word, TraceWordLayout.MSB_IO).value for word in recorder.rings[trace]]


def test_untriggered_trace_takes_500_points_from_the_start():
    recorder = recorder_with()

    assert run(recorder) == 500
    assert values(recorder) == list(range(500))
    assert values(recorder, 1) == [-number for number in range(500)]
    assert recorder.next_s is None


def test_points_are_due_at_smptms_times_cyclec():
    recorder = recorder_with(smptms=8)
    recorder.start(10.0)

    dues = []
    ramp = Ramp()
    for _ in range(3):
        dues.append(recorder.next_s)
        recorder.record(ramp)

    assert dues == pytest.approx([10.002, 10.004, 10.006])


@pytest.mark.parametrize("pre", [0, 1, 100, 499])
def test_rising_data_trigger_sits_after_its_pre_trigger_points(pre):
    recorder = recorder_with(pre=pre, word=RISING, level=620)

    run(recorder)
    points = unwrap(values(recorder), first_point(recorder.read(TRGADR), pre))

    assert points == tuple(range(620 - pre, 620 - pre + 500))


def test_falling_trigger_on_trace_2_takes_a_signed_level():
    recorder = recorder_with(word=BENCH_TRIGGER_MAP.trace2 | FALLING, level=0x10000 - 600)

    run(recorder)

    assert values(recorder, 1)[recorder.read(TRGADR)] == -601


@pytest.mark.parametrize(("selected", "point"), [(0, 700), (1, 800)])
def test_io_trigger_watches_the_selected_trace(selected, point):
    recorder = recorder_with(word=BENCH_TRIGGER_MAP.io | RISING, level=selected)

    run(recorder)

    assert values(recorder)[recorder.read(TRGADR)] == point


def test_any_change_triggers_when_both_edges_are_enabled():
    recorder = recorder_with(word=BENCH_TRIGGER_MAP.trace2 | RISING | FALLING, level=0x10000 - 600)

    run(recorder)

    assert recorder.read(TRGADR) == 1


def test_level_never_crossed_waits_for_ever():
    recorder = recorder_with(word=RISING, level=0x3FFF)

    assert run(recorder) == 0
    assert recorder.next_s is not None


@pytest.mark.parametrize(("waits", "point"), [(True, None), (False, 50)])
def test_early_trigger_is_taken_or_not_by_the_variant(waits, point):
    recorder = recorder_with(SimulatedVariant(trigger_waits=waits), pre=100, word=RISING, level=50)

    run(recorder, points=600)

    triggered = recorder.next_s is None
    assert triggered is (point is not None)


@pytest.mark.parametrize(
    ("address", "value", "outcome"),
    [
        (TRACE_1, 0x8101, True),
        (TRACE_1, 0x8102, False),
        (TRACE_2, 0x0200, False),
        (SMPTMS, 0, True),
        (SMPTMS, 1, True),
        (PTRGNO, 499, True),
        (PTRGNO, 500, False),
        (TRGC1, 0x0000, True),
        (TRGC1, 0x8000, False),
        (TRGC2, 0xFFFF, True),
        (TRGADR, 0, None),
        (0x5100, 0, None),
    ],
)
def test_registers_take_what_the_manual_allows(address, value, outcome):
    assert SimulatedRecorder(SimulatedVariant()).write(address, value) is outcome


@pytest.mark.parametrize("layout", [TraceWordLayout.MSB_IO, TraceWordLayout.LSB_IO_SHIFT, TraceWordLayout.LSB_IO_MASK])
def test_words_have_the_layout_of_the_variant(layout):
    recorder = recorder_with(SimulatedVariant(trace_word_layout=layout), word=BENCH_TRIGGER_MAP.io | RISING)

    run(recorder)
    point = decode_word(recorder.rings[0][recorder.read(TRGADR)], layout)

    assert point == TracePoint(700, io=True)
