"""Traces by the host through the whole daemon: an LDCN axis sampled as fast as its line allows."""

import asyncio
from dataclasses import replace
from itertools import pairwise

import pytest

from ldcnd.client.traces import arm_trace, armed_trace, fetch_trace, take_trace, trace_header, wait_for_trace
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.errors import BusyTracing, DriveFault, ValueOutOfRange, WrongState
from ldcnd.contract.samples import TelemetryItem
from ldcnd.contract.traces import AbortTrace, TakeTrace, TracePhase, TraceTrigger, TriggerKind
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import build_chain
from tests.support.rig import SIMULATED, running_rig


async def ready(rig):
    await rig.until("x", lambda state: state.link == "up")
    await rig.client.command("x", Power(on=True))


def rising(level, channel="velocity"):
    return TraceTrigger(channel=channel, kind=TriggerKind.RISING, level=level)


@pytest.mark.long
async def test_fastest_trace_follows_a_move_with_a_true_time_for_every_sample():
    async with running_rig() as rig:
        await ready(rig)

        request = TakeTrace(
            channels=("position", "velocity", "following_error"), samples=400, pre_trigger=50, trigger=rising(2.0)
        )
        reply = await arm_trace(rig.client, "x", request)
        await asyncio.sleep(1.0)  # a trigger counts once the samples before it are there
        await rig.client.command("x", MoveAbsolute(position=5.0))
        await wait_for_trace(rig.client, "x", reply.trace_id, 60)
        trace = await fetch_trace(rig.client, "x", reply.trace_id)

    position, velocity, _error = trace.values
    offsets = trace.offsets_ns
    assert len(offsets) == len(position) == 400
    assert (trace.header.trigger_index, offsets[50]) == (50, 0)
    assert velocity[49] < 2.0 <= velocity[50]
    assert all(later > earlier for earlier, later in pairwise(offsets))
    assert len({later - earlier for earlier, later in pairwise(offsets)}) > 5
    travelled = sum((velocity[k] + velocity[k + 1]) / 2 * (offsets[k + 1] - offsets[k]) * 1e-9 for k in range(50, 399))
    assert position[399] - position[50] == pytest.approx(travelled, abs=0.05)
    assert trace.raw[0] == tuple(round(value * 1000) for value in position)


async def test_asked_interval_is_kept_on_a_grid():
    async with running_rig() as rig:
        await ready(rig)

        trace = await take_trace(
            rig.client, "x", TakeTrace(channels=("position",), interval_s=0.02, samples=50), within_s=60
        )

    assert trace.header.interval_s == 0.02
    assert all(abs(offset - k * 20e6) < 10e6 for k, offset in enumerate(trace.offsets_ns))


@pytest.mark.long
async def test_other_axes_keep_their_rates_while_one_is_traced_as_fast_as_possible():
    async def gaps_s(rig, axis):
        """The pauses between positions, which are due every 50 ms on y and every 100 ms on z."""
        stamps = []
        async with rig.client.samples(axis, TelemetryItem.POSITION) as samples:
            async with asyncio.timeout(5):
                while len(stamps) < 30:
                    stamps.append((await anext(samples))[1].t)
        return [(later - earlier) / 1e9 for earlier, later in pairwise(stamps)]

    async with running_rig() as rig:
        await ready(rig)
        bus = rig.daemon.rig.buses[0].bus
        longest_s = max(
            bus.longest_s(axis.driver.reading(frozenset(TelemetryItem))) for axis in rig.daemon.rig.buses[0].axes
        )
        reply = await arm_trace(rig.client, "x", TakeTrace(channels=("position",), samples=10_000))

        gaps = {axis: await gaps_s(rig, axis) for axis in ("y", "z")}
        header = await trace_header(rig.client, "x")

    assert (header.trace_id, header.phase) == (reply.trace_id, TracePhase.RECORDING)
    for axis, period_s in (("y", 0.05), ("z", 0.1)):
        # four polls may be due at once, and one exchange of the trace may be on the wire
        assert max(gaps[axis]) < period_s + 5 * longest_s
        assert sum(gaps[axis]) / 29 == pytest.approx(period_s, abs=longest_s)


