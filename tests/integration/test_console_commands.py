"""Commands of pages reach the rig as the pages meant them, once, and come back as the rig answered."""

import asyncio

import pytest

from ldcnd.client.events import latest_events
from ldcnd.client.traces import arm_trace, fetch_trace, wait_for_trace
from ldcnd.console import reading
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.samples import AxisState
from ldcnd.contract.traces import TakeTrace
from tests.support.console_rig import open_page, running_console

X = "/api/rigs/sim/axes/x"
RIG = "/api/rigs/sim/rig"


@pytest.fixture
async def console():
    async with running_console() as running:
        yield running


async def test_an_axis_is_powered_moved_and_arrives(console):
    async with open_page(console.app, console.browser) as page:
        await page.take("sim", "x")
        powered = await page.post(f"{X}/power", {"on": True})
        await console.rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        moved = await page.post(f"{X}/move_absolute", {"position": 2.5})

        arrived = await console.rig.client.wait_for_end("x", moved.document["command_id"])

    assert (powered.status, moved.status) == (200, 200)
    assert moved.document["position"] == 2.5
    assert arrived.state is AxisState.STANDSTILL
    assert (await console.rig.client.last("x", "position")).value == pytest.approx(2.5, abs=0.05)


async def test_questions_about_an_axis_are_answered(console):
    why = await console.browser.post(f"{X}/why")
    plan = await console.browser.post(f"{X}/preview", {"position": 5.0})

    assert why.document["can_move"] is False
    assert plan.status == 200, plan.document


async def test_commands_go_under_the_visitor_s_name_whatever_they_say(console):
    await console.browser.post(f"{X}/power", {"on": True, "client": "another"})

    events = (await console.rig.client.ask(ReadEvents())).events
    assert {event.client for event in events} == {"console-1"}


async def test_moves_together_go_under_the_page_s_name_and_leases(console):
    moves = [{"axis": axis, "position": 1.0, "client": "another"} for axis in "xy"]

    async with open_page(console.app, console.browser) as page:
        await page.take("sim", "x", "y")
        answer = await page.post(f"{RIG}/move_together", {"moves": moves})

        events = (await console.rig.client.ask(ReadEvents())).events
    assert answer.document["code"] == "wrong_state"  # as the daemon says: nothing is enabled
    assert {event.axis for event in events} == {"x", "y"}
    assert {event.client for event in events} == {page.client}


async def test_a_command_is_meant_for_the_daemon_that_the_page_has_seen(console):
    stale = await console.browser.post(f"{X}/power", {"on": True, "instance": "before the restart"})
    fresh = await console.browser.post(f"{X}/power", {"on": True})

    assert (stale.status, stale.document["code"]) == (409, "command_expired")
    assert fresh.status == 200


async def test_stops_need_no_lease_and_latch(console):
    async with open_page(console.app, await console.enter()) as other:
        await other.take("sim", *"xyzc")

        one = await console.browser.post("/api/rigs/sim/stop", {"axis": "x"})
        every = await console.browser.post("/api/stop")
        told = await latest_events(console.rig.client, 5)

    assert one.document["axes"] == ["x"]
    assert set(every.document["rigs"]["sim"]["axes"]) == {"x", "y", "z", "c"}
    assert (await console.rig.client.state("z")).stop_latched
    assert [(event.axis, event.verb) for event in told] == [(axis, "stop") for axis in "xxyzc"]
    assert {event.client for event in told} == {"console-1"}


async def test_a_stop_overtakes_the_commands_before_it(console):
    async with asyncio.TaskGroup() as group:
        before = [
            group.create_task(console.browser.post("/api/rigs/sim/axes/z/set_gains", {"kp": kp}), name="gains")
            for kp in range(100, 160)
        ]
        await asyncio.sleep(0.002)

        stopped = await console.browser.post("/api/rigs/sim/stop")

    codes = [task.result().document.get("code") for task in before]
    assert set(stopped.document["confirmed"]) == {"x", "y", "z", "c"}
    assert "stop_latched" in codes
    assert codes.count(None) < 5


@pytest.mark.parametrize(
    ("path", "body", "status", "code"),
    [
        (f"{X}/power", b"{", 400, "malformed_request"),
        (f"{X}/power", b"[]", 400, "malformed_request"),
        (f"{X}/power", b'{"on": 1}', 400, "malformed_request"),
        (f"{X}/power", b'{"on": true, "speed": 1}', 400, "malformed_request"),
        (f"{X}/move_absolute", b'{"position": NaN}', 400, "malformed_request"),
        (f"{X}/power", b'{"on": true}' + b" " * 20_000, 400, "payload_too_large"),
        ("/api/rigs/sim/stop", b'{"axes": "x"}', 400, "malformed_request"),
        (f"{X}/fly", b"{}", 404, "unknown_verb"),
        (f"{RIG}/fly", b"{}", 404, "unknown_verb"),
        ("/api/rigs/sim/axes/w/halt", b"{}", 404, "unknown_axis"),
        ("/api/rigs/none/axes/x/halt", b"{}", 404, "unknown_axis"),
        ("/api/rigs/none/stop", b"{}", 404, "unknown_axis"),
        (f"{X}/move_absolute", b'{"position": 1.0}', 409, "lease_required"),
        (f"{X}/read_alarms", b"{}", 409, "not_supported"),
    ],
)
@pytest.mark.sweep(2)
async def test_what_cannot_be_done_is_refused_in_the_public_form(console, path, body, status, code):
    answer = await console.browser.post(path, body)

    assert (answer.status, answer.document["code"]) == (status, code)
    assert answer.document["message"]


