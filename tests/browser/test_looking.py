"""What the browser draws, computes and saves, and how it bears losses; each result is compared with the daemon's."""

import csv
import io
import re

import pytest

from ldcnd.cli.params import load_parameters
from ldcnd.client.traces import fetch_trace, load_trace, trace_header
from ldcnd.contract.commands import HomeMethod, HomeStop, MoveVelocity, Power, SetGains
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.questions import ReportShadow
from ldcnd.contract.samples import ShadowFigure
from ldcnd.contract.traces import MOST_CHANNELS, MOST_SAMPLES, TracePhase, TriggerKind
from tests.browser.marks import IN_THE_HOUSE
from tests.support.process import ROOT

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

MINUS = "\N{MINUS SIGN}"
DRAWN = """
([pane, name]) => {
  const canvas = document.querySelectorAll(".chart canvas")[pane];
  const probe = document.createElement("canvas").getContext("2d");
  probe.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(name);
  probe.fillRect(0, 0, 1, 1);
  const [red, green, blue] = probe.getImageData(0, 0, 1, 1).data;
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let at = 0; at < data.length; at += 4)
    if (Math.abs(data[at] - red) + Math.abs(data[at + 1] - green) + Math.abs(data[at + 2] - blue) < 24) count += 1;
  return count > 100;
}
"""
"""Tells whether a pane of the chart has pixels of a colour of the style sheet."""
MODULE = "(path) => import(path).then((module) => JSON.parse(JSON.stringify({...module})))"


async def saved(desk, name):
    """Return what a button lets the browser save."""
    async with desk.page.expect_download() as download:
        await desk.button(name).click()
    return await (await download.value).path()


async def test_a_trace_is_recorded_drawn_and_saved(house, tmp_path):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("trace/sim/x")
        await desk.page.get_by_label("Samples", exact=True).fill("60")
        await desk.button("Record").click()
        await expect(desk.panel("Captures").get_by_text("60 samples in")).to_be_visible()

        header = await trace_header(house.sim.rig, "x")
        assert (header.phase, header.samples) == (TracePhase.COMPLETE, 60)
        await desk.page.wait_for_function(DRAWN, arg=[1, "--curve-2"])  # the velocity has the second pane for itself

        path = await saved(desk, "Save CSV")
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
        assert {row["channel"] for row in rows} == {"x position", "x velocity", "x following error"}
        assert len(rows) == 180
        assert (await saved(desk, "Save PNG")).read_bytes().startswith(b"\x89PNG")
        async with desk.page.expect_download() as downloading:
            await desk.panel("Captures").get_by_role("link", name="last trace of x").click()
        download = await downloading.value
        whole = tmp_path / download.suggested_filename
        await download.save_as(whole)
        assert load_trace(whole).header.trace_id == header.trace_id

        await desk.button("Record").click()
        await expect(desk.panel("Captures").get_by_text("60 samples in")).to_have_count(2)
        await expect(desk.page.get_by_role("table").filter(has_text="Curve").locator("tbody tr")).to_have_count(6)


async def test_a_trace_is_not_sent_with_no_time_to_wait_for_its_trigger(house):
    async with house.desk() as desk:
        await desk.open("trace/sim/x")
        panel = desk.panel("Record x")
        await panel.get_by_label("Trigger", exact=True).select_option("position")
        await panel.get_by_label("Wait at most").focus()
        await desk.page.keyboard.press("Control+a")
        await desk.page.keyboard.type("0")
        await expect(panel).to_contain_text("How long may it wait for the trigger?")
        await expect(desk.button("Record")).to_be_disabled()


async def test_the_scope_follows_a_motion_and_measures_between_cursors(house):
    await house.sim.quiet("x")
    await house.sim.rig.command("x", Power(on=True))
    async with house.desk() as desk:
        await desk.open("scope")
        await expect(desk.page.get_by_text("redraws a second")).to_be_visible()
        boxes = desk.page.get_by_role("group", name="sim · x")
        await boxes.get_by_label("velocity").check()
        await house.sim.rig.command("x", MoveVelocity(velocity=-3))
        values = desk.page.get_by_role("row", name="x velocity")
        await expect(values).to_contain_text(re.compile(f"{MINUS}[1-9]"))  # whole counts a servo tick, so not exactly 3
        await expect(desk.page.get_by_text("redraws a second")).to_be_visible()

        await desk.button("Pause").click()
        await desk.page.get_by_label("Cursor A").fill("950")
        await desk.page.get_by_label("Cursor B").fill("960")
        await expect(desk.page.get_by_text(re.compile("A: 0.1000 s, 10.00 Hz"))).to_be_visible()
        await desk.button("Zoom in").click()
        await expect(desk.button("Resume")).to_be_visible()
        rows = list(csv.DictReader(io.StringIO((await saved(desk, "Save CSV")).read_text(encoding="utf-8"))))
        assert any(row["channel"] == "sim · x velocity" and -6 < float(row["value"]) < -1 for row in rows)


