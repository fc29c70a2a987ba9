"""Permission is asked when a motion begins, not when its command arrives; on the jumping clock."""

import asyncio
from contextlib import asynccontextmanager

import pytest

from ldcnd.client.events import latest_events
from ldcnd.client.lease import Control, control
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import (
    BufferMode,
    CommandReply,
    Halt,
    Home,
    Jog,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    Stop,
    Track,
)
from ldcnd.contract.errors import (
    DuplicateDaemon,
    LeaseExpired,
    PositionLimit,
    StopLatched,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import AxisState
from ldcnd.drives.axis_config import LossConfig, LossPolicy
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive, rig_on, simulated_config
from tests.support.rig import EPOCH_NS, SIMULATED, RunningRig, running_rig

FIRST_TARGET = 20.0
MODELS = ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")


def config(policy: LossPolicy = LossPolicy.RUN_TO_TARGET, authority: str = "leased") -> RigConfig:
    rig = load_config(SIMULATED)
    bus = rig.bus[0]
    axes = tuple(axis.model_copy(update={"loss": LossConfig(client=policy)}) for axis in bus.axis)
    return rig.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),), "authority": authority})


def now_ns() -> int:
    return EPOCH_NS + round(asyncio.get_running_loop().time() * 1e9)


@asynccontextmanager
async def moving_to_first_target(rig: RunningRig, lease_s: float = 60.0):
    """Hold x, on the way to its first target, for four seconds or so."""
    await rig.until("x", lambda state: state.link == "up")
    async with control(rig.client, "ann", "x", lease_s=lease_s) as held:
        await held.command("x", Power(on=True))
        await held.command("x", MoveAbsolute(position=FIRST_TARGET, velocity=5.0))
        yield held


def buffered(rig: RunningRig, held: Control, **fields: object) -> "asyncio.Task[CommandReply]":
    """Send a move that waits for the one under way."""
    request = MoveAbsolute(position=60.0, buffer_mode=BufferMode.BUFFERED, **fields)
    return asyncio.create_task(held.command("x", request, 30.0), name="buffered")


async def stays_at_first_target(rig: RunningRig) -> None:
    await asyncio.sleep(8.0)
    position = await rig.client.last("x", "position")
    assert position.value == pytest.approx(FIRST_TARGET, abs=0.05)


@pytest.mark.long
async def test_a_buffered_move_that_has_become_too_late_is_refused():
    async with running_rig(config()) as rig, moving_to_first_target(rig) as held:
        waiting = buffered(rig, held, not_after=now_ns() + 500_000_000)
        assert await rig.refusal(await waiting) == "command_expired"
        await stays_at_first_target(rig)


@pytest.mark.promise("permission-at-motion")
@pytest.mark.long
async def test_a_buffered_move_of_a_lease_that_was_released_is_refused():
    async with running_rig(config()) as rig:
        async with moving_to_first_target(rig) as held:
            waiting = buffered(rig, held)
            await asyncio.sleep(0.5)
        async with control(rig.client, "bob", "x", lease_s=60.0):
            assert await rig.refusal(await waiting) == "lease_expired"
            await stays_at_first_target(rig)


@pytest.mark.long
async def test_a_buffered_move_of_a_lease_that_was_taken_by_force_is_refused():
    async with running_rig(config()) as rig:
        async with moving_to_first_target(rig) as held:
            waiting = buffered(rig, held)
            await asyncio.sleep(0.5)
            async with control(rig.client, "bob", "x", lease_s=60.0, force=True):
                assert await rig.refusal(await waiting) == "lease_expired"
                await stays_at_first_target(rig)


