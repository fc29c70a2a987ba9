"""What stands between an axis and a module of a SECoP node, on a whole daemon; clients try the node itself."""

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from types import MappingProxyType

import pytest

from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import MoveAbsolute
from ldcnd.contract.errors import LdcndError, LeaseRequired, OutcomeUnknown, PositionLimit, WrongState
from ldcnd.contract.leases import Acquire, ListHolders
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.lab.secop.link import StatusCode, linked
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.lost_answers import losing
from tests.support.rig import running_rig, two_axes


@asynccontextmanager
async def linked_x(chains=MappingProxyType({}), former_units=MappingProxyType({}), clock_off_s=lambda: 0.0):
    updates = []
    async with running_rig(two_axes(), chains, clock_off_s=clock_off_s) as running:
        await running.until("x", lambda state: state.link is LinkState.UP)
        rig = Rig(running.client, await running.client.daemon())
        infos = {info.axis: info for info in await rig.describe() if info.axis == "x"}
        async with linked(rig, infos, updates.append, ("x",), former_units) as links:
            await links["x"].power_on()
            yield running, links["x"], updates


async def becomes(link, code: StatusCode) -> str:
    async with asyncio.timeout(30):
        while link.status()[0] != code:
            await asyncio.sleep(0.05)
    return link.status()[1]


async def test_a_target_is_reached_and_busy_is_shown_before_the_reply():
    async with linked_x() as (running, link, updates):
        await becomes(link, StatusCode.IDLE)
        updates.clear()
        await link.go(3.0)
        shown = [update.value for update in updates if update.parameter == "status"]
        await becomes(link, StatusCode.IDLE)
        places = [update for update in updates if (update.module, update.parameter) == ("x", "value")]

        assert shown[-1][0] == StatusCode.BUSY
        assert link.status() == (StatusCode.IDLE, "")
        assert places[-1].value == pytest.approx(3, abs=0.02)
        assert all(0.001 <= update.error < 0.2 for update in places)
        assert (await running.client.state("x")).target == pytest.approx(3)


@pytest.mark.parametrize("pace_s", [0.0, 0.005, 0.02])
async def test_of_targets_right_behind_each_other_the_newest_wins(pace_s: float):
    async with linked_x() as (running, link, _):
        async with asyncio.TaskGroup() as group:
            for goal in (7.0, 7.5, -3.0, 2.0):
                group.create_task(link.go(goal), name=f"to {goal}")
                await asyncio.sleep(pace_s)
        await becomes(link, StatusCode.IDLE)

        assert (await running.client.position("x")).value == pytest.approx(2, abs=0.02)


async def test_a_new_target_sends_a_moving_axis_elsewhere_and_a_stop_halts_it():
    async with linked_x() as (running, link, _):
        await link.go(50.0)
        await running.until("x", lambda state: state.moving is Moving.YES)
        await link.go(1.0)
        await becomes(link, StatusCode.IDLE)
        reached = (await running.client.position("x")).value
        await link.go(50.0)
        await running.until("x", lambda state: state.moving is Moving.YES)
        await link.stop()
        await becomes(link, StatusCode.IDLE)
        state = await running.client.state("x")

        assert reached == pytest.approx(1, abs=0.02)
        assert state.stop_latched is False
        assert (await running.client.position("x")).value < 30


async def test_a_stop_halts_an_axis_of_which_the_node_does_not_know_that_it_moves():
    async with linked_x() as (running, link, _):
        await becomes(link, StatusCode.IDLE)
        link.speed = 2.0
        link.take = lambda _: None  # from here on nothing of the axis is heard
        with losing(running.session, answers={"move_absolute"}, commands={"halt"}), pytest.raises(OutcomeUnknown):
            await link.go(60.0)
        assert not link.is_busy()
        await link.stop()
        await running.until("x", lambda state: state.moving is Moving.NO and state.command is None)

        assert (await running.client.position("x")).value < 40
        assert (await running.client.state("x")).stop_latched is False


