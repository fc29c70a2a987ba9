"""Control through the console lasts as long as the web socket of its page; then what the page moved is halted."""

import asyncio

import pytest

from ldcnd.contract.commands import Halt
from ldcnd.contract.leases import Acquire, ListHolders
from ldcnd.contract.samples import AxisState, Moving
from tests.support.console_rig import open_page, running_console

X = "/api/rigs/sim/axes/x"
RIG = "/api/rigs/sim"


@pytest.fixture
async def console():
    async with running_console() as running:
        yield running


async def holder(console, axis):
    told = await console.rig.client.ask(ListHolders())
    return next(each.client for each in told.holders if each.axis == axis)


async def running_at(console, page, velocity):
    """Let the page jog x."""
    await page.take("sim", "x")
    assert (await page.post(f"{X}/power", {"on": True})).status == 200
    await console.rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
    moved = await page.post(f"{X}/move_velocity", {"velocity": velocity})
    assert moved.status == 200, moved.document
    await console.rig.until("x", lambda state: state.moving is Moving.YES)


async def stands(console, axis):
    return (await console.rig.client.state(axis)).moving is Moving.NO


@pytest.mark.promise("page-that-closes")
async def test_a_page_that_goes_halts_what_it_moved_and_gives_up_control(console):
    async with open_page(console.app, console.browser) as page:
        await running_at(console, page, 1.0)
        assert await holder(console, "x") == page.client

    assert await stands(console, "x")
    position = await console.rig.client.last("x", "position")
    await asyncio.sleep(5)
    assert (await console.rig.client.last("x", "position")).value == pytest.approx(position.value, abs=0.01)
    assert (await console.rig.client.state("x")).state is AxisState.STANDSTILL  # halted, not latched
    assert await holder(console, "x") is None


@pytest.mark.long
async def test_control_lasts_in_a_page_that_says_nothing(console):
    async with open_page(console.app, console.browser) as page:
        await page.take("sim", "x")
        await asyncio.sleep(20)
        assert await holder(console, "x") == page.client
        assert (await page.post(f"{X}/power", {"on": True})).status == 200


@pytest.mark.long
async def test_a_move_that_still_waits_when_its_page_goes_does_not_run_on(console):
    async with open_page(console.app, console.browser) as page:
        await running_at(console, page, 1.0)
        waiting = asyncio.create_task(
            page.post(f"{X}/move_relative", {"distance": 20.0, "velocity": 1.0, "buffer_mode": "buffered"})
        )
        await asyncio.sleep(0.5)
    await waiting

    await asyncio.sleep(1)
    assert await stands(console, "x")
    position = await console.rig.client.last("x", "position")
    await asyncio.sleep(5)
    assert (await console.rig.client.last("x", "position")).value == pytest.approx(position.value, abs=0.01)


async def test_releasing_a_moving_axis_halts_it_first(console):
    async with open_page(console.app, console.browser) as page:
        await running_at(console, page, 1.0)
        released = await page.post(f"{RIG}/release", {"axes": ["x"]})

        assert released.status == 200
        assert await stands(console, "x")
        assert await holder(console, "x") is None


async def test_nothing_moves_through_the_console_without_a_page_that_has_control(console):
    await console.browser.post(f"{X}/power", {"on": True})
    await console.rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
    bare = await console.browser.post(f"{X}/move_absolute", {"position": 1.0})
    moves = [{"axis": axis, "position": 1.0} for axis in "xy"]
    together = await console.browser.post(f"{RIG}/rig/move_together", {"moves": moves})
    async with open_page(console.app, console.browser) as page:
        untaken = await page.post(f"{X}/move_absolute", {"position": 1.0})
    gone = await page.post(f"{X}/move_absolute", {"position": 1.0})
    leases = [
        await console.browser.post(f"{RIG}/rig/{verb}", {"lease_s": 5}) for verb in ("acquire", "renew", "release")
    ]

    assert [answer.document["code"] for answer in (bare, together, untaken)] == ["lease_required"] * 3
    assert gone.document["code"] == "lease_expired"
    assert {answer.status for answer in leases} == {404}
    assert await stands(console, "x")


async def test_a_page_is_told_when_its_control_is_lost(console):
    async with open_page(console.app, console.browser) as page:
        await page.take("sim", "x")
        force = Acquire(client="another", axes=("x",), lease_s=60, force=True)
        await console.rig.client.ask(force)

        told = await page.told()
        refused = await page.post(f"{X}/move_absolute", {"position": 1.0})

    assert (told["lost"]["rig"], told["lost"]["axis"]) == ("sim", "x")
    assert told["lost"]["message"]
    assert told["lost"]["taken_by"] == "another"
    assert refused.document["code"] == "lease_required"


