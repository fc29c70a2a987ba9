"""What a bus counts: exchanges, losses, time on the wire, latencies by lane."""

from dataclasses import dataclass, field

BUCKETS = 20
"""Latency buckets double from 64 us; the last one takes everything above 16 s."""


def bucket_limit_s(bucket: int) -> float:
    """Return the upper limit of a latency bucket, in seconds."""
    return 64e-6 * 2.0**bucket


class LatencyHistogram:
    """Durations in buckets that double; constant size, constant cost."""

    __slots__ = ("counts", "longest_s", "total_s")

    def __init__(self) -> None:
        self.counts = [0] * BUCKETS
        self.total_s = 0.0
        self.longest_s = 0.0

    def add(self, duration_s: float) -> None:
        """Count one duration, in seconds, not negative."""
        self.counts[min(BUCKETS - 1, int(duration_s * 15625).bit_length())] += 1
        self.total_s += duration_s
        self.longest_s = max(self.longest_s, duration_s)

    def quantile_s(self, fraction: float) -> float:
        """Return an upper bound for the given quantile (0 to 1) in seconds; 0 when nothing was counted."""
        remaining = fraction * sum(self.counts)
        if not remaining:
            return 0.0
        for bucket, counted in enumerate(self.counts[:-1]):
            remaining -= counted
            if remaining <= 0:
                return min(bucket_limit_s(bucket), self.longest_s)
        return self.longest_s  # the last bucket has no limit of its own


@dataclass(slots=True)
class BusStatistics:
    """Counters since the daemon started; only the bus writes them."""

    exchanges: int = 0
    replies: int = 0
    timeouts: int = 0
    corrupt_replies: int = 0
    rejected_packets: int = 0
    resent: int = 0
    resynchronisations: int = 0
    stray_bytes: int = 0
    openings: int = 0
    losses: int = 0
    bytes_out: int = 0
    bytes_in: int = 0
    wire_busy_s: float = 0.0
    """Time that requests and replies spent on the wire, servo wait and turn-around not counted."""
    stop_wait: LatencyHistogram = field(default_factory=LatencyHistogram)
    """From queueing a probe of the stop lane to its first bit."""
    latency: dict[int, LatencyHistogram] = field(
        default_factory=lambda: {lane: LatencyHistogram() for lane in range(4)}
    )
    """By lane: from queueing (polls: from their due time) to the last reply byte."""