@pytest.mark.long
async def test_a_buffered_move_of_a_client_that_died_is_refused_although_its_axis_runs_to_its_target():
    async with running_rig(config()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x", lease_s=1.0) as held:
            await held.command("x", Power(on=True))
            await held.command("x", MoveAbsolute(position=FIRST_TARGET, velocity=5.0))
            waiting = buffered(rig, held)
            await asyncio.sleep(0.5)
            rig.daemon._dispatcher.authority.expire(float("inf"))  # nothing was renewed
            assert await rig.refusal(await waiting) == "lease_expired"
        await stays_at_first_target(rig)


@pytest.mark.long
async def test_a_buffered_move_is_refused_once_another_daemon_serves_the_rig():
    async with running_rig(config()) as rig, moving_to_first_target(rig) as held:
        waiting = buffered(rig, held)
        await asyncio.sleep(0.5)
        rig.daemon._dispatcher.rivals.add("other")
        assert await rig.refusal(await waiting) == "duplicate_daemon"
        rig.daemon._dispatcher.rivals.clear()
        await stays_at_first_target(rig)


async def test_a_buffered_move_without_a_lease_is_refused_once_its_axis_is_held():
    async with running_rig(config(authority="open")) as rig:
        await rig.power_on("x")
        await rig.client.command("x", MoveAbsolute(position=FIRST_TARGET, velocity=5.0))
        request = MoveAbsolute(position=60.0, buffer_mode=BufferMode.BUFFERED)
        waiting = asyncio.create_task(rig.client.command("x", request, 30.0))
        await asyncio.sleep(0.5)
        async with control(rig.client, "bob", "x", lease_s=60.0):
            assert await rig.refusal(await waiting) == "lease_held"
            await stays_at_first_target(rig)


@pytest.mark.long
async def test_a_buffered_move_goes_on_under_a_lease_that_its_holder_has_widened():
    async with running_rig(config()) as rig, moving_to_first_target(rig) as held:
        waiting = buffered(rig, held)
        await asyncio.sleep(0.5)
        async with control(rig.client, "ann", "x", "y", lease_s=60.0):
            reply = await waiting
            await rig.client.wait_for_end("x", reply.command_id)
        assert (await rig.client.last("x", "position")).value == pytest.approx(60.0, abs=0.05)


@pytest.mark.promise("refused-abort-halts-nothing")
@pytest.mark.parametrize(
    "command",
    [
        MoveAbsolute(position=1e6, buffer_mode=BufferMode.ABORTING),
        MoveRelative(distance=1e6, buffer_mode=BufferMode.ABORTING),
        MoveVelocity(velocity=1.0, acceleration=0.00001, buffer_mode=BufferMode.ABORTING),
    ],
)
@pytest.mark.sweep(2)
async def test_an_aborting_move_that_is_refused_halts_nothing(command):
    async with running_rig(config()) as rig, moving_to_first_target(rig) as held:
        before = (await rig.client.state("x")).command.command_id
        with pytest.raises((ValueOutOfRange, PositionLimit)):
            await held.command("x", command)
        state = await rig.client.state("x")
        assert (state.state, state.command.command_id) == (AxisState.DISCRETE_MOTION, before)
        await stays_at_first_target(rig)


async def test_an_aborting_move_halts_and_then_moves():
    async with running_rig(config()) as rig, moving_to_first_target(rig) as held:
        request = MoveAbsolute(position=3.0, buffer_mode=BufferMode.ABORTING)
        reply = await held.command("x", request, 30.0)
        await rig.client.wait_for_end("x", reply.command_id)
        assert (await rig.client.last("x", "position")).value == pytest.approx(3.0, abs=0.05)


async def test_a_stop_between_the_halt_and_the_start_of_an_aborting_move_wins():
    async with running_rig(config()) as rig, moving_to_first_target(rig) as held:
        request = MoveAbsolute(position=3.0, buffer_mode=BufferMode.ABORTING)
        aborting = asyncio.create_task(held.command("x", request, 30.0))
        await rig.until("x", lambda state: state.state is AxisState.STOPPING)
        await rig.client.stop("x")
        with pytest.raises(StopLatched):
            await aborting
        state = await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        assert state.stop_latched


@pytest.mark.promise("permission-at-motion")
@pytest.mark.long
async def test_a_homing_whose_lease_was_lost_begins_no_further_leg():
    """The axis stands on its switch: the first leg moves off it; the search would be the second one."""
    rig_config = config()
    bus = rig_config.bus[0]
    axes = tuple(
        axis.model_copy(update={"home": axis.home.model_copy(update={"move_to": None})}) if axis.name == "y" else axis
        for axis in bus.axis
    )
    async with running_rig(rig_config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})) as rig:
        await rig.until("y", lambda state: state.link == "up")
        async with control(rig.client, "ann", "y", lease_s=60.0) as held:
            await held.command("y", Power(on=True))
            reply = await held.command("y", Home())
            await rig.until("y", lambda state: state.state is AxisState.STANDSTILL)
            reply = await held.command("y", Home())
            rig.daemon._dispatcher.authority.expire(float("inf"))
            state = await rig.client.wait_for_end("y", reply.command_id)
            assert "lease" in (state.last_error or ""), state
            assert not state.referenced


