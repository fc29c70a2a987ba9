"""Who may move what, and what happens when someone disappears, on the jumping clock."""

import asyncio
from functools import partial

import pytest

from ldcnd.client.events import latest_events
from ldcnd.client.lease import control
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import (
    Halt,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    QuickStop,
    Reset,
    Stop,
    Verb,
)
from ldcnd.contract.errors import (
    CommandExpired,
    CommandIdReused,
    DuplicateDaemon,
    LeaseExpired,
    LeaseHeld,
    LeaseRequired,
    StaleSequence,
    UnknownAxis,
)
from ldcnd.contract.events import CommandStatus, ReadEvents, ReadOutcome
from ldcnd.contract.leases import SHORTEST_LEASE_S, Acquire, ListHolders
from ldcnd.contract.questions import Why
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import AxisState, Moving
from ldcnd.drives.driver import StopMode
from ldcnd.drives.line_config import GroupConfig
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.rig import EPOCH_NS, SIMULATED, running_rig

ACTED_WITHIN_S = 0.02
"""From the end of a lease until the axis brakes: the exchange under way, and the stop's own."""


def leased():
    return load_config(SIMULATED).model_copy(update={"authority": "leased"})


async def test_a_leased_rig_moves_under_a_lease_only():
    async with running_rig(leased()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        with pytest.raises(LeaseRequired):
            await rig.client.command("x", Power(on=True))

        async with control(rig.client, "ann", "x") as held:
            await held.command("x", Power(on=True))
            reply = await held.command("x", MoveAbsolute(position=30.0))
            state = await rig.client.wait_for_end("x", reply.command_id)

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        holders = await rig.client.ask(ListHolders())
        assert {holder.client for holder in holders.holders} == {None}


async def test_the_state_of_an_axis_says_who_controls_it_however_that_changes():
    async with running_rig(leased()) as rig:
        await rig.until("x", lambda state: state.link == "up" and state.holder is None)
        async with control(rig.client, "ann", "x", lease_s=1.0):
            await rig.until("x", lambda state: state.holder == "ann")
            async with control(rig.client, "bob", "x", lease_s=1.0, force=True):
                await rig.until("x", lambda state: state.holder == "bob")
            await rig.until("x", lambda state: state.holder is None)
        await rig.client.ask(Acquire(client="eve", axes=("x", "y"), lease_s=0.5))
        for axis in ("x", "y"):
            await rig.until(axis, lambda state: state.holder == "eve")
        for axis in ("x", "y"):  # which is not renewed
            await rig.until(axis, lambda state: state.holder is None)


@pytest.mark.promise("stop-in-any-state")
async def test_stop_and_halt_never_need_a_lease():
    async with running_rig(leased()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x") as held:
            await held.command("x", Power(on=True))
            await held.command("x", MoveVelocity(velocity=10.0))
            await rig.client.command("x", Halt())
            await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
            await held.command("x", MoveVelocity(velocity=10.0))

            reply = await rig.client.stop("x")

            assert reply.confirmed == ("x",)
            await rig.until("x", lambda state: state.state is AxisState.STANDSTILL and state.stop_latched)


@pytest.mark.promise("loss-of-control")
@pytest.mark.parametrize("lease_s", [SHORTEST_LEASE_S, 0.3, 1.0])
@pytest.mark.sweep(2)
async def test_an_axis_halts_when_its_client_disappears(lease_s):
    async with running_rig(leased()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        lease = await rig.client.ask(Acquire(client="ann", axes=("x",), lease_s=lease_s))
        loop = asyncio.get_running_loop()
        acquired_s = loop.time()
        under = {"lease": lease.lease}
        await rig.client.command("x", Power(on=True, **under))
        await rig.client.command("x", MoveVelocity(velocity=10.0, **under))

        await rig.until("x", lambda state: state.state is AxisState.STOPPING)
        assert lease_s <= loop.time() - acquired_s <= lease_s + ACTED_WITHIN_S
        state = await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)

        assert not state.stop_latched
        for stale in (MoveVelocity(velocity=10.0, **under), MoveVelocity(velocity=-10.0, **under)):
            with pytest.raises(LeaseExpired):
                await rig.client.command("x", stale)


async def test_somebody_else_is_refused_and_may_take_over_by_force():
    async with running_rig() as rig:
        await rig.power_on("x")
        bob = RigClient(rig.session, "sim")
        async with control(rig.client, "ann", "x") as held:
            with pytest.raises(LeaseHeld, match="ann"):
                await bob.command("x", MoveAbsolute(position=1.0))
            with pytest.raises(LeaseHeld):
                async with control(bob, "bob", "x"):
                    pass

            async with control(bob, "bob", "x", force=True) as taken:
                await taken.command("x", MoveAbsolute(position=1.0))
                with pytest.raises(LeaseExpired):
                    await held.command("x", MoveAbsolute(position=2.0))


async def test_a_lease_on_a_group_covers_its_members():
    config = load_config(SIMULATED)
    group = GroupConfig(name="gantry", axes=("x", "y"))
    bus = config.bus[0].model_copy(update={"group": (group,)})
    async with running_rig(config.model_copy(update={"bus": (bus,)})) as rig:
        lease = await rig.client.ask(Acquire(client="ann", axes=("gantry", "z")))

        assert lease.axes == ("x", "y", "z")


async def test_commands_under_a_lease_never_go_backwards():
    async with running_rig() as rig:
        await rig.power_on("x")
        async with control(rig.client, "ann", "x") as held:
            lease = held.lease.lease
            await rig.client.command("x", Reset(lease=lease, sequence=9))

            with pytest.raises(StaleSequence):
                await rig.client.command("x", Reset(lease=lease, sequence=9))


async def test_a_repeated_id_moves_once_and_is_answered_alike():
    async with running_rig() as rig:
        await rig.power_on("x")
        step = MoveRelative(distance=2.0, command_id="step-1")

        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(rig.client.command("x", step)) for _ in range(5)]
        await rig.client.wait_for_end("x", "step-1")
        again = await rig.client.command("x", step)

        assert {task.result() for task in tasks} == {again}
        outcome = await rig.client.ask(ReadOutcome(command_id="step-1"))
        assert outcome.status is CommandStatus.DONE
        assert again.position == pytest.approx(2.0)
        with pytest.raises(CommandIdReused):
            await rig.client.command("x", MoveRelative(distance=3.0, command_id="step-1"))


async def test_a_repeated_stop_stops_again():
    async with running_rig() as rig:
        await rig.power_on("x")
        stop = QuickStop(command_id="stop-1")
        await rig.client.command("x", stop)
        await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        await rig.client.command("x", Reset())
        await rig.client.command("x", MoveVelocity(velocity=10.0))

        await rig.client.command("x", stop)

        state = await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        assert state.stop_latched


async def test_a_command_that_comes_too_late_is_not_carried_out():
    async with running_rig() as rig:
        await rig.power_on("x")
        now_ns = EPOCH_NS + round(asyncio.get_running_loop().time() * 1e9)

        late = MoveAbsolute(position=5.0, not_after=now_ns - 1)
        with pytest.raises(CommandExpired):
            await rig.client.command("x", late)
        foreign = MoveAbsolute(position=5.0, instance="another")
        with pytest.raises(CommandExpired, match="another run"):
            await rig.client.command("x", foreign)

        assert (await rig.client.state("x")).state is AxisState.STANDSTILL


@pytest.mark.parametrize("stop", [Halt(), Stop(), QuickStop(), Power(on=False)], ids=lambda stop: stop.verb)
async def test_what_was_asked_for_before_a_stop_is_not_carried_out_behind_it(stop):
    async with running_rig() as rig:
        await rig.power_on("x", "y")
        asked = {axis: (await rig.client.state(axis)).stops for axis in "xy"}
        moved = MoveRelative(distance=0.1, command_id="moved", after_stops=asked["x"])
        first = await rig.client.command("x", moved)
        ended = await rig.client.command("x", stop)
        shown = await rig.until("x", lambda state: state.moving is Moving.NO and not state.stop_pending)

        for late in (Reset(), Power(on=True), MoveRelative(distance=1.0)):
            with pytest.raises(CommandExpired, match="came after this was asked for"):
                await rig.client.command("x", late.model_copy(update={"after_stops": asked["x"]}))
        assert await rig.client.command("x", moved) == first  # a repetition begins nothing
        assert shown.stops == ended.stops == asked["x"] + 1
        await rig.client.command("y", MoveRelative(distance=1.0, after_stops=asked["y"]))
        for behind in (Reset(), Power(on=True), MoveRelative(distance=1.0)):
            await rig.client.command("x", behind.model_copy(update={"after_stops": ended.stops}))


@pytest.mark.parametrize(
    "ask", [RigClient.stop, partial(RigClient.ask, command=SetSpeedOverride(percent=0))], ids=["stop", "override"]
)
async def test_a_stop_names_none_of_the_stops_that_came_while_it_waited_for_its_drives(ask):
    """A reset from before such a stop was carried out behind it."""
    async with running_rig() as rig:
        await rig.power_on("x", "y")
        await rig.client.command("y", MoveVelocity(velocity=1.0))
        asked = (await rig.client.state("x")).stops
        driver, held = rig.daemon.rig.axes["y"].driver, asyncio.Event()
        stop = driver.stop

        async def slow(mode: StopMode) -> StopMode:
            await held.wait()
            return await stop(mode)

        driver.stop = slow
        first = asyncio.create_task(ask(rig.client))
        await rig.until("x", lambda state: state.stops == asked + 1)
        other = await rig.client.stop("x")
        held.set()
        own = await first
        await rig.until("x", lambda state: state.moving is Moving.NO and not state.stop_pending)

        assert (own.stops["x"], other.stops["x"]) == (asked + 1, asked + 2)
        with pytest.raises(CommandExpired, match="came after this was asked for"):
            await rig.client.command("x", Reset(after_stops=own.stops["x"]))
        await rig.client.command("x", Reset(after_stops=other.stops["x"]))


async def test_the_events_tell_who_did_what_with_which_result():
    async with running_rig() as rig:
        await rig.power_on("x")
        async with control(rig.client, "ann", "x") as held:
            reply = await held.command("x", MoveAbsolute(position=90.0))
            await asyncio.sleep(0.5)
            await rig.client.stop("x")
            await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)

        events = await rig.client.ask(ReadEvents(axis="x"))
        story = [(event.status, event.client) for event in events.events if event.command_id == reply.command_id]
        assert story == [
            (CommandStatus.ACCEPTED, "ann"),
            (CommandStatus.EXECUTING, "ann"),
            (CommandStatus.ABORTED, "ann"),
        ]
        aborted, stopped = events.events[-2:]
        assert aborted.reason == "aborted by stop"
        assert (stopped.verb, stopped.status, stopped.client) == (Verb.STOP, CommandStatus.DONE, None)
        assert [event.seq for event in events.events] == list(range(len(events.events)))