async def test_two_pages_of_one_browser_do_not_take_from_each_other_unasked(console):
    async with open_page(console.app, console.browser) as one, open_page(console.app, console.browser) as other:
        await one.take("sim", "x")
        refused = await other.post(f"{RIG}/control", {"axes": ["x"]})
        taken = await other.post(f"{RIG}/control", {"axes": ["x"], "force": True})

    assert (refused.status, refused.document["code"]) == (409, "lease_held")
    assert taken.status == 200
    assert one.client != other.client


async def test_the_name_of_a_page_is_worth_nothing_to_another_visitor(console):
    stranger = await console.enter()
    async with open_page(console.app, console.browser) as page:
        await page.take("sim", "x")
        stolen = await stranger.forging(x_ldcnd_page=page.name).post(f"{X}/power", {"on": True})

    assert stolen.document["code"] == "lease_expired"


async def test_control_is_of_axes_not_of_what_else_has_a_name(console):
    async with open_page(console.app, console.browser) as page:
        answers = [await page.post(f"{RIG}/control", {"axes": axes}) for axes in (["w"], ["*"], [""], [])]

    assert [answer.status for answer in answers] == [404, 404, 404, 400]


async def jogging(console, page, velocity):
    """Begin to jog x by the page's web socket; returns once it moves."""
    await page.take("sim", "x")
    await page.post(f"{X}/power", {"on": True})
    await console.rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
    page.say({"jog": {"rig": "sim", "axis": "x", "velocity": velocity}})
    await console.rig.until("x", lambda state: state.moving is Moving.YES)


async def test_more_axes_than_two_lines_have_fit_in_one_request(console):
    many = {"axes": [f"a{number}" for number in range(66)]}
    async with open_page(console.app, console.browser) as page:
        assert (await page.post(f"{RIG}/release", many)).status == 200  # what it does not control is passed over
        assert (await page.post(f"{RIG}/control", many)).document["code"] == "unknown_axis"  # not: too many


async def test_a_jog_runs_for_as_long_as_the_page_says_that_it_is_held(console):
    async with open_page(console.app, console.browser) as page:
        await jogging(console, page, 1.0)
        for _ in range(30):
            page.say({"held": True})
            await asyncio.sleep(0.1)
        assert not await stands(console, "x")
        page.say({"held": False})
        await asyncio.sleep(0.5)

        assert await stands(console, "x")
        assert await holder(console, "x") == page.client


@pytest.mark.promise("page-that-closes")
async def test_a_jog_ends_when_nothing_is_heard_of_the_hand_that_holds_it(console):
    async with open_page(console.app, console.browser) as page:
        await jogging(console, page, 1.0)
        await asyncio.sleep(1.0)

        assert await stands(console, "x")


async def shown(console, axis):
    """Return how many stops pages show of an axis."""
    return (await console.rig.client.state(axis)).stops


async def enabled(console, page, *axes):
    """Let the page control axes that are enabled; returns how many stops it shows of each."""
    await page.take("sim", *axes)
    for axis in axes:
        assert (await page.post(f"{RIG}/axes/{axis}/power", {"on": True})).status == 200
        await console.rig.until(axis, lambda state: state.state is AxisState.STANDSTILL)
    return {axis: await shown(console, axis) for axis in axes}


@pytest.mark.parametrize("whose", ["its own", "of another page", "of a program"])
async def test_what_was_pressed_before_a_halt_and_comes_behind_it_moves_nothing(console, whose):
    async with open_page(console.app, console.browser) as page, open_page(console.app, console.browser) as other:
        pressed = await enabled(console, page, "x", "y")
        if whose == "of a program":
            halted = (await console.rig.client.command("x", Halt())).stops
        else:
            answer = await (page if whose == "its own" else other).post(f"{X}/halt")
            halted = answer.document["stops"]
        moves = [{"axis": axis, "position": 1.0, "after_stops": pressed[axis]} for axis in "xy"]
        late = [
            await page.post(f"{X}/move_relative", {"distance": 1.0, "after_stops": pressed["x"]}),
            await page.post(f"{RIG}/rig/move_together", {"moves": moves}),
            await page.post(f"{X}/set_gains", {"kp": 90, "after_stops": pressed["x"]}),
        ]
        page.say({"jog": {"rig": "sim", "axis": "x", "velocity": 1.0, "after_stops": pressed["x"]}})
        jog = await page.told()
        stood = await stands(console, "x") and await stands(console, "y")
        beside = await page.post(f"{RIG}/axes/y/move_relative", {"distance": 1.0, "after_stops": pressed["y"]})
        behind = await page.post(f"{X}/move_relative", {"distance": 1.0, "after_stops": halted})
        off = await page.post(f"{X}/power", {"on": False, "after_stops": pressed["x"]})

    assert [each.document.get("code") for each in late] == ["command_expired"] * 3
    assert "came after this was asked for" in late[0].document["message"]
    assert jog["refused"]["code"] == "command_expired"
    assert stood
    assert [each.status for each in (beside, behind, off)] == [200, 200, 200]  # energy is taken out never too late