async def test_a_stream_of_set_points_ends_with_its_lease():
    rig_config = config()
    bus = rig_config.bus[0]
    axes = tuple(
        axis.model_validate(axis.model_dump() | {"tracking": {"step": 0.4, "rate": 50.0}}) if axis.name == "z" else axis
        for axis in bus.axis
    )
    rig_config = rig_config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
    async with running_rig(rig_config) as rig:
        await rig.until("z", lambda state: state.link == "up")
        async with control(rig.client, "ann", "z", lease_s=60.0) as held:
            await held.command("z", Power(on=True))
            await held.command("z", Track(position=0.1))
            rig.daemon._dispatcher.authority.expire(float("inf"))
            with pytest.raises(LeaseExpired):
                await held.command("z", Track(position=0.2))


async def test_a_stop_that_comes_while_the_loop_is_being_closed_leaves_it_open():
    async with running_rig(config(authority="open")) as rig:
        await rig.until("x", lambda state: state.link == "up")
        axis = rig.daemon.rig.axes["x"]
        power_of, stops = axis.driver.power, []

        async def power(*, on: bool) -> None:
            stops.append(asyncio.ensure_future(axis.execute(Stop())))
            await asyncio.sleep(0)
            await asyncio.gather(*stops)
            await power_of(on=on)

        axis.driver.power = power
        with pytest.raises(StopLatched):
            await rig.client.command("x", Power(on=True))
        state = await rig.until("x", lambda state: state.stop_latched)
        await asyncio.sleep(1.0)
        assert not (await rig.client.state("x")).enabled, state


async def test_limits_are_those_of_the_plan_at_the_start():
    async with running_rig(config()) as rig, moving_to_first_target(rig) as held:
        with pytest.raises(PositionLimit):
            await held.command("x", MoveAbsolute(position=1e6, buffer_mode=BufferMode.BUFFERED), 30.0)


@pytest.mark.promise("one-id-one-motion")
@pytest.mark.long
async def test_a_replay_after_thousands_of_halts_is_answered_and_moves_nothing():
    async with running_rig(config(authority="open")) as rig:
        await rig.power_on("x")
        step = MoveRelative(distance=2.0, command_id="step")
        first = await rig.client.command("x", step)
        await rig.client.wait_for_end("x", first.command_id)
        for number in range(600):
            await rig.client.command("y", Halt(command_id=f"halt-{number}"))

        assert await rig.client.command("x", step) == first
        await asyncio.sleep(1.0)
        assert (await rig.client.last("x", "position")).value == pytest.approx(2.0, abs=0.05)


async def test_what_is_refused_at_once_leaves_one_event():
    async with running_rig(config(authority="open")) as rig:
        await rig.until("x", lambda state: state.link == "up")
        with pytest.raises(WrongState):
            await rig.client.command("x", MoveRelative(distance=2.0))
        events = [event for event in await latest_events(rig.client, 100) if event.axis == "x"]
        assert [(event.status, event.number) for event in events] == [("refused", 0)]


BUSY = 30
"""Reads that are queued before a packet: on this line they take 50 ms or more."""


def busy_line_before(rig: RunningRig, monkeypatch, call: str) -> asyncio.Event:
    """Queue reads on the line of x directly before its driver queues a packet; the event says when they are there."""
    axis, queued = rig.daemon.rig.axes["x"], asyncio.Event()
    bus, original = rig.daemon.rig.buses[0].bus, getattr(axis.driver, call)

    async def behind_reads(*args: object, **options: object) -> None:
        reads = [asyncio.create_task(bus.execute(axis.driver.reading(frozenset()))) for _ in range(BUSY)]
        await asyncio.sleep(0)
        queued.set()
        try:
            await original(*args, **options)
        finally:
            await asyncio.wait(reads)

    monkeypatch.setattr(axis.driver, call, behind_reads)
    return queued


