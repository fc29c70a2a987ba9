"""The commissioning page, as its web socket sees it: the same steps, the button that is held, and a page that goes."""

import asyncio
import json
import os
import re
import select

import pytest
import serial

from ldcnd import parts
from ldcnd.bench.commissioning.record import CommissioningRecord, StepState
from ldcnd.config.rig import load_config
from ldcnd.console.commissioning.messages import FromCommissioningPage, PersonAnswer, View
from ldcnd.console.commissioning.page_person import HELD_S
from ldcnd.console.commissioning.scan_conversation import ScanConversation
from ldcnd.contract.errors import ErrorCode
from ldcnd.contract.leases import ListHolders
from ldcnd.contract.samples import Moving
from ldcnd.daemon.reload import Reloader
from tests.support.commissioning import AXIS, GAINS, commissioning_rig, rig_text
from tests.support.commissioning_page import (
    COMMAND,
    OpenCommissioning,
    ViewerSession,
    commissioning_console,
    commissioning_page,
    told_to,
)
from tests.support.console_rig import page, running_console


@pytest.fixture(autouse=True)
def state_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@pytest.fixture
async def rig(tmp_path):
    async with commissioning_rig(tmp_path) as running:
        yield running


@pytest.fixture
async def console(rig):
    async with commissioning_console(rig) as running:
        yield running


def record(rig):
    path = rig.config.with_name("commissioning-bench-x.json")
    return (
        CommissioningRecord.model_validate_json(path.read_text())
        if path.exists()
        else CommissioningRecord(rig="bench", axis=AXIS)
    )


async def holder(rig):
    told = await rig.running.client.ask(ListHolders())
    return next(each.client for each in told.holders if each.axis == AXIS)


async def stands(rig):
    state = await rig.running.client.state(AXIS)
    return state.moving is Moving.NO


async def test_a_step_is_explained_asked_for_and_kept_under_the_name_that_was_given(rig, console):
    async with commissioning_page(console) as opened:
        await opened.until(lambda view: view.steps)
        opened.say(begin="load", by="ada")
        question = (await opened.until(lambda view: view.question)).question
        explained = opened.view.lines
        await opened.answer("run it", "yes")
        await opened.answer("what falls", "hangs")
        await opened.answer("a remark", "<b>strap</b>")
        await opened.ended()

    assert question.kind == "choice"
    assert [each.word for each in question.choices] == ["yes", "skip", "no"]
    assert any("nothing moves" in line for line in explained)
    assert opened.state("load") == "done"
    assert opened.state("settings") == "not needed"
    kept = record(rig).of("load")
    assert (kept.by, kept.result.figures[1].value) == ("ada", "<b>strap</b>")


async def test_a_proposal_is_shown_as_a_change_and_written_on_consent(rig, console):
    async with commissioning_page(console) as opened:
        await opened.begin("travel")
        view = await opened.ended()
        assert view.problem.code == ErrorCode.VALUE_OUT_OF_RANGE  # it is not referenced

        await opened.begin("scale")
        await opened.answer("how far shall it move", "2")
        async with opened.holding("moves by 2 mm"):
            await opened.asked("how far did it go")
        await opened.answer("how far did it go", "4")
        question = (await opened.until(lambda view: view.question)).question
        opened.say(answer={"number": question.number, "text": "perhaps"})  # is none of the choices
        opened.say(answer={"number": question.number, "text": "yes"})
        view = await opened.ended()

    assert question.kind == "change"
    assert "-counts_per_unit = 1000 # as ordered" in question.lines
    assert load_config(rig.config).bus[0].axis[0].counts_per_unit == pytest.approx(500, rel=0.01)
    assert any("restart the daemon" in line for line in view.lines)


