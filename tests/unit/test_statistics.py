import random

import pytest

from ldcnd.line.exchange import Lane
from ldcnd.line.flight_recorder import BUCKETS, BusStatistics, LatencyHistogram, bucket_limit_s


def test_limits_double_from_64_microseconds():
    assert bucket_limit_s(0) == 64e-6
    assert bucket_limit_s(1) == 128e-6
    assert bucket_limit_s(BUCKETS - 2) == pytest.approx(16.8, abs=0.1)


@pytest.mark.parametrize(
    ("duration_s", "bucket"),
    [(0.0, 0), (63e-6, 0), (65e-6, 1), (127e-6, 1), (129e-6, 2), (0.001, 4), (16.0, 18), (17.0, 19), (1e6, 19)],
)
def test_a_duration_lands_in_its_bucket(duration_s: float, bucket: int):
    histogram = LatencyHistogram()

    histogram.add(duration_s)

    assert histogram.counts[bucket] == 1
    assert sum(histogram.counts) == 1


def test_a_quantile_is_an_upper_bound_and_no_wild_one():
    durations = random.Random(7)
    histogram = LatencyHistogram()
    samples = sorted(durations.lognormvariate(-6, 1.5) for _ in range(1000))
    for sample in samples:
        histogram.add(sample)

    for fraction in (0.5, 0.9, 0.99, 1.0):
        exact_s = samples[int(fraction * 1000) - 1]
        assert exact_s <= histogram.quantile_s(fraction) <= max(64e-6, 2 * exact_s)


def test_the_bound_holds_beyond_the_last_bucket():
    histogram = LatencyHistogram()

    histogram.add(100.0)

    assert histogram.quantile_s(0.5) == 100.0
    assert histogram.longest_s == 100.0


def test_nothing_counted_is_zero():
    assert LatencyHistogram().quantile_s(0.99) == 0.0


def test_each_lane_has_its_own_latencies():
    statistics = BusStatistics()

    statistics.latency[Lane.STOP].add(0.001)

    assert set(statistics.latency) == set(Lane)
    assert sum(statistics.latency[Lane.COMMAND].counts) == 0
