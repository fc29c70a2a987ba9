"""How quickly a SmartStep's trace memory is read, on the jumping clock, beside what its line allows."""

import math
from itertools import pairwise
from unittest import mock

from ldcnd.client.traces import take_trace
from ldcnd.config.rig import RigConfig
from ldcnd.contract.traces import TakeTrace
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.smartstep import family
from ldcnd.drives.smartstep.commands import LONGEST_STRING_BYTES
from ldcnd.drives.smartstep.config import SlowRatesConfig, SmartStepAxisConfig
from ldcnd.drives.smartstep.packet import PACKET_CHARACTERS, Function
from ldcnd.drives.smartstep.trace_data import chunk_plan
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.smartstep.unit import CHARACTER_S
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.bench.report import Row
from tests.bench.saturated_rig import on_jumping_clock
from tests.support.rig import RunningRig
from tests.support.trace_rig import MIXED, trace_config

VARIANT = SimulatedVariant()
SHARE = 0.99
"""Of the limit, at least."""
AS_A_RULE_BYTES = 200
SELDOM = SlowRatesConfig(position=0.001, velocity=0.001, state=0.001)
TRACE = TakeTrace(channels=("speed_feedback", "torque_reference"))
MEMORIES, READINGS = 2, 2


def rows() -> list[Row]:
    """Measure on an idle line with the longest strings and with those of every day, and beside usual polls."""
    return [
        Row(
            f"SmartStep trace, strings of {LONGEST_STRING_BYTES} bytes: limit / upload",
            share_of_limit(LONGEST_STRING_BYTES),
            target=SHARE,
        ),
        Row(f"SmartStep trace, strings of {AS_A_RULE_BYTES} bytes: limit / upload", share_of_limit(AS_A_RULE_BYTES)),
        Row(f"the same beside the polls of config/{MIXED.name}", share_of_limit(AS_A_RULE_BYTES, polled=True)),
    ]


def share_of_limit(string_bytes: int, *, polled: bool = False) -> float:
    """Return how long the strings of an upload take by themselves, over the time from the first to the end of the last.

    Args:
        string_bytes: the longest string that the configuration permits.
        polled: the units of the line are polled as in config/mixed.toml, and not hardly ever.
    """

    async def work(rig: RunningRig) -> float:
        await take_trace(rig.client, "feed", TRACE, within_s=300)
        return limit_s(string_bytes) / _uploading_s(rig)

    # an idle line reads no alarm history either, and audits no parameters
    history_hz = family.ALARM_HISTORY_HZ if polled else 0.0
    with mock.patch.object(family, "ALARM_HISTORY_HZ", history_hz):
        return on_jumping_clock(_config(string_bytes, polled=polled), work)


def limit_s(string_bytes: int) -> float:
    """Return how long the strings of an upload take: their characters, and the drive's time to answer each."""
    strings = [chunk for memory in range(MEMORIES) for chunk in chunk_plan(memory + 1, string_bytes)] * READINGS
    characters = math.fsum(2 * PACKET_CHARACTERS + 2 * chunk.byte_count for chunk in strings)
    return characters * CHARACTER_S + len(strings) * VARIANT.response_s


def _config(string_bytes: int, *, polled: bool) -> RigConfig:
    config = trace_config(VARIANT, {"chunk_bytes": string_bytes}, loaded=polled)
    if polled:
        return config

    def hardly_polled(axis: AxisConfig) -> AxisConfig:
        assert isinstance(axis, SmartStepAxisConfig)
        unaudited = axis.smartstep.model_copy(update={"audit_s": 0.0})
        return axis.model_copy(update={"rates": SELDOM, "smartstep": unaudited})

    *others, steps = config.bus
    steps = steps.model_copy(update={"axis": tuple(hardly_polled(axis) for axis in steps.axis)})
    return config.model_copy(update={"bus": (*others, steps)})


def _uploading_s(rig: RunningRig) -> float:
    """Return the time from the first string's request to the last one's reply."""
    strings_s = [
        (request.at_s, reply.at_s)
        for request, reply in pairwise(rig.daemon.rig.buses[1].bus.wire_log.records())
        if (request.event, reply.event) == (WireEvent.SENT, WireEvent.RECEIVED)
        and request.data[2:3] == b"%d" % Function.STRING_REFERENCE
    ]
    return strings_s[-1][1] - strings_s[0][0]