@pytest.mark.parametrize("ending", ["stop", "power off"])
async def test_what_another_program_moves_is_brought_to_rest_although_nothing_can_be_read(ending: str):
    loop = asyncio.get_running_loop()
    async with linked_x() as (running, link, _):
        await asyncio.sleep(31)  # control is given back
        taken = await running.client.ask(Acquire(client="ann", axes=("x",), lease_s=60))
        await running.client.command("x", MoveAbsolute(position=90.0, velocity=5.0, lease=taken.lease))
        await becomes(link, StatusCode.BUSY)
        with losing(running.session, commands={"state", "position"}):
            asked_s = loop.time()
            await (link.stop() if ending == "stop" else link.power_off())
            took_s = loop.time() - asked_s
        state = await running.until("x", lambda state: state.moving is Moving.NO)

        assert took_s < 1.0
        assert (await running.client.position("x")).value < 20.0
        assert (state.enabled, state.stop_latched) == ((True, True) if ending == "stop" else (False, False))


@pytest.mark.parametrize("controls", [True, False])
async def test_a_stop_of_an_axis_that_stands_is_no_error_and_changes_nothing(controls):
    def told(state):
        return state.state, state.enabled, state.referenced, state.stop_latched, state.target, state.command

    async with linked_x() as (running, link, _):
        await link.go(3.0)
        await becomes(link, StatusCode.IDLE)
        if not controls:
            await asyncio.sleep(31)
        before = await running.client.state("x")
        await link.stop()
        await asyncio.sleep(1)
        after = await running.client.state("x")

    assert (before.holder is not None) == controls
    assert told(after) == told(before)


async def test_a_latch_is_an_error_that_is_cleared_and_limits_are_refused():
    async with linked_x() as (running, link, _):
        await link.go(50.0)
        await running.client.stop("x")
        said = await becomes(link, StatusCode.ERROR)
        assert (await running.client.state("x")).moving is not Moving.YES, "an axis that brakes is busy"
        with pytest.raises(LdcndError, match="latch"):
            await link.go(1.0)
        await running.until("x", lambda state: state.moving is Moving.NO)
        await link.clear_errors()
        await becomes(link, StatusCode.IDLE)
        with pytest.raises(PositionLimit):
            await link.go(1000.0)

        assert "latched" in said
        assert link.status()[0] == StatusCode.IDLE


async def test_a_latched_axis_is_busy_until_its_stop_is_over_and_a_reset_is_accepted():
    async with linked_x() as (running, link, _):
        await becomes(link, StatusCode.IDLE)
        await running.client.stop("x")
        stopped = await running.until("x", lambda state: state.stop_latched and state.moving is Moving.NO)
        await becomes(link, StatusCode.ERROR)
        link.take(stopped.model_copy(update={"state": AxisState.STOPPING}))

        assert link.status()[0] == StatusCode.BUSY


@pytest.mark.long
async def test_control_is_given_back_when_the_axis_idles_and_never_taken_by_force():
    async with linked_x() as (running, link, _):
        await link.go(1.0)
        await becomes(link, StatusCode.IDLE)
        await asyncio.sleep(31)
        assert not any(holder.client for holder in (await running.client.ask(ListHolders())).holders)
        await running.client.ask(Acquire(client="ann", axes=("x",), lease_s=60))
        with pytest.raises(LeaseRequired, match="ann"):
            await link.go(2.0)
        await link.stop()

        assert (await running.client.state("x")).stop_latched


async def test_a_daemon_that_says_nothing_is_an_error():
    async with linked_x() as (running, link, updates):
        await link.go(1.0)
        await becomes(link, StatusCode.IDLE)
        running.daemon.end()
        async with asyncio.timeout(3):
            while "its position is old: nothing newer came" not in {update.problem for update in updates}:
                await asyncio.sleep(0.1)
        problems = {update.module: update.problem for update in updates if update.parameter == "value"}

        assert set(problems) == {"x", "x_velocity", "x_adc"}
        assert all(problems.values()), problems
        assert link.status()[0] == StatusCode.ERROR
        for parameter in ("enabled", "target"):
            assert shown(updates, parameter).problem == "its position is old: nothing newer came"