async def test_a_test_move_is_judged_and_writes_nothing(house):
    await house.sim.quiet("y")
    async with house.desk() as desk:
        await desk.open("tuning/sim/y")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("y", lambda state: state.enabled)
        before, gains = await house.sim.position("y"), await house.sim.registers("y")

        await desk.button("Move 1 mm and record").click()

        run = desk.page.get_by_role("row", name="Run 1")
        await expect(run).to_contain_text("trapezoid 1.000")
        await house.sim.reaches("y", before + 1, within=0.05)
        cells = await run.get_by_role("cell").all_inner_texts()
        overshoot, peak, final = (float(cells[at].split()[0].replace(MINUS, "-")) for at in (1, 4, 6))
        trace = await fetch_trace(house.sim.rig, "y")
        positions, errors = (trace.values[column] for column in (0, 1))
        assert overshoot == pytest.approx(max(0, max(positions) - (before + 1)), abs=0.002)
        assert peak == pytest.approx(max(map(abs, errors)), abs=0.002)
        assert final == pytest.approx(before + 1 - positions[-1], abs=0.01)
        after = await house.sim.registers("y")
        assert {name: after[name] for name in ("kp", "kd", "ki", "el")} == {
            name: gains[name] for name in ("kp", "kd", "ki", "el")
        }
        await desk.page.wait_for_function(DRAWN, arg=[0, "--curve-1"])

        await desk.open("events")
        await desk.open("tuning/sim/y")
        await desk.button(f"Move {MINUS}1 mm and record").click()
        await house.sim.reaches("y", before, within=0.05)
        await expect(desk.button("Move 1 mm and record")).to_be_visible()


async def test_the_daemon_is_lost_and_regained(house):
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await expect(desk.panel("Now")).to_contain_text("good")

        await house.sim.end()

        await expect(desk.panel("Now")).to_contain_text(re.compile("no data|daemon silent"))
        await expect(desk.page.get_by_text("The values below are the last known ones.")).to_be_visible()
        await expect(desk.button("Take control")).to_be_disabled()
        await desk.page.get_by_role("button", name="Stop all axes").click()
        await expect(desk.page.get_by_text("sim: not stopped")).to_contain_text("Use the emergency stop.")

        await house.sim.start()

        await expect(desk.panel("Now")).to_contain_text("good")
        await expect(desk.page.get_by_label("Position", exact=True)).to_have_text("0.000")  # drives were reset
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)


async def test_the_pages_know_what_the_models_say(house):
    async with house.desk() as desk:
        await desk.open("rig")
        contract = await desk.page.evaluate(MODULE, "/static/session/contract.js")

    gains = SetGains.model_fields
    schema = SetGains.model_json_schema()["properties"]
    assert set(contract["GAINS"]) == {name for name in gains if gains[name].annotation == (int | None)} - {
        "sequence",
        "not_after",
    }
    for name, told in contract["GAINS"].items():
        number = schema[name]["anyOf"][0]
        assert (told["min"], told["max"]) == (number["minimum"], number["maximum"]), name
    assert contract["HOME_METHODS"] == list(HomeMethod)
    assert contract["HOME_STOPS"] == list(HomeStop)
    assert contract["TRIGGER_KINDS"] == list(TriggerKind)
    assert set(contract["TRACE_UNDER_WAY"]) < set(TracePhase)
    assert (contract["MOST_CHANNELS"], contract["MOST_SAMPLES"]) == (MOST_CHANNELS, MOST_SAMPLES)
    assert contract["COMMAND_STATUSES"] == list(CommandStatus)


async def test_what_the_pages_compute_is_what_one_computes_by_hand(house, tmp_path):
    seconds = [index / 100 for index in range(101)]
    position = [0.0] * 10 + [0.5, 1.2, 1.1] + [1.01] * 88  # commanded at 0.09 s to go to 1 without a profile
    error = [0.0] * 9 + [1.0, 0.5, -0.2, -0.1] + [-0.01] * 88
    move = {"seconds": seconds, "position": position, "error": error, "start": 0, "target": 1, "band": 0.05}
    values = [{"parameter": "Pn100", "name": "Speed loop gain", "stored": 80, "active": 90}]
    async with house.desk() as desk:
        await desk.open("rig")
        judged = await desk.page.evaluate(
            "(move) => import('/static/session/response.js').then(({ judge }) => judge(move))",
            move | {"profileS": 0.02},
        )
        text = await desk.page.evaluate(
            "(dump) => import('/static/session/parameter_file.js').then(({ asToml }) => asToml('feed', dump))",
            {"values": values, "facts": None},
        )
        read = await desk.page.evaluate(
            "(text) => import('/static/session/parameter_file.js').then(({ fromToml }) => [...fromToml(text)])", text
        )

    assert judged == pytest.approx(
        {
            "beganAtS": 0.08,
            "overshoot": 0.2,
            "overshootShare": 0.2,
            "settlingS": 0.13 - 0.08 - 0.02,
            "riseS": 0.01,
            "peakError": 1.0,
            "rmsError": ((1.0 + 0.25 + 0.04 + 0.01 + 88 * 0.0001) / 93) ** 0.5,
            "finalError": -0.01,
        }
    )
    dump = tmp_path / "feed.toml"
    dump.write_text(text, encoding="utf-8")
    assert dict(read) == load_parameters(dump).values == {"Pn100": 80}