async def test_a_button_that_is_let_go_halts_the_axis(rig, console):
    async with commissioning_page(console) as opened:
        await opened.begin("scale")
        await opened.answer("how far shall it move", "15")
        async with opened.holding("moves by 15 mm") as number:
            await rig.running.until(AXIS, lambda state: state.moving is Moving.YES)
            await asyncio.sleep(0.3)
        opened.say(hold={"number": number, "on": False})
        opened.say(hold={"number": number, "on": True})  # which comes too late
        await opened.asked("how far did it go")
        assert await stands(rig)
        assert not opened.view.held


async def test_a_page_that_falls_silent_lets_the_button_go(rig, console):
    loop = asyncio.get_running_loop()
    async with commissioning_page(console) as opened:
        await opened.begin("scale")
        await opened.answer("how far shall it move", "15")
        async with opened.holding("moves by 15 mm"):
            await rig.running.until(AXIS, lambda state: state.moving is Moving.YES)
        began_s = loop.time()
        await opened.until(lambda view: not view.held)

        assert loop.time() - began_s <= HELD_S + 0.1


async def test_a_page_that_goes_while_it_holds_the_button_halts_the_axis_and_leaves_the_step_open(rig, console):
    async with commissioning_page(console) as opened:
        await opened.begin("scale")
        await opened.answer("how far shall it move", "15")
        async with opened.holding("moves by 15 mm"):
            await rig.running.until(AXIS, lambda state: state.moving is Moving.YES)
            assert await holder(rig)
            opened.socket.leave()
            await rig.running.until(AXIS, lambda state: state.moving is Moving.NO)
    async with commissioning_page(console) as again:
        await again.until(lambda view: view.steps)

    assert await holder(rig) is None
    assert abs(rig.drive.shaft.position_counts) < 14_000
    assert again.state("scale") == "open"
    assert not (await rig.running.client.state(AXIS)).stop_latched


async def test_a_page_that_goes_in_the_middle_of_a_question_leaves_record_and_control(rig, console):
    async with commissioning_page(console) as opened:
        await opened.begin("load")
        await opened.answer("what falls", "none")
        await opened.asked("a remark")
    async with commissioning_page(console) as opened:
        await opened.begin("home")
        await opened.asked("how many searches")
        assert (await holder(rig)).startswith("ldcnd commission")

    assert await holder(rig) is None
    assert record(rig).of("load").result.state is StepState.OPEN
    assert record(rig).of("home").result.state is StepState.OPEN


async def test_what_is_under_way_can_be_left(rig, console):
    async with commissioning_page(console) as opened:
        await opened.begin("scale")
        await opened.answer("how far shall it move", "15")
        async with opened.holding("moves by 15 mm"):
            await rig.running.until(AXIS, lambda state: state.moving is Moving.YES)
            opened.say(leave=True)
            await opened.ended()
        await rig.running.until(AXIS, lambda state: state.moving is Moving.NO)
        assert await holder(rig) is None
        await opened.begin("load")  # and something else begun


async def test_a_reload_shows_what_it_changes_and_names_what_needs_a_restart(rig, console):
    daemon = rig.running.daemon
    daemon.serve_reloads(Reloader(daemon, lambda: load_config(rig.config)).answer)
    text = rig.config.read_text().replace("velocity = 10", "velocity = 9").replace("kp = 350", "kp = 351")
    rig.config.write_text(text)
    async with page(console.app, console.browser, path="/api/commissioning/scan") as socket:
        opened = OpenCommissioning(socket, View())
        opened.say(begin="reload")
        await opened.asked("reload")
        shown = opened.view.lines
        before = daemon.config.bus[0].axis[0].velocity
        await opened.answer("reload", "yes")
        await opened.ended()

    assert shown == (
        "bus.line.axis.x.velocity: 10 mm/s -> 9 mm/s",
        "bus.line.axis.x.gains.kp: 350 -> 351 (needs a restart of the daemon)",
    )
    assert before == 10
    assert (daemon.config.bus[0].axis[0].velocity, daemon.config.bus[0].axis[0].gains.kp) == (9, 350)
    assert not (await rig.running.client.state(AXIS)).enabled