async def test_a_jog_is_not_refused_for_the_end_of_the_one_before_but_for_the_halt_of_another_client(console):
    async with open_page(console.app, console.browser) as page:
        pressed = (await enabled(console, page, "x"))["x"]  # faster than another count comes to the page
        begun = {None}
        for velocity in (1.0, -1.0, 1.0):
            page.say({"jog": {"rig": "sim", "axis": "x", "velocity": velocity, "after_stops": pressed}})
            jogs = await console.rig.until(
                "x",
                lambda state: (
                    state.command and (state.command.verb, state.command.command_id in begun) == ("jog", False)
                ),
            )
            begun.add(jogs.command.command_id)
            page.say({"held": False})
        await console.rig.until("x", lambda state: state.state is AxisState.STANDSTILL and state.stops > pressed + 2)
        step = await page.post(f"{X}/move_relative", {"distance": 0.1, "after_stops": pressed})
        await console.rig.client.command("x", Halt())
        page.say({"jog": {"rig": "sim", "axis": "x", "velocity": 1.0, "after_stops": pressed}})
        refused = await page.told()

    assert step.status == 200, step.document
    assert refused["refused"]["code"] == "command_expired"


async def test_a_speed_that_was_pressed_before_the_end_of_all_motions_does_not_come_behind_it(console):
    async with open_page(console.app, console.browser) as page:
        speed = f"{RIG}/rig/set_speed_override"
        pressed = {axis: await shown(console, axis) for axis in "xy"}
        none = await console.browser.post(speed, {"percent": 0})
        late = await page.post(speed, {"percent": 50, "after_stops": pressed})
        behind = await page.post(speed, {"percent": 50, "after_stops": none.document["stops"]})

    assert late.document["code"] == "command_expired"
    assert behind.document["percent"] == 50


@pytest.mark.promise("page-that-closes")
async def test_a_jog_that_waits_for_the_halt_of_the_one_before_begins_only_while_it_is_held(console, monkeypatch):
    client, slow = console.rigs.client("sim"), []
    command = client.command

    async def slowly(axis, asked, *more):
        reply = await command(axis, asked, *more)
        if asked.verb == "halt":
            slow.append(axis)
            await asyncio.sleep(2.0)
        return reply

    async with open_page(console.app, console.browser) as page:
        await enabled(console, page, "x", "y")
        monkeypatch.setattr(client, "command", slowly)
        page.say({"jog": {"rig": "sim", "axis": "x", "velocity": 1.0}})
        await console.rig.until("x", lambda state: state.moving is Moving.YES)
        page.say({"held": False})
        page.say({"jog": {"rig": "sim", "axis": "x", "velocity": 1.0}})
        page.say({"jog": {"rig": "sim", "axis": "y", "velocity": 1.0}})
        jogs_y = (await console.rig.until("y", lambda state: state.command)).command.verb
        page.say({"jog": {"rig": "sim", "axis": "x", "velocity": 1.0}})  # and the page falls silent
        await console.rig.until("x", lambda state: state.moving is Moving.NO)
        await asyncio.sleep(0.3)
        before = await console.rig.client.last("x", "position")
        await asyncio.sleep(5.0)
        after = await console.rig.client.last("x", "position")

    assert (jogs_y, slow[0]) == ("jog", "x")
    assert after.value == pytest.approx(before.value, abs=0.01)


async def test_a_jog_needs_control_and_says_why_it_does_not_run(console):
    async with open_page(console.app, console.browser) as page:
        page.say({"jog": {"rig": "sim", "axis": "x", "velocity": 1.0}})
        untaken = await page.told()
        await page.take("sim", "x")
        page.say({"jog": {"rig": "sim", "axis": "x", "velocity": 1.0}})
        disabled = await page.told()

    assert untaken["refused"]["code"] == "lease_required"
    assert disabled["refused"]["code"] == "wrong_state"


async def test_a_page_that_says_nonsense_on_its_socket_is_closed(console):
    async with open_page(console.app, console.browser) as page:
        page.say({"jog": {"rig": "sim", "axis": "x", "velocity": "fast"}})
        async with asyncio.timeout(60):
            while page.socket.closed is None:
                await asyncio.sleep(0.1)

    assert page.socket.closed == 1008
