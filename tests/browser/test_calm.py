"""Every condition of an axis on the rig page and on the axis page, as a person reads them."""

import asyncio
import re

import pytest

from ldcnd.console.conditions import as_payload
from ldcnd.contract.commands import Halt, Home, MoveRelative, Power, Reset
from ldcnd.contract.condition import Place
from tests.unit.test_conditions_on_faces import CASES, Case, axis_now, known

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")

pytestmark = [
    pytest.mark.system,
    pytest.mark.real_time,
    pytest.mark.asyncio(loop_scope="package"),
    pytest.mark.timeout(600),
]

SHOW = """async ([axes, condition, lineUp]) => {
  const { rigs, changed } = await import("/static/session/rigs.js");
  const rig = rigs.get("sim");
  for (const name of axes) {
    const axis = rig.axis(name);
    axis.take = (item, ...rest) => item !== "condition" && Object.getPrototypeOf(axis).take.call(axis, item, ...rest);
    axis.samples.condition = condition;
  }
  const bus = rig.buses.get("line0");
  bus.report = () => {};
  bus.reports = bus.reports.map((each) => ({ ...each, up: lineUp }));
  changed();
}"""
"""Put what the console process sends into the page, which takes no other condition and no report of the line."""
REACH = """() => [innerWidth, document.documentElement.scrollWidth,
  document.querySelector("button.stop").getBoundingClientRect().bottom]"""


def payload(case: Case) -> dict[str, object]:
    return as_payload(axis_now(known(case)).condition)


@pytest.mark.parametrize("width", [1280, 390])
async def test_the_rig_page_says_every_condition_in_its_row(house, width):
    async with house.desk(width=width) as desk:
        await desk.open("rig")
        row = desk.panel("Rig sim").locator("tr[data-axis=x]")
        await playwright.expect(row).to_be_visible()
        for case in CASES:
            await desk.page.evaluate(SHOW, [["x"], payload(case), True])
            cell = row.locator(".place")
            attention = desk.page.locator(".attention")
            if case.place is Place.KNOWN:
                await playwright.expect(cell).to_have_attribute("data-known", "yes")
                await playwright.expect(cell).not_to_contain_text("(")
                await playwright.expect(row.locator(".homed")).to_have_text("homed")
            else:
                await playwright.expect(cell).to_contain_text("(")
                await playwright.expect(row.locator(".homed")).to_have_text(payload(case)["mark"])
                await playwright.expect(desk.page.get_by_text("Nothing needs attention")).to_have_count(0)
                await playwright.expect(attention.get_by_role("link", name="sim · x")).not_to_have_count(0)


@pytest.mark.parametrize("place", ["rig", "axis/sim/x"])
async def test_on_a_phone_a_stop_is_within_reach_whatever_is_said_of_axes(house, place):
    async with house.desk(width=390, height=780, phone=True) as desk:
        await desk.open(place)
        await playwright.expect(desk.page.locator("tr[data-axis=x], .big").first).to_be_visible()
        for case in CASES:
            await desk.page.evaluate(SHOW, [["x", "y"], payload(case), True])
            width, wide, bottom = await desk.page.evaluate(REACH)
            assert (width, wide) == (390, 390), case.name
            assert bottom <= 780, case.name


async def test_the_axis_page_says_every_condition_beside_its_large_number(house):
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        panel = desk.panel("Now")
        number = panel.get_by_label("Position", exact=True)
        await playwright.expect(number).to_be_visible()
        for case in CASES:
            told = payload(case)
            await desk.page.evaluate(SHOW, [["x"], told, True])
            if case.place is Place.KNOWN:
                await playwright.expect(number).not_to_contain_text("(")
                await playwright.expect(panel.locator(".place-mark")).to_have_count(0)
            else:
                await playwright.expect(number).to_contain_text("(")
                await playwright.expect(panel.locator(".place-mark")).to_have_text(told["mark"])
            await playwright.expect(panel.locator(".state")).to_have_text(told["state"])
            strip = desk.page.locator(".strip")
            for trouble in told["troubles"]:
                await playwright.expect(strip).to_contain_text(trouble["short"])