async def test_the_events_tell_who_has_stopped_what():
    async with running_rig() as rig, rig.broker.session(login="operator") as session:
        await rig.power_on("x")
        ann = RigClient(session, rig.client.rig)
        await ann.stop("x", client="ann")
        await ann.stop(client="ann, whose name is longer than any name in the events is allowed to be")

        events = await latest_events(rig.client, 5)

    assert {(event.verb, event.status, event.login) for event in events} == {("stop", "done", "operator")}
    assert [(event.axis, event.client) for event in events] == [
        ("x", "ann"),
        *((axis, "ann, whose name is longer than any name in the events is allowed") for axis in "xyzc"),
    ]


@pytest.mark.parametrize("payload", [b"", b"\xff\xff", b"[1]", b'{"client": 7}', b'{"client": "ann", "axis": "y"}'])
@pytest.mark.sweep(2)
async def test_a_stop_that_does_not_say_who_it_is_from_is_carried_out_and_told_all_the_same(payload):
    async with running_rig() as rig:
        await rig.power_on("x")

        (answer,) = await rig.session.query("ldcn/sim/@stop/x", payload)
        (event,) = await latest_events(rig.client, 1)

        assert not answer.is_error
        assert (await rig.client.state("x")).stop_latched
        assert (event.axis, event.verb, event.status, event.client) == ("x", "stop", CommandStatus.DONE, None)