async def test_level_trigger_fires_on_a_signal_that_is_there_already():
    async with running_rig() as rig:
        await ready(rig)

        above = TraceTrigger(channel="enabled", kind=TriggerKind.ABOVE)
        trace = await take_trace(
            rig.client, "x", TakeTrace(channels=("enabled",), samples=20, pre_trigger=5, trigger=above), within_s=60
        )

    assert trace.header.trigger_index == 5


async def test_trace_tells_when_a_trigger_counts():
    async with running_rig() as rig:
        await ready(rig)
        phases = []
        request = TakeTrace(channels=("velocity",), samples=60, pre_trigger=50, trigger=rising(2.0), interval_s=0.02)
        armed_at = asyncio.get_running_loop().time()

        await arm_trace(rig.client, "x", request)
        async with asyncio.timeout(10):
            while TracePhase.WAITING not in phases:
                phases.append((await trace_header(rig.client, "x")).phase)
                await asyncio.sleep(0.02)
        filled_s = asyncio.get_running_loop().time() - armed_at

    assert set(phases[:-1]) == {TracePhase.FILLING}
    assert filled_s == pytest.approx(50 * 0.02, abs=0.1)


@pytest.mark.long
async def test_trigger_that_does_not_come_ends_the_trace_in_its_time_and_frees_the_line():
    async with running_rig() as rig:
        await ready(rig)
        request = TakeTrace(channels=("velocity",), trigger=rising(40.0), timeout_s=2.0)

        with pytest.raises(DriveFault, match="the trigger did not come within 2 s"):
            await take_trace(rig.client, "x", request, within_s=60)
        header = await trace_header(rig.client, "x")
        before = rig.daemon.rig.buses[0].bus.statistics.exchanges
        await asyncio.sleep(1)
        polled = rig.daemon.rig.buses[0].bus.statistics.exchanges - before

    assert (header.phase, header.chunks) == (TracePhase.TIMED_OUT, 0)
    assert polled < 120


async def test_trigger_without_its_level_is_refused_and_nothing_is_armed():
    async with running_rig() as rig:
        await ready(rig)

        with pytest.raises(ValueOutOfRange, match="needs a level"):
            await arm_trace(rig.client, "x", TakeTrace(channels=("velocity",), trigger=rising(None)))

        with pytest.raises(WrongState, match="no trace is under way"):
            await rig.client.command("x", AbortTrace())


async def test_second_trace_is_refused_until_the_first_is_aborted():
    async with running_rig() as rig:
        await ready(rig)
        request = TakeTrace(channels=("velocity",), trigger=rising(40.0))
        first = await arm_trace(rig.client, "x", request)

        with pytest.raises(BusyTracing, match=first.trace_id):
            await arm_trace(rig.client, "x", request)
        aborted = await rig.client.command("x", AbortTrace())
        header = await trace_header(rig.client, "x")
        again = await arm_trace(rig.client, "x", request)
        await rig.client.command("x", AbortTrace())
        with pytest.raises(WrongState, match="no trace is under way"):
            await rig.client.command("x", AbortTrace())

    assert (aborted.trace_id, header.phase) == (first.trace_id, TracePhase.ABORTED)
    assert again.trace_id != first.trace_id