async def test_whether_a_drive_that_does_not_answer_is_enabled_is_an_error_until_it_answers():
    async with linked_x() as (running, link, updates):
        await becomes(link, StatusCode.IDLE)
        before = shown(updates, "enabled").value, shown(updates, "target").problem
        with running.lives.faults.mute("x"):
            await becomes(link, StatusCode.ERROR)
            await running.until("x", lambda state: state.link is LinkState.DOWN)
            await asyncio.sleep(0.1)
            silent = shown(updates, "enabled"), shown(updates, "target")
        await running.until("x", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(0.1)
        after = shown(updates, "enabled")

    assert before == (True, None)
    assert all(each.value is None and each.problem for each in silent), silent
    assert (isinstance(after.value, bool), after.problem) == (True, None)


async def test_a_value_that_is_no_known_place_does_not_say_how_wrong_it_may_be():
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"), ModuleSpec("ls182ap"))))
    loop = asyncio.get_running_loop()
    async with linked_x({two_axes().bus[0].name: chain}) as (running, link, updates):
        await link.go(3.0)
        await becomes(link, StatusCode.IDLE)
        known, state = shown(updates, "value"), await running.client.state("x")
        # between two positions, too
        link.take(state.model_copy(update={"referenced": False, "reference_lost": True}))
        at_once = shown(updates, "value")
        chain.modules[0].power(on=False, at_s=loop.time())
        await running.until("x", lambda state: state.link is LinkState.DOWN)
        chain.modules[0].power(on=True, at_s=loop.time())
        await running.until("x", lambda state: state.reference_lost and state.link is LinkState.UP)
        updates.clear()
        await asyncio.sleep(1)
        later = [update for update in updates if (update.module, update.parameter) == ("x", "value")]

    assert 0.001 <= known.error < 0.2
    assert (at_once.value, at_once.at_s, at_once.error) == (known.value, known.at_s, None)
    assert {(update.problem, update.error) for update in later} == {(None, None)}
    assert "reference lost" in link.status()[1]


async def test_an_axis_that_moves_out_of_sight_has_no_target_at_the_place_where_it_was_seen_last():
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"), ModuleSpec("ls182ap"))))
    line = two_axes().bus[0].name
    async with linked_x({line: chain}) as (running, link, updates):
        await link.go(20.0)
        await asyncio.sleep(0.3)
        for place in (0, 1):
            chain.mute(place, on=True)
        await running.until("x", lambda state: state.moving is Moving.UNKNOWN)
        await asyncio.sleep(1.0)
        target = shown(updates, "target")

    assert target.value == pytest.approx(20.0) or target.problem


def shown(updates, parameter):
    return [update for update in updates if (update.module, update.parameter) == ("x", parameter)][-1]


@pytest.mark.parametrize("mover", ["node", "another program"])
@pytest.mark.parametrize("ending", ["end", "stop", "power off"])
@pytest.mark.sweep(6)
async def test_the_target_is_where_the_axis_was_sent_last_by_any_program_or_came_to_rest(mover: str, ending: str):
    async with linked_x() as (running, link, updates), AsyncExitStack() as moving:
        await link.go(1.0)
        await becomes(link, StatusCode.IDLE)
        if mover == "node":
            await link.go(9.0)
        else:
            await asyncio.sleep(31)  # control is given back
            rig = Rig(running.client, await running.client.daemon())
            other = await moving.enter_async_context(rig.control("x", client="ann"))
            await other.move_absolute(9.0)
        await running.until("x", lambda state: state.moving is Moving.YES)
        await asyncio.sleep(0.2)
        under_way = shown(updates, "target").value
        match ending:
            case "stop":
                await running.client.stop("x")
            case "power off":
                await link.power_off()
        await running.until("x", lambda state: state.moving is Moving.NO)
        await asyncio.sleep(1)
        place = (await running.client.position("x")).value

        assert under_way == 9
        assert shown(updates, "target").value == pytest.approx(9 if ending == "end" else place, abs=0.05)
        assert (abs(place - 9) < 0.05) == (ending == "end")


async def test_a_target_is_none_of_a_later_run_of_the_daemon_with_an_earlier_clock():
    off_s = [0.0]
    async with linked_x(clock_off_s=lambda: off_s[0]) as (running, link, updates):
        await link.go(60.0)
        await becomes(link, StatusCode.IDLE)
        off_s[0] = -3600.0
        await running.begin_anew(2.0, killed=True)
        await running.until("x", lambda state: state.link is LinkState.UP)
        async with Rig(running.client, await running.client.daemon()).control("x", client="ann") as x:
            await x.power(on=True)
            await x.set_position(20.0)  # nothing proves to this run where the axis is
            await (await x.move_absolute(15.0)).done()
        await becomes(link, StatusCode.IDLE)

    assert shown(updates, "target").value == pytest.approx(15.0, abs=0.05)


async def test_an_axis_that_has_got_another_unit_takes_no_target_before_a_reset():
    async with linked_x(former_units={"x": "um", "y": "um"}) as (running, link, _):
        said = await becomes(link, StatusCode.ERROR)
        with pytest.raises(WrongState, match="its unit is mm now and was um"):
            await link.go(5.0)
        await asyncio.sleep(1)
        state = await running.client.state("x")
        await link.clear_errors()
        await becomes(link, StatusCode.IDLE)
        await link.go(5.0)
        target = (await running.client.state("x")).target

    assert said == "its unit is mm now and was um, reset it"
    assert (state.moving, state.command) == (Moving.NO, None)
    assert target == pytest.approx(5)


@pytest.mark.long
async def test_no_target_of_a_daemon_with_another_unit_is_shown_as_one_in_the_unit_that_is_described():
    broker, updates = MemoryBroker(), []
    document = two_axes().model_dump(mode="json", exclude_unset=True)
    document["bus"][0]["axis"][0] |= {"unit": "um"}
    async with broker.session() as session, AsyncExitStack() as links:
        client = RigClient(session, "sim")
        async with running_rig(two_axes(), broker=broker) as first:
            await first.until("x", lambda state: state.link is LinkState.UP)
            rig = Rig(client, await client.daemon())
            infos = {info.axis: info for info in await rig.describe() if info.axis == "x"}
            await links.enter_async_context(linked(rig, infos, updates.append, ("x",)))
            await asyncio.sleep(1)
            assert shown(updates, "target").problem is None
        updates.clear()
        async with running_rig(RigConfig.model_validate(document), broker=broker) as second:
            await second.until("x", lambda state: state.link is LinkState.UP)
            async with rig.control("x", client="ann") as x:
                await x.power(on=True)
                await (await x.move_absolute(50)).done()
            await asyncio.sleep(1)

    values = [each for each in updates if each.parameter in ("value", "target") and each.module in ("x", "x_velocity")]
    assert {(each.module, each.parameter) for each in values} == {
        ("x", "value"),
        ("x", "target"),
        ("x_velocity", "value"),
    }
    assert {each.value for each in values} == {None}
    assert {each.problem for each in values if each.problem and "old" not in each.problem} == {
        "it is in um now and is described in mm",
        "it is in um/s now and is described in mm/s",
    }


@pytest.mark.parametrize("begin", ["go", "home"])
@pytest.mark.parametrize("steps", range(3, 21, 3))
async def test_nothing_begins_after_a_stop_that_came_while_control_was_taken(begin, steps):
    async with linked_x() as (running, link, _):
        await becomes(link, StatusCode.IDLE)
        await asyncio.sleep(60)  # it gives back control that it does not use
        await running.until("x", lambda state: state.holder is None)
        moving = asyncio.create_task(link.go(50.0) if begin == "go" else link.home())
        for _ in range(steps):
            await asyncio.sleep(0)
        await link.stop()
        await asyncio.gather(moving, return_exceptions=True)
        await asyncio.sleep(2)
        state, place = await running.client.state("x"), await running.client.position("x")

        assert state.moving is Moving.NO
        assert abs(place.value) < 0.5
