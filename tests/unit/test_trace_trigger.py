import pytest

from ldcnd.contract.traces import TraceTrigger, TriggerKind
from ldcnd.drives.tracer import TriggerWatch


def first_firing(kind, values, *, level=10.0, signal=False, ready_from=0):
    watch = TriggerWatch(TraceTrigger(channel="any", kind=kind, level=level), signal=signal)
    fired = [watch.fires(value, ready=place >= ready_from) for place, value in enumerate(values)]
    return fired.index(True) if True in fired else None


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        (TriggerKind.RISING, 3),
        (TriggerKind.FALLING, 1),
        (TriggerKind.EITHER, 1),
        (TriggerKind.CHANGE, 1),
        (TriggerKind.ABOVE, 0),
        (TriggerKind.BELOW, 1),
    ],
)
def test_each_kind_fires_at_its_place(kind, place):
    assert first_firing(kind, [11.0, 9.0, 9.9, 10.0, 8.0]) == place


@pytest.mark.parametrize("kind", [TriggerKind.RISING, TriggerKind.FALLING, TriggerKind.EITHER, TriggerKind.CHANGE])
def test_first_sample_is_no_edge(kind):
    assert first_firing(kind, [50.0]) is None
    assert first_firing(kind, [-50.0]) is None


def test_edge_before_enough_samples_is_passed_over():
    assert first_firing(TriggerKind.RISING, [0, 20, 0, 0, 20], ready_from=3) == 4


def test_edge_between_the_last_sample_that_is_too_early_and_the_first_that_is_not_counts():
    assert first_firing(TriggerKind.RISING, [0, 0, 20], ready_from=2) == 2


def test_missing_values_neither_fire_nor_hide_an_edge():
    assert first_firing(TriggerKind.RISING, [0.0, None, 20.0]) == 2
    assert first_firing(TriggerKind.BELOW, [None, None]) is None


def test_signal_has_its_level_between_its_values():
    assert first_firing(TriggerKind.RISING, [0.0, 1.0], level=10.0, signal=True) == 1


@pytest.mark.parametrize(
    ("kind", "values", "place"),
    [
        (TriggerKind.RISING, [350.0, 365.0, 371.0], 2),
        (TriggerKind.RISING, [350.0, 365.0, 360.0], None),
        (TriggerKind.FALLING, [20.0, 5.0, -351.0], 1),
        (TriggerKind.FALLING, [5.0, -340.0, -351.0], 2),
        (TriggerKind.ABOVE, [725.0, 735.0], 1),
        (TriggerKind.BELOW, [735.0, 1095.0], None),
        (TriggerKind.BELOW, [-340.0, -355.0], 1),
    ],
)
def test_each_turn_has_the_level(kind, values, place):
    watch = TriggerWatch(TraceTrigger(channel="position", kind=kind, level=10.0), signal=False, turn=360.0)
    fired = [watch.fires(value, ready=True) for value in values]

    assert (fired.index(True) if True in fired else None) == place
