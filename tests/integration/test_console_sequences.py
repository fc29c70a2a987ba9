"""Sequences that pages run: under control of their page, as long as it is there, judged by the simulated centrifuge."""

import asyncio
from contextlib import asynccontextmanager

import pytest

from ldcnd.client.lease import acquire
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import Halt
from ldcnd.contract.leases import ListHolders
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.samples import Moving
from ldcnd.contract.sequences import NamedPosition
from tests.support.console_rig import open_page, running_console
from tests.support.process import ROOT

CENTRIFUGE = load_config(ROOT / "config" / "centrifuge.toml")
RIG = "/api/rigs/centrifuge"


@pytest.fixture
async def console():
    async with running_console(CENTRIFUGE) as running:
        yield running


@asynccontextmanager
async def at_work(console):
    """Open a page that controls the rotor."""
    async with open_page(console.app, console.browser) as page:
        await page.take("centrifuge", "rotor")
        yield page


async def offered(console):
    answer = await console.browser.get("/api/rigs")
    return {(each["kind"], each["name"]): each for each in answer.document["rigs"][0]["can_run"]["runnables"]}


async def run(console, page, name, kind="sequence", **more):
    mark = (await offered(console))[kind, name]["mark"]
    return await page.post(f"{RIG}/run", {"kind": kind, "name": name, "mark": mark, **more})


async def until(console, wanted):
    async with asyncio.timeout(300):
        while not wanted(told := console.told_of_rig("centrifuge", "run")):
            await asyncio.sleep(0.05)
    return told


async def ended(console):
    return await until(console, lambda told: told["end"])


async def spins(console):
    """Return when the rotor runs at the velocity of the sequence."""
    await until(console, lambda told: told["step"] == 4 or told["end"])
    await console.rig.until("rotor", lambda state: state.moving is Moving.YES)


async def holder(console):
    (told,) = (await console.rig.client.ask(ListHolders())).holders
    return told.client


async def test_pages_are_told_what_can_be_run_in_words(console):
    found = await offered(console)

    assert [*found] == [("sequence", "shut"), ("sequence", "spin"), ("position", "bucket1"), ("position", "bucket2")]
    assert found["sequence", "spin"]["steps"][5] == "go to bucket1 (rotor 0.1 rev)"
    assert found["position", "bucket2"]["steps"] == ["go to bucket2 (rotor 0.6 rev)"]
    assert found["sequence", "spin"]["first"] == [{"axis": "rotor", "verb": "power", "waits": True}]
    assert found["position", "bucket2"]["first"] == [{"axis": "rotor", "verb": "move_absolute", "waits": False}]


async def test_a_run_has_control_under_the_name_of_its_page_and_gives_it_back(console):
    async with at_work(console) as page:
        begun = await run(console, page, "shut")
        during = await until(console, lambda told: told["step"] >= 2)
        by_hand = await page.post(f"{RIG}/axes/rotor/move_relative", {"distance": 1.0})
        held = await holder(console)
        end = await ended(console)
        after = await page.post(f"{RIG}/axes/rotor/power", {"on": True})

    assert begun.status == 200, begun.document
    assert (during["client"], held) == (page.client, page.client)
    assert (by_hand.document["code"], "sequence shut moves it" in by_hand.document["message"]) == ("wrong_state", True)
    assert (end["end"], end["step"], end["of"]) == ("done", 4, 4)
    assert after.status == 200, after.document


async def test_a_second_press_begins_nothing(console):
    async with at_work(console) as page:
        answers = await asyncio.gather(*(run(console, page, "shut") for _ in range(3)))
        assert (await ended(console))["end"] == "done"

    assert sorted(answer.status for answer in answers) == [200, 409, 409]
    refused = max(answers, key=lambda answer: answer.status).document
    assert "sequence shut runs on rig centrifuge" in refused["message"]
    assert refused["remedy"] == "stop it, or wait for its end"


async def test_nothing_runs_without_control_nor_what_the_page_did_not_show(console):
    async with open_page(console.app, console.browser) as page:
        uncontrolled = await run(console, page, "spin")
        await page.take("centrifuge", "rotor")
        another = await page.post(f"{RIG}/run", {"kind": "sequence", "name": "spin", "mark": "0"})
        unknown = await page.post(f"{RIG}/run", {"kind": "position", "name": "spin", "mark": "0"})
    pageless = await run(console, console.browser, "spin")

    assert [each.document["code"] for each in (uncontrolled, another, unknown, pageless)] == [
        "lease_required",
        "wrong_state",
        "wrong_state",
        "lease_expired",
    ]
    assert console.told_of_rig("centrifuge", "run") is None


async def test_a_run_that_was_pressed_before_a_halt_and_comes_behind_it_begins_nothing(console):
    async with at_work(console) as page:
        pressed = (await console.rig.client.state("rotor")).stops
        halted = await console.rig.client.command("rotor", Halt())
        await run(console, page, "shut", after_stops={"rotor": pressed})
        late = await ended(console)
        state = await console.rig.client.state("rotor")
        await run(console, page, "shut", after_stops={"rotor": state.stops})
        behind = await ended(console)

    assert (late["end"], late["step"], late["error"]["code"]) == ("failed", 0, "command_expired")
    assert halted.stops == pressed + 1
    assert behind["end"] == "done"