async def test_gains_come_back_when_a_page_goes_while_motor_and_encoder_are_compared(rig, console):
    async with commissioning_page(console) as opened:
        await opened.begin("motor")
        await rig.running.until(AXIS, lambda state: state.enabled)
        lent = await rig.registers()

    assert lent != GAINS
    assert await rig.registers() == GAINS
    assert not (await rig.running.client.state(AXIS)).enabled


async def test_tuning_says_what_to_install_where_numpy_is_missing(rig, console, monkeypatch):
    monkeypatch.setattr(parts, "find_spec", lambda _: None)
    async with commissioning_page(console) as opened:
        await opened.until(lambda view: not view.running and view.steps)
        opened.say(begin="gains")
        view = await opened.until(lambda view: view.problem)

    assert view.problem.remedy == "pip install 'ldcnd[bench]'"


async def test_gains_come_back_when_a_page_goes_while_the_axis_is_tuned(tmp_path):
    text = re.sub(r"limits = .*\n", "", rig_text("ls-182ap"))
    async with commissioning_rig(tmp_path, text=text, module="ls182ap") as rig, commissioning_console(rig) as console:
        async with commissioning_page(console) as opened:
            await opened.until(lambda view: not view.running and view.steps)
            opened.say(begin="gains")
            await opened.answer("run it", "yes")
            await opened.answer("within which distance", "2")
            await opened.answer("bandwidth", "25")
            await opened.asked("move x now")
            before = opened.view.lines
            await opened.answer("move x now", "yes")
            await rig.running.until(AXIS, lambda state: state.enabled)
            lent = await rig.registers()

        assert any("it will stay within 2 mm (2000 counts)" in line for line in before)
        assert lent != GAINS
        assert await rig.registers() == GAINS
        assert await holder(rig) is None
        assert record(rig).of("gains").result.state is StepState.OPEN


async def test_a_second_page_is_told_who_has_the_axis(rig, console):
    async with commissioning_page(console) as first:
        await first.until(lambda view: view.steps)
        async with page(console.app, await console.enter(), path=f"/api/commissioning/axes/{AXIS}") as second:
            refused = (await told_to(second)).refused
            overview = (await console.browser.get("/api/commissioning")).document
    async with commissioning_page(console, browser=await console.enter()) as later:
        await later.until(lambda view: view.steps)

    assert refused.code == ErrorCode.LEASE_HELD
    assert "console-1, page 1, has it on another page" in refused.message
    assert second.closed == 1008
    (axis,) = overview["axes"]
    assert axis["page"] == "console-1, page 1,"


async def test_the_overview_names_the_open_steps_that_are_for_the_axis(rig, console):
    """Before its list was ever opened."""
    (axis,) = (await console.browser.get("/api/commissioning")).document["axes"]

    assert "Unit, scale and first gains" not in axis["open"]
    assert "Motor against encoder" in axis["open"]


async def test_only_pages_of_this_console_have_part_in_it(rig, console):
    path = f"/api/commissioning/axes/{AXIS}"
    for stranger in (console.browser.forging(origin="http://elsewhere.example"), console.browser.without_cookies()):
        for each in (path, "/api/commissioning/scan"):
            async with page(console.app, stranger, path=each) as socket:
                assert socket.closed == 1008
                assert socket._frames.empty()
    assert (await console.browser.without_cookies().get("/api/commissioning")).status == 401
    assert (await console.browser.without_cookies().get(f"{path}/report")).status == 401


async def test_nothing_of_it_is_there_unless_the_console_was_started_for_it(rig):
    async with running_console() as console:
        assert (await console.browser.get("/api/commissioning")).status == 404
        assert (await console.browser.get("/api/rigs")).document["commissions"] is False


@pytest.mark.parametrize("nonsense", ['{"begin": 7}', "[", json.dumps({"begin": "x" * 65}), '{"else": true}'])
async def test_a_page_that_says_nonsense_is_closed(nonsense, rig, console):
    async with commissioning_page(console) as opened:
        opened.socket.say(nonsense)
        async with asyncio.timeout(10):
            while opened.socket.closed is None:
                await asyncio.sleep(0.1)

    assert opened.socket.closed == 1008