async def test_a_line_that_is_down_is_one_cause_with_the_names_of_its_axes(house):
    (down,) = [case for case in CASES if case.name == "line down"]
    async with house.desk() as desk:
        await desk.open("rig")
        line = desk.page.get_by_role("region", name="Line line0 of sim")
        await playwright.expect(line).to_contain_text("in use")
        await desk.page.evaluate(SHOW, [["x", "y", "z", "c"], payload(down), False])
        causes = desk.page.locator(".attention li").filter(has_text="The line is not up")
        await playwright.expect(causes).to_have_count(1)
        for name in ("line0", "x", "y", "z", "c"):
            await playwright.expect(causes).to_contain_text(f"sim · {name}")
        await desk.page.get_by_label("Show", exact=True).select_option("what moves")
        await playwright.expect(desk.panel("Rig sim").locator("tr[data-axis]")).to_have_count(4)  # they may
        await desk.open("network")
        await playwright.expect(desk.page.locator(".notice").filter(has_text="Down:")).to_have_count(1)


COUNTED = """async () => {
  const { Bus } = await import("/static/session/rigs.js");
  const bus = new Bus("another");
  for (const timeouts of [70, 72, 1, 4]) bus.report({ timeouts });
  return bus.lately("timeouts");
}"""


async def test_what_a_line_has_counted_within_the_last_minute_goes_on_behind_a_restart_of_its_daemon(house):
    async with house.desk() as desk:
        await desk.open("rig")
        assert await desk.page.evaluate(COUNTED) == 2 + 1 + 3


SILENT = """async () => {
  const { rigs } = await import("/static/session/rigs.js");
  const rig = rigs.get("sim");
  rig.take = () => {};
  rig.heardAtMs = performance.now() - 5_000;
  const said = rig.worth.why;
  await new Promise((resolve) => setTimeout(resolve, 1_100));
  return [said, rig.worth.why];
}"""
"""What is said of a rig of which nothing comes in, and a second later."""


async def test_an_alert_that_nothing_is_heard_is_not_said_anew_each_second(house):
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        position = desk.page.get_by_label("Position", exact=True)
        await playwright.expect(position).to_be_visible()
        await playwright.expect(position).to_have_attribute("aria-live", "off")  # it changes many times a second
        said, later = await desk.page.evaluate(SILENT)
        assert said == later
        assert re.fullmatch(r"Nothing has been heard since \d\d:\d\d:\d\d\.", said)


async def test_what_a_line_has_remarked_at_its_start_needs_no_attention_once_it_is_up(house):
    async with house.desk() as desk:
        await desk.open("network")
        await playwright.expect(desk.page.get_by_role("heading", name="sim · line0")).to_be_visible()
        await desk.page.route("**/api/rigs", remarked)
        await playwright.expect(
            desk.page.get_by_text("At the start: not taken over, 0 of 4 modules answer.").first
        ).to_be_visible()
        await desk.page.evaluate("() => { location.hash = '#/rig'; }")
        await playwright.expect(desk.panel("Rig sim")).to_be_visible()
        await playwright.expect(desk.page.get_by_text("not taken over")).to_have_count(0)


async def test_what_is_to_be_seen_to_of_a_daemon_needs_attention_as_a_warning(house):
    words = "the certificate of bench ends on 2026-12-04 10:20 UTC, within 5 days"

    async def ending(route):
        answer = await route.fetch()
        told = await answer.json()
        rigs = [rig | {"attention": words if rig["name"] == "sim" else ""} for rig in told["rigs"]]
        await route.fulfill(response=answer, json=told | {"rigs": rigs})

    async with house.desk() as desk:
        await desk.page.route("**/api/rigs", ending)
        await desk.open("rig")
        told = desk.page.locator(".attention li").filter(has_text=words)
        await playwright.expect(told).to_have_count(1)
        await playwright.expect(told).to_have_attribute("data-level", "warn")
        await playwright.expect(told).to_contain_text("sim")