async def test_what_needs_attention_is_said_once_and_links_keep_the_axis(house):
    await house.sim.quiet("x", "y", "z", "c")
    await house.mixed.quiet("x")
    await house.sim.rig.stop("x")
    await house.sim.rig.stop("y")
    async with house.desk(width=1280) as desk:
        await desk.open("rig")
        latched = desk.panel("Needs attention").get_by_role("listitem").filter(has_text="A stop is latched")
        await expect(latched).to_have_count(1)
        await expect(latched.get_by_role("link")).to_have_text(["sim · x", "sim · y"])
        await latched.get_by_role("link", name="sim · y").click()

        await expect(desk.page.get_by_role("list", name="Inputs")).to_contain_text(
            re.compile(r"forward limit\s*(high|low|unknown|not shown while disabled)")
        )
        await desk.page.get_by_role("link", name="Scope", exact=True).last.click()
        for quantity in ("position", "velocity", "following error"):
            await expect(
                desk.page.get_by_role("group", name="sim · y").get_by_label(quantity, exact=True)
            ).to_be_checked()
        await desk.page.go_back()
        await desk.page.get_by_role("link", name="Trace", exact=True).last.click()
        await expect(desk.page.get_by_role("heading", name="Record y")).to_be_visible()
    await house.sim.quiet("x", "y")


async def test_what_a_shadow_finds_is_on_the_page_of_its_axis_and_its_alarm_needs_attention(house):
    figure = ShadowFigure(
        figure="friction", value=2.0, usual=2.0, low=1.5, high=2.5, unit="PWM steps", motions=20, alarm=False
    )
    grown = figure.model_copy(update={"value": 3.2, "alarm": True, "meaning": "bearings, guides, grease"})
    rig = house.sim.rig
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        for t, each in enumerate((figure, grown)):
            await rig.ask(ReportShadow(t=t, learning=False, judged=120, figures=(each,)), "x")
            await expect(desk.panel("Shadow").get_by_text(f"{each.value:.3f}").first).to_be_visible()
        await expect(desk.panel("Shadow").get_by_role("img", name="friction: from 2.000 to 3.200")).to_be_visible()
        await expect(desk.panel("Shadow").get_by_text("friction: bearings, guides, grease")).to_be_visible()
        await desk.open("rig")
        await expect(desk.page.get_by_text("Motions take another friction than usual").first).to_be_visible()
        await rig.ask(ReportShadow(t=3, learning=False, judged=140, figures=(figure,)), "x")
        await expect(desk.page.get_by_text("Motions take another friction than usual")).to_have_count(0)


async def test_a_page_is_added_by_its_list(house, tmp_path):
    main = tmp_path / "main.js"
    text = (ROOT / "ldcnd" / "console" / "static" / "main.js").read_text(encoding="utf-8")
    for before, added in (
        ("import { problems }", 'import { LampPage } from "./pages/lamp.js";\n'),
        ('  ["events", "Events", EventsPage],', '  ["lamp", "Lamp", LampPage],\n'),
    ):
        assert before in text
        text = text.replace(before, added + before, 1)
    main.write_text(text, encoding="utf-8")
    page = tmp_path / "lamp.js"
    page.write_text(
        'import { html } from "../html.js";\nexport function LampPage() { return html`<h2>The lamp is on</h2>`; }\n',
        encoding="utf-8",
    )
    async with house.desk() as desk:
        await desk.page.route("**/main.js", lambda route: route.fulfill(path=main, content_type="text/javascript"))
        await desk.page.route("**/lamp.js", lambda route: route.fulfill(path=page, content_type="text/javascript"))
        await desk.open("rig")
        await desk.page.reload()  # the first browser that is let in has the scripts already
        await desk.page.get_by_role("link", name="Lamp", exact=True).click()
        await desk.page.get_by_role("heading", name="The lamp is on").wait_for()


async def test_the_velocity_of_a_turning_axis_is_that_of_its_turns(house):
    """Its position begins again with each turn, so at 5 turns a second every other one of ten seems the same."""
    async with house.desk() as desk:
        await desk.open("")
        velocity = await desk.page.evaluate(
            """async () => {
              const { Axis } = await import("/static/session/rigs.js");
              const axis = new Axis({ nowNs: () => 0, worth: null }, "rotor");
              axis.info = { modulo: 1.0, counts_per_unit: 8000, direction: "forward" };
              axis.take("state", { t: 1, state: "continuous_motion", moving: "yes" });
              for (let n = 1; n <= 9; n += 1) {
                const turned = 5.13 * n / 10;
                const counts = Math.round(8000 * turned);
                axis.take("position", { t: n * 1e8, value: turned % 1, counts, quality: "good" });
              }
              return axis.velocity;
            }"""
        )
        assert velocity == pytest.approx(5.13, rel=1e-3)