async def test_a_stop_that_no_drive_confirms_is_told_as_that():
    chain = build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))
    async with running_rig(chains={"line0": chain}) as rig:
        await rig.power_on("x")
        chain.modules[0].power(on=False, at_s=asyncio.get_running_loop().time())

        reply = await rig.client.stop("x", timeout_s=60.0, client="ann")
        event = next(event for event in reversed(await latest_events(rig.client, 5)) if event.verb == Verb.STOP)

    assert reply.confirmed == ()
    assert (event.status, event.client) == (CommandStatus.UNKNOWN, "ann")
    assert event.reason == "the drive did not confirm it yet; the axis is latched"


async def test_two_daemons_on_one_rig_refuse_motion():
    async with running_rig() as rig:
        await rig.power_on("x")
        other = await rig.session.declare_token("ldcn/sim/alive/second")

        with pytest.raises(DuplicateDaemon, match="second"):
            await rig.client.command("x", MoveAbsolute(position=1.0))
        assert (await rig.client.stop("x")).confirmed == ("x",)

        await other.close()
        await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        await rig.client.command("x", Reset())


async def test_why_lists_everything_that_is_in_the_way():
    async with running_rig(leased()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        await rig.client.stop("x")

        reply = await rig.client.ask(Why(), "x")

        assert not reply.can_move
        assert [cause.code for cause in reply.causes] == ["lease_required", "stop_latched", "wrong_state"]
        assert [cause.remedy for cause in reply.causes] == [
            "acquire one first",
            "send reset",
            'send power {"on": true}',
        ]


async def test_nothing_is_in_the_way_of_an_axis_that_is_ready():
    async with running_rig() as rig:
        await rig.power_on("x")
        await asyncio.sleep(0.2)

        assert (await rig.client.ask(Why(), "x")).can_move


async def test_an_error_under_a_lease_is_raised_as_itself():
    async with running_rig() as rig:
        with pytest.raises(UnknownAxis):
            async with control(rig.client, "ann", "x") as held:
                await held.command("nowhere", Power(on=True))

        async with control(rig.client, "bob", "x"):
            pass  # ann's lease was given back all the same