async def test_a_run_that_was_asked_for_before_what_runs_was_stopped_begins_nothing(console, monkeypatch):
    client, asked, stopped = console.rigs.client("centrifuge"), asyncio.Event(), asyncio.Event()
    read = client.read

    async def slowly(*what):
        asked.set()
        await stopped.wait()
        return await read(*what)

    async with at_work(console) as page:
        mark = (await offered(console))["sequence", "shut"]["mark"]
        monkeypatch.setattr(client, "read", slowly)
        running = asyncio.create_task(page.post(f"{RIG}/run", {"kind": "sequence", "name": "shut", "mark": mark}))
        await asked.wait()
        assert (await console.browser.post(f"{RIG}/run/stop")).status == 200
        stopped.set()
        refused = await running

    assert refused.document["code"] == "command_expired"
    assert console.told_of_rig("centrifuge", "run") is None


@pytest.mark.long
async def test_stop_of_any_page_halts_the_rotor_and_the_page_keeps_control(console):
    async with at_work(console) as page:
        await run(console, page, "shut")
        await ended(console)
        await run(console, page, "spin")
        await spins(console)
        stopped = await console.browser.post(f"{RIG}/run/stop")
        end = await ended(console)
        await console.rig.until("rotor", lambda state: state.moving is Moving.NO)
        held = await holder(console)

    assert stopped.status == 200
    assert (end["end"], end["step"]) == ("stopped", 4)
    assert held == page.client
    assert not (await console.rig.client.state("rotor")).stop_latched


@pytest.mark.long
@pytest.mark.promise("page-that-closes")
async def test_a_page_that_goes_ends_its_run(console):
    async with at_work(console) as page:
        await run(console, page, "shut")
        await ended(console)
        await run(console, page, "spin")
        await spins(console)

    end = await ended(console)
    await console.rig.until("rotor", lambda state: state.moving is Moving.NO)
    assert (end["end"], await holder(console)) == ("stopped", None)


@pytest.mark.long
async def test_another_client_that_takes_control_ends_it(console):
    async with at_work(console) as page:
        await run(console, page, "shut")
        await ended(console)
        await run(console, page, "spin")
        await spins(console)
        await acquire(console.rig.client, "another", ("rotor",), 60, force=True)
        end = await ended(console)
        told = await page.told()
        await console.rig.until("rotor", lambda state: state.moving is Moving.NO)

    assert (end["end"], end["error"]["code"]) == ("failed", "lease_expired")
    assert (told["lost"]["axis"], told["lost"]["taken_by"]) == ("rotor", "another")


@pytest.mark.long
@pytest.mark.parametrize("path", ["/api/stop", f"{RIG}/stop"])
async def test_a_stop_ends_it_although_the_next_steps_move_nothing(console, path):
    async with at_work(console) as page:
        await run(console, page, "shut")
        await until(console, lambda told: told["step"] >= 2)
        await page.post(path)
        end = await ended(console)

    assert end["end"] == "stopped"


@pytest.mark.long
async def test_a_paused_run_waits_before_its_next_step_and_only_its_page_has_it_go_on(console):
    async with at_work(console) as page, open_page(console.app, console.browser) as other:
        await run(console, page, "shut")
        paused = await page.post(f"{RIG}/run/pause", {"on": True})
        waits = await until(console, lambda told: told["waits"])
        await asyncio.sleep(30)
        still = console.told_of_rig("centrifuge", "run")
        refused = await other.post(f"{RIG}/run/pause", {"on": False})
        await page.post(f"{RIG}/run/pause", {"on": False})
        end = await ended(console)

    assert paused.status == 200
    assert waits == still
    assert refused.document["code"] == "wrong_state"
    assert end["end"] == "done"


async def test_a_step_that_fails_says_why_and_is_kept_until_the_next_run(console):
    async with at_work(console) as page:
        await run(console, page, "bucket1", "position")
        failed = await ended(console)
        assert console.told_of_rig("centrifuge", "run") == failed
        await run(console, page, "shut")
        assert (await ended(console))["end"] == "done"

    assert (failed["end"], failed["step"]) == ("failed", 1)
    assert failed["error"]["remedy"]


@pytest.mark.long
async def test_a_daemon_that_is_started_again_has_nothing_run(console):
    async with at_work(console) as page:
        await run(console, page, "shut")
        await until(console, lambda told: told["step"] >= 1)
        await console.rig.begin_anew(2.0, killed=True)
        end = await ended(console)
        await asyncio.sleep(20)
        after = console.told_of_rig("centrifuge", "run")

    assert end["end"] == "failed"
    assert after == end
    assert await holder(console) is None
    assert abs(console.rig.lives.truth("rotor").velocity) < 0.05


async def test_after_a_reload_pages_have_what_the_daemon_has_and_press_nothing_of_before(console):
    before = (await offered(console))["position", "bucket2"]
    other = NamedPosition(name="bucket2", axes={"rotor": 0.7})
    (plan,) = await console.rig.client.read(console.rig.client.keys.budget, RigBudget)
    console.rig.daemon.reconfigure(CENTRIFUGE.model_copy(update={"position": (other,), "sequence": ()}), plan)

    async with at_work(console) as page:
        wanted = {name: before[name] for name in ("kind", "name", "mark")}
        refused = await page.post(f"{RIG}/run", wanted)
        async with asyncio.timeout(30):
            while len(now := await offered(console)) != 1:
                await asyncio.sleep(0.1)

    assert refused.document["code"] == "wrong_state"
    assert "is another one since the configuration was read again" in refused.document["message"]
    assert now["position", "bucket2"]["steps"] == ["go to bucket2 (rotor 0.7 rev)"]