@pytest.mark.promise("permission-at-motion")
@pytest.mark.parametrize("call", ["load", "start"])
@pytest.mark.sweep(2)
async def test_a_packet_that_waits_for_the_line_is_not_sent_once_its_lease_has_ended(call, monkeypatch):
    async with running_rig(config(LossPolicy.RUN_TO_TARGET)) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x", lease_s=60.0) as held:
            await held.command("x", Power(on=True))
            queued = busy_line_before(rig, monkeypatch, call)
            move = asyncio.create_task(held.command("x", MoveRelative(distance=5.0)), name="move")
            await queued.wait()
        with pytest.raises(LeaseExpired):
            await move
        await asyncio.sleep(1.0)
        position, state = await rig.client.last("x", "position"), await rig.client.state("x")

    assert position.value == pytest.approx(0.0, abs=0.05)
    assert (state.state, state.moving) == (AxisState.STANDSTILL, "no")


async def test_a_loop_that_waits_for_the_line_is_not_closed_once_its_lease_has_ended(monkeypatch):
    async with running_rig(config(LossPolicy.RUN_TO_TARGET)) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x", lease_s=60.0) as held:
            queued = busy_line_before(rig, monkeypatch, "power")
            power = asyncio.create_task(held.command("x", Power(on=True)), name="power")
            await queued.wait()
        with pytest.raises(LeaseExpired):
            await power
        state = await rig.until("x", lambda state: state.state is AxisState.DISABLED)

    assert not state.enabled


async def test_nothing_is_moved_until_the_last_of_several_other_daemons_has_gone():
    async with running_rig(config(authority="open")) as rig:
        await rig.until("x", lambda state: state.link == "up")
        keys = Keys(rig.daemon.rig.name)
        second = await rig.session.declare_token(keys.alive("second"))
        third = await rig.session.declare_token(keys.alive("third"))
        await asyncio.sleep(0.1)
        for others, gone in (("second, third", third), ("second", second)):
            with pytest.raises(DuplicateDaemon, match=rf"\({others}\)"):
                await rig.client.command("x", Power(on=True))
            await gone.close()
            await asyncio.sleep(0.1)

        await rig.client.command("x", Power(on=True))


@pytest.mark.parametrize("after_s", [0.0, 0.001, 0.003, 0.006, 0.01, 0.02, 0.05])
@pytest.mark.parametrize(
    "command", [Jog(velocity=5.0, hold_s=1.0), MoveVelocity(velocity=5.0), Home()], ids=lambda each: each.verb
)
@pytest.mark.sweep(3)
async def test_no_motion_begins_once_the_daemon_ends(command, after_s, tmp_path):
    chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS)))
    settings = simulated_config(baud=19_200).model_copy(update={"state_dir": tmp_path})
    async with rig_on(chain, settings) as rig:
        await rig.until("z", lambda state: state.link == "up")
        await rig.until("x", lambda state: state.link == "up")
        for name in ("x", "z"):
            await rig.client.command(name, Power(on=True))
        await rig.client.command("x", MoveVelocity(velocity=5.0))  # keeps the end waiting
        commanded = asyncio.create_task(rig.client.command("z", command, 5.0))
        await asyncio.sleep(after_s)
        rig.daemon.end()
        await asyncio.wait([rig.running])
        await asyncio.wait([commanded])
        commanded.exception()

        await asyncio.sleep(1.0)
        before = drive(chain, 3).shaft.position_counts
        await asyncio.sleep(2.0)
        assert drive(chain, 3).shaft.position_counts == pytest.approx(before, abs=5)


async def test_a_stop_at_the_end_of_the_daemon_is_sent_for_as_long_as_there_is_time():
    chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS)))
    async with rig_on(chain, simulated_config()) as rig:
        await rig.power_on("x")
        await rig.client.command("x", MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.5)
        now_s = asyncio.get_running_loop().time()
        lost = LineFault(FaultKind.REQUEST_LOST, 1.0, now_s, until_s=now_s + 1.2)
        chain.injector = FaultInjector(FaultPlan((lost,)))
        rig.daemon.end()
        await asyncio.wait([rig.running])

        await asyncio.sleep(1.0)
        before = drive(chain, 1).shaft.position_counts
        await asyncio.sleep(1.0)
        assert drive(chain, 1).shaft.position_counts == pytest.approx(before, abs=5)