async def remarked(route):
    """Answer with a remark on every line."""
    answer = await route.fetch()
    document = await answer.json()
    for rig in document["rigs"]:
        for bus in rig["buses"]:
            bus["remarks"] = ["not taken over, 0 of 4 modules answer"]
    await route.fulfill(response=answer, json=document)


async def test_a_stop_is_in_the_headline_until_reset_whoever_has_stopped(house):
    await house.sim.quiet("x", "y", "z", "c")
    async with house.desk() as desk:
        await desk.open("rig")
        stops, box = desk.page.locator(".stops"), desk.page.locator(".stop-report")
        await playwright.expect(desk.panel("Rig sim").locator("tr[data-axis=x]")).to_be_visible()
        await playwright.expect(stops.filter(has_text="sim")).to_have_count(0)

        await house.sim.rig.stop("y")  # another person
        await playwright.expect(stops.filter(has_text="sim")).to_contain_text("stopped and latched: y")
        await house.sim.rig.command("y", Reset())
        await playwright.expect(stops.filter(has_text="sim")).to_have_count(0)

        await desk.page.keyboard.press("Escape")
        await playwright.expect(stops.filter(has_text="sim")).to_contain_text("stopped and latched: x, y, z, c")
        await playwright.expect(box).to_have_attribute("data-shown", "no")
        await house.sim.quiet("x", "y", "z", "c")
        await playwright.expect(stops.filter(has_text="sim")).to_have_count(0)
        await playwright.expect(box).to_have_attribute("data-shown", "no")
    await house.mixed.quiet("x")


async def test_the_answer_to_a_stop_is_gone_with_what_the_axis_tells_since_and_a_new_press_is_not_answered_by_it(house):
    async with house.beside_alpha() as own:
        async with own.desk() as desk:
            await desk.open("axis/alpha/x")
            strip = desk.page.locator(".strip.of-axis")
            await desk.button("Stop x").click()
            await house.alpha.until("x", lambda state: state.stop_latched)
            await house.alpha.rig.command("x", Reset())
            await house.alpha.until("x", lambda state: not state.stop_latched)
            await playwright.expect(desk.page.locator(".stops").filter(has_text="alpha: ")).to_have_count(0)
            house.alpha.pause(on=True)
            await playwright.expect(strip).to_contain_text("daemon silent")
            await playwright.expect(strip).not_to_contain_text("confirmed by")

            await desk.button("Stop x").click()
            await playwright.expect(strip).to_contain_text("no answer yet")
            await playwright.expect(strip).not_to_contain_text("confirmed by")
            report = desk.page.locator(".stop-report")
            await playwright.expect(report).to_contain_text("Stop of alpha \u00b7 x did not get through")
            await playwright.expect(report).to_contain_text("Use the emergency stop.")

            house.alpha.pause(on=False)
            await house.alpha.kill()
            await house.alpha.start()
            await playwright.expect(report).not_to_contain_text("did not get through")