async def test_a_page_that_says_too_much_is_closed(rig, console):
    async with commissioning_page(console) as opened:
        for _ in range(300):
            opened.say()
        async with asyncio.timeout(10):
            while opened.socket.closed is None:
                await asyncio.sleep(0.1)


async def test_an_unknown_axis_or_step_is_refused(rig, console):
    async with page(console.app, console.browser, path="/api/commissioning/axes/nothing") as socket:
        assert (await told_to(socket)).refused.code == ErrorCode.UNKNOWN_AXIS
    async with commissioning_page(console) as opened:
        await opened.until(lambda view: view.steps)
        opened.say(begin="nothing")
        assert (await opened.until(lambda view: view.problem)).problem.code == ErrorCode.UNKNOWN_VERB


async def test_the_report_is_a_download(rig, console):
    answer = await console.browser.get(f"/api/commissioning/axes/{AXIS}/report")

    assert answer.status == 200
    assert answer.headers["content-disposition"] == 'attachment; filename="commissioning-bench-x.html"'
    assert b"Commissioning of axis x of rig bench" in answer.body


async def test_a_console_whose_login_may_only_look_moves_nothing(rig):
    async with commissioning_console(rig, ViewerSession) as console, commissioning_page(console) as opened:
        before = rig.drive.shaft.position_counts
        await opened.until(lambda view: not view.running and view.steps)
        opened.say(begin="scale")
        if not (await opened.until(lambda view: view.problem or view.question)).problem:
            await opened.answer("run it", "yes")
        view = await opened.until(lambda view: view.problem)

    assert view.problem.message
    assert await holder(rig) is None
    assert rig.drive.shaft.position_counts == before
    assert not (await rig.running.client.state(AXIS)).enabled
    assert opened.state("scale") in ("open", "failed")


async def test_a_daemon_that_runs_with_another_file_is_to_be_restarted(rig, console):
    rig.config.write_text(rig_text(counts_per_unit=2000))
    async with commissioning_page(console) as opened:
        await opened.until(lambda view: not view.running and view.steps)
        opened.say(begin="motor")
        view = await opened.until(lambda view: view.problem)

    assert "other counts_per_unit than the file" in view.problem.message


async def test_before_there_is_a_file_the_overview_offers_the_search_alone(tmp_path):
    async with commissioning_rig(tmp_path) as rig:
        rig.config = tmp_path / "none.toml"
        async with commissioning_console(rig) as console:
            overview = (await console.browser.get("/api/commissioning")).document
            async with page(console.app, console.browser, path=f"/api/commissioning/axes/{AXIS}") as socket:
                refused = (await told_to(socket)).refused

    assert (overview["rig"], overview["axes"], overview["connected"]) == (None, [], False)
    assert overview["command"] == COMMAND
    assert refused.code == ErrorCode.CONFIG_INVALID


@pytest.mark.real_time
async def test_a_port_that_another_program_has_is_not_scanned(tmp_path):
    master, slave = os.openpty()
    port = os.ttyname(slave)
    said = []
    with serial.Serial(port, exclusive=True):
        search = ScanConversation(None, tmp_path / "rig.toml")
        async with asyncio.TaskGroup() as group:
            running = group.create_task(search.run())
            search.heard(FromCommissioningPage(begin="scan"))
            for text in (port, "ldcn"):
                view = await search.view()
                while view.question is None or view.question.number in said:
                    view = await search.view()
                said.append(view.question.number)
                search.heard(FromCommissioningPage(answer=PersonAnswer(number=view.question.number, text=text)))
            while (view := await search.view()).problem is None:
                pass
            running.cancel()
    written, _, _ = select.select([master], [], [], 0)
    os.close(slave)
    os.close(master)

    assert view.problem.code == ErrorCode.BUS_DOWN
    assert not written
    assert not (tmp_path / "rig.toml").exists()