async def test_an_axis_with_an_impossible_name_does_not_exist(console):
    assert (await console.browser.post("/api/rigs/sim/axes/*/halt")).status in (404, 409)
    assert (await console.browser.post("/api/rigs/*/stop")).status == 404


async def test_the_rigs_are_described(console):
    document = (await console.browser.get("/api/rigs")).document

    rig = document["rigs"][0]
    assert document["client"] == "console-1"
    assert document["endpoints"] == [{"endpoint": "memory", "connected": True, "problem": None}]
    assert (rig["name"], rig["connected"], rig["problem"]) == ("sim", True, None)
    assert [axis["axis"] for axis in rig["axes"]] == ["x", "y", "z", "c"]
    assert rig["plan"]["holds"]
    assert {command["verb"] for command in rig["commands"]["commands"]} >= {"power", "acquire", "why"}


async def test_a_trace_is_served_as_document_and_as_table(console):
    none = await console.browser.get(f"{X}/trace")
    reply = await arm_trace(console.rig.client, "x", TakeTrace(channels=("position",), samples=50))
    await wait_for_trace(console.rig.client, "x", reply.trace_id, 60)

    document = (await console.browser.get(f"{X}/trace")).document
    table = await console.browser.get(f"{X}/trace.csv")

    taken = await fetch_trace(console.rig.client, "x")
    assert (none.status, none.document["code"]) == (404, "wrong_state")
    assert document["offsets_ns"] == list(taken.offsets_ns)
    assert document["values"] == [list(column) for column in taken.values]
    assert table.headers["content-type"].startswith("text/csv")
    assert table.body.decode().splitlines()[1].startswith("offset_ns,position [mm]")
    assert len(table.body.splitlines()) == 52


async def test_what_a_fault_means_is_shown(console):
    shown = await console.browser.get("/faults/overcurrent")
    unknown = await console.browser.get("/faults/undercurrent")
    elsewhere = await console.browser.get("/faults/..%2fovercurrent")

    assert (shown.status, unknown.status, elsewhere.status) == (200, 404, 404)
    assert b"<h1>overcurrent" in shown.body
    assert b"no page" in unknown.body


def test_what_looks_like_html_in_a_page_stays_text():
    html = reading.as_html("# Too much\n\n<script>alert(1)</script>\n\n| a | b |\n|---|---|\n")

    assert "<h1>Too much</h1>" in html
    assert "<script>" not in html
    assert "<table>" in html


@pytest.mark.promise("energy-out-always-sent")
@pytest.mark.parametrize(
    ("verb", "body"),
    [
        ("halt", {"speed": 3}),
        ("quick_stop", b"now!"),
        ("stop", b"a" * 20_000),
        ("power", {"on": False, "client": 7, "speed": 3}),
        ("power", {"on": "off"}),
    ],
)
@pytest.mark.sweep(2)
async def test_what_takes_energy_out_is_sent_whatever_else_is_wrong_with_it_or_its_page(console, verb, body):
    async with open_page(console.app, console.browser) as page:
        await page.take("sim", "x")
        await page.post(f"{X}/power", {"on": True})
        await page.post(f"{X}/move_velocity", {"velocity": 5.0})
        await console.rig.until("x", lambda state: state.moving == "yes")
        answer = await console.browser.forging(x_ldcnd_page="gone").post(f"{X}/{verb}", body)
        off = verb == "power"
        await console.rig.until("x", lambda state: not state.enabled if off else state.moving == "no")

    assert answer.status == 400
    assert "was carried out, but" in answer.document["message"]


@pytest.mark.promise("energy-out-always-sent")
async def test_a_speed_override_of_0_needs_no_page_and_any_other_one_does(console):
    async with open_page(console.app, console.browser) as page:
        await page.take("sim", "x")
        await page.post(f"{X}/power", {"on": True})
        await page.post(f"{X}/move_velocity", {"velocity": 5.0})
        await console.rig.until("x", lambda state: state.moving == "yes")
        gone = console.browser.forging(x_ldcnd_page="gone")
        refused = await gone.post("/api/rigs/sim/rig/set_speed_override", {"percent": 50})
        answer = await gone.post("/api/rigs/sim/rig/set_speed_override", {"percent": 0})
        await console.rig.until("x", lambda state: state.moving == "no")

    assert refused.status != 200
    assert (answer.status, answer.document["confirmed"], answer.document["shortfall"]) == (200, ["x"], "")


@pytest.mark.promise("energy-out-always-sent")
async def test_a_stop_of_which_cannot_be_read_what_it_is_for_stops_the_rig(console):
    answer = await console.browser.post("/api/rigs/sim/stop", {"axes": ["x"]})

    assert (answer.status, "the whole rig was stopped" in answer.document["message"]) == (400, True)
    assert all([(await console.rig.client.state(axis)).stop_latched for axis in "xyzc"])