@pytest.mark.parametrize("replaced", [False, True])
@pytest.mark.sweep(2)
async def test_who_stops_waiting_ends_his_own_trace_and_no_other(replaced):
    async with running_rig() as rig:
        await ready(rig)
        request = TakeTrace(channels=("velocity",), trigger=rising(40.0))

        async def wait() -> None:
            async with armed_trace(rig.client, "x", request):
                if replaced:
                    await rig.client.command("x", AbortTrace())
                    await arm_trace(rig.client, "x", request)
                await asyncio.Event().wait()

        with pytest.raises(TimeoutError):
            await asyncio.wait_for(wait(), 3)
        header = await trace_header(rig.client, "x")

    assert header.phase is (TracePhase.WAITING if replaced else TracePhase.ABORTED)


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (TakeTrace(channels=("torque",)), "cannot trace 'torque'; there are position, velocity"),
        (TakeTrace(channels=("position", "position")), "named twice"),
        (TakeTrace(channels=("position",), trigger=rising(1.0)), "which is not recorded"),
        (TakeTrace(channels=("velocity",), trigger=rising(1.0), pre_trigger=500), "leave none of 500"),
        (TakeTrace(channels=("position",), interval_s=0.0001), "a poll takes up to"),
    ],
)
@pytest.mark.sweep(2)
async def test_impossible_request_is_refused_with_the_reason(request_, reason):
    async with running_rig() as rig:
        await ready(rig)

        with pytest.raises(ValueOutOfRange, match=reason):
            await arm_trace(rig.client, "x", request_)
        header = await trace_header(rig.client, "x")

    assert header is None


async def test_axis_says_what_can_be_traced():
    async with running_rig() as rig:
        axes = {axis.axis: axis for axis in await rig.client.axes()}

    assert axes["x"].trace_channels[:3] == ("position", "velocity", "following_error")
    assert {"trace", "trace_abort"} <= set(axes["x"].capabilities)


@pytest.mark.long
async def test_every_ldcn_and_nmc_drive_of_the_rig_is_traced_faster_than_it_is_polled():
    async with running_rig() as rig:
        rates_hz = {}
        for axis in ("x", "y", "z", "c"):
            await rig.until(axis, lambda state: state.link == "up")
            trace = await take_trace(
                rig.client, axis, TakeTrace(channels=("position", "velocity", "enabled"), samples=200), within_s=60
            )
            rates_hz[axis] = 199 / (trace.offsets_ns[-1] * 1e-9)

    assert all(rate > 100 for rate in rates_hz.values()), rates_hz


@pytest.mark.long
async def test_a_lost_line_ends_the_trace_at_once_and_the_next_one_works():
    config = load_config(SIMULATED)
    line = config.sim[0]
    unplugged = LineFault(FaultKind.UNPLUGGED, from_s=5.0, until_s=5.1, longest_s=0.5)
    chain = build_chain(replace(line.spec(), faults=FaultPlan((unplugged,))))
    async with running_rig(config, {line.name: chain}) as rig:
        await rig.until("x", lambda state: state.link == "up")
        request = TakeTrace(channels=("position",), samples=10_000)
        reply = await arm_trace(rig.client, "x", request)
        header = await wait_for_trace(rig.client, "x", reply.trace_id, 60)
        ended_at_s = asyncio.get_running_loop().time()
        await rig.until("x", lambda state: state.link == "up")
        again = await take_trace(rig.client, "x", TakeTrace(channels=("position",), samples=20), within_s=60)

    assert (header.phase, header.chunks) == (TracePhase.FAILED, 0)
    assert "was lost while it was traced" in header.problem
    assert ended_at_s < 6.0
    assert len(again.offsets_ns) == 20


@pytest.mark.long
async def test_a_stop_on_the_traced_line_waits_for_the_poll_on_the_wire_only():
    async with running_rig() as rig:
        await ready(rig)
        bus, loop = rig.daemon.rig.buses[0].bus, asyncio.get_running_loop()
        longest_s = bus.longest_s(rig.daemon.rig.axes["x"].driver.reading(frozenset(TelemetryItem)))
        await rig.client.stop("y")
        began_s = loop.time()
        await rig.client.stop("y")
        alone_s = loop.time() - began_s
        await arm_trace(rig.client, "x", TakeTrace(channels=("position",), samples=10_000))

        waits_s = []
        for _ in range(50):
            began_s = loop.time()
            await rig.client.stop("y")
            waits_s.append(loop.time() - began_s)
            await asyncio.sleep(0.0137)
        header = await trace_header(rig.client, "x")

    assert header.phase is TracePhase.RECORDING
    assert max(waits_s) <= alone_s + longest_s + 0.001