async def test_the_target_of_an_axis_that_is_not_homed_stands_in_brackets_as_its_place_does(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        where = desk.page.locator(".strip.of-axis .where")
        await house.sim.rig.command("x", Power(on=True))
        await house.sim.rig.command("x", Home())
        await house.sim.until("x", lambda state: state.state == "homing" and not state.referenced)
        await house.sim.rig.command("x", Halt())
        await house.sim.until("x", lambda state: state.moving == "no" and not state.referenced)
        await house.sim.rig.command("x", MoveRelative(distance=20, velocity=1))
        await playwright.expect(where).to_contain_text(re.compile(r"\(.+\).+→ \(.+\)"))
    await house.sim.quiet("x")
    await house.sim.rig.command("x", Power(on=True))
    await house.sim.rig.command("x", Home())
    await house.sim.until("x", lambda state: state.referenced and state.moving == "no")
    await house.sim.quiet("x")


async def test_what_became_of_a_move_is_said_after_a_stop_and_after_the_end_of_the_daemon(house):
    async with house.beside_alpha() as own:
        async with own.desk() as desk:
            await desk.open("axis/alpha/x")
            story, preview = desk.panel("Move").locator(".story"), desk.panel("Move").locator(".preview")
            await desk.button("Take control").click()
            await desk.button("Enable").click()
            await house.alpha.until("x", lambda state: state.enabled)
            await desk.panel("Move").get_by_label("Position mm").fill("80")
            await playwright.expect(preview).to_contain_text("Ends at 80.000 mm")
            await desk.panel("Move").get_by_label("Velocity mm/s").fill("2")
            await desk.button("Move").click()
            await playwright.expect(story).to_contain_text("x moves to 80.000 mm.")
            await house.alpha.rig.stop("x")
            await playwright.expect(story).to_contain_text("move absolute to 80.000, stopped at")
            await playwright.expect(desk.panel("Now")).to_contain_text("move absolute to 80.000, stopped at")
            async with own.desk() as another:  # it was not there when that happened
                await another.open("axis/alpha/x")
                await playwright.expect(another.panel("Now")).to_contain_text("move absolute to 80.000, stopped at")
            await desk.button("Reset").click()

            await house.alpha.until("x", lambda state: not state.stop_latched)
            await desk.panel("Move").get_by_label("Position mm").fill("70")
            await desk.button("Move").click()
            await playwright.expect(story).to_contain_text("x moves to 70.000 mm.")
            house.alpha.pause(on=True)
            await playwright.expect(story).to_contain_text("not known how far it is")
            await playwright.expect(preview).to_contain_text("Not known")
            house.alpha.pause(on=False)
            await playwright.expect(story).not_to_contain_text("not known how far it is")
            await house.alpha.end()
            await playwright.expect(desk.page.get_by_label("Position", exact=True)).to_have_text(
                re.compile(r"\(.*\d.*\)")
            )
            await house.alpha.start()
            await playwright.expect(story).not_to_contain_text("x moves to")
            await playwright.expect(desk.panel("Now")).to_contain_text("move absolute to 70.000, halted")

            await desk.button("Take control").click()
            await desk.button("Enable").click()
            await desk.button("+10 mm").click()
            await playwright.expect(desk.panel("Now")).to_contain_text("move relative, ends in")
            await house.alpha.kill()
            await house.alpha.start()
            await playwright.expect(desk.panel("Now")).to_contain_text("move relative: not known how it ended")


async def test_a_jog_that_a_stop_ends_is_an_ordinary_end(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)
        button = desk.page.get_by_role("button", name="Hold to run +")
        await playwright.expect(button).to_be_enabled()
        await button.hover()
        await desk.page.mouse.down()
        await house.sim.until("x", lambda state: state.moving == "yes")
        await desk.page.keyboard.press("Escape")
        await playwright.expect(desk.panel("Now")).to_contain_text("jog, stopped at")
        await desk.page.mouse.up()
        await playwright.expect(desk.page.locator(".refusal:not(:empty)")).to_have_count(0)
    await house.sim.quiet("x", "y", "z", "c")
    await house.mixed.quiet("x")


SAID = (
    "() => ['.summary', '.strip .moving', 'main'].map((each) => document.querySelector(each)?.textContent).join(' | ')"
)


async def test_a_page_that_loads_while_an_axis_moves_says_at_no_instant_that_nothing_moves(house):
    await house.sim.quiet("x")
    await house.sim.rig.command("x", Power(on=True))
    await house.sim.rig.command("x", MoveRelative(distance=-100.0, velocity=2.0))
    try:
        async with house.desk() as desk:
            await desk.page.route("**/api/rigs", lambda route: later(route, 2.0))  # as over a slow network
            await desk.page.goto("about:blank")
            await desk.open("rig")
            said = []
            async with asyncio.timeout(30):
                while not said or not re.search(r"\bx \W\d", said[-1]):
                    said.append(await desk.page.evaluate(SAID))
                    await asyncio.sleep(0.05)
            assert not [each for each in said[:-1] if re.search("Nothing moves|Nothing needs attention|No rig", each)]
            assert any("Waiting for values" in each for each in said)
    finally:
        await house.sim.rig.command("x", Halt())


async def later(route, pause_s: float) -> None:
    """Let a request of the page go on after a while."""
    await asyncio.sleep(pause_s)
    await route.continue_()
