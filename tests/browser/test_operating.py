"""What an operator does in the browser; each result is asked of the daemon, too."""

import asyncio
import re

import pytest

from ldcnd.contract.commands import Home, MoveRelative, MoveVelocity, Power, SetGains, SetPosition
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.leases import Acquire, ListHolders, Release
from ldcnd.contract.parameters import ReadParameter
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import TelemetryItem
from tests.browser.marks import IN_THE_HOUSE

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]


async def holder(daemon, axis):
    told = await daemon.rig.ask(ListHolders())
    return next(each.client for each in told.holders if each.axis == axis)


async def running(daemon, axis, velocity):
    await daemon.rig.command(axis, Power(on=True))
    await daemon.rig.command(axis, MoveVelocity(velocity=velocity))


async def runs_by_its_page(house, desk, velocity):
    """Take x on its page, and let it run."""
    await desk.open("axis/sim/x")
    await desk.button("Take control").click()
    await desk.button("Enable").click()
    await house.sim.until("x", lambda state: state.enabled)
    move = desk.panel("Move")
    await move.get_by_label("Move", exact=True).select_option("at a velocity")
    await move.get_by_label("Velocity mm/s").fill(velocity)
    await desk.button("Move").click()
    await house.sim.until("x", lambda state: state.moving == "yes")


async def test_an_axis_is_taken_enabled_and_moved_and_its_number_arrives(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("rig")
        await desk.panel("Rig sim").get_by_role("link", name="x", exact=True).click()
        await expect(desk.button("Move")).to_be_disabled()
        await expect(desk.panel("Move")).to_contain_text("Take control first.")

        await desk.button("Take control").click()
        await expect(desk.panel("Control")).to_contain_text("Held by this page")
        assert (await holder(house.sim, "x")).startswith("console-")
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)

        before = await house.sim.position("x")
        await desk.panel("Move").get_by_label("Position mm").fill("10")
        await expect(desk.panel("Move")).to_contain_text("Ends at 10.000 mm")
        assert await house.sim.position("x") == pytest.approx(before, abs=0.05)  # a preview moves nothing
        await desk.button("Move").click()

        await expect(desk.page.get_by_label("Position", exact=True)).to_have_text("10.000")
        await house.sim.reaches("x", 10, within=0.05)


async def test_what_would_be_refused_is_said_before_it_is_asked(house):
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.panel("Move").get_by_label("Position mm").fill("400")
        await expect(desk.panel("Move")).to_contain_text("above the limit 100 mm")
        await desk.button("Use 100.000").click()
        await expect(desk.panel("Move")).to_contain_text("Ends at 100.000 mm")


async def test_a_button_says_what_the_daemon_refuses_the_command_with(house):
    await house.sim.quiet("x")
    await house.sim.rig.command("x", Power(on=False))
    with pytest.raises(LdcndError) as refusal:
        await house.sim.rig.command("x", MoveRelative(distance=1.0))
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.panel("Move").get_by_label("Move", exact=True).select_option("by a distance")
        await expect(desk.panel("Move")).to_contain_text(f"{refusal.value.message}: press Enable.")
        await desk.button("Enable").click()
        await expect(desk.panel("Move")).not_to_contain_text(refusal.value.message)


async def test_the_button_stops_every_axis_of_every_rig(house):
    await house.sim.quiet("x", "y", "z", "c")
    await house.mixed.quiet("x")
    async with house.desk() as desk:
        await desk.open("network")
        await expect(desk.page.get_by_role("heading", name="sim · line0")).to_be_visible()
        await running(house.sim, "y", 2)

        stop = desk.page.get_by_role("button", name="Stop all axes")
        await expect(stop).to_contain_text("not an emergency stop")
        await stop.click()

        stops = desk.page.locator(".stops")
        await expect(stops.filter(has_text="sim: stopped and latched: x, y, z, c.")).to_be_visible()
        await expect(
            stops.filter(has_text="mixed: stopped and latched: x. No stop reaches feed, spool")
        ).to_be_visible()
        await expect(desk.page.locator(".stop-report")).to_have_attribute("data-shown", "no")
        state = await house.sim.until("y", lambda state: state.moving == "no")
        assert state.stop_latched
        assert (await house.mixed.rig.state("x")).stop_latched


async def test_the_key_stops_even_while_somebody_types(house):
    await house.sim.quiet("x", "y", "z", "c")
    async with house.desk() as desk:
        await desk.open("axis/sim/y")
        await running(house.sim, "y", -2)
        await desk.panel("Move").get_by_label("Position mm").fill("7")

        await desk.page.keyboard.press("Escape")

        await expect(desk.page.locator(".stops").filter(has_text="sim")).to_contain_text("latched: x, y, z, c")
        await expect(desk.panel("Now")).to_contain_text("stop latched yes")
        state = await house.sim.until("y", lambda state: state.moving == "no")
        assert state.stop_latched


AT_ONCE = """new MutationObserver((_, looking) => {
  if (!document.querySelector("#console > *")) return;
  looking.disconnect();
  location.hash = "#/axis/sim/x";
  document.documentElement.dispatchEvent(new KeyboardEvent("keydown", { key: "Escape", bubbles: true }));
}).observe(document, { childList: true, subtree: true })"""
"""As soon as a page has drawn something, and before anybody can see that."""


async def test_the_key_stops_and_an_address_counts_from_the_first_moment_of_a_page_on(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.page.add_init_script(AT_ONCE)
        await desk.page.goto("about:blank")
        await desk.open("rig")
        await expect(desk.page.get_by_role("heading", level=1)).to_contain_text("x")
        await house.sim.until("x", lambda state: state.stop_latched)
    await house.sim.quiet("x", "y", "z", "c")
    await house.mixed.quiet("x")


async def test_the_key_stops_while_a_page_is_still_on_its_way(house):
    """As over a slow network: the page has come, and its scripts have not."""
    await house.sim.quiet("x")
    arrive = asyncio.Event()

    async def late(route):
        await arrive.wait()
        await route.continue_()

    async with house.desk() as desk:
        await desk.page.goto("about:blank")
        await desk.page.route("**/main.js", late)
        await desk.page.goto(f"{desk.url}/#/axis/sim/x", wait_until="commit")
        await desk.page.wait_for_function("() => window.keepEarlyPress && document.body")
        await desk.page.keyboard.press("Escape")
        arrive.set()
        await house.sim.until("x", lambda state: state.stop_latched)
        await expect(desk.page.locator(".stops").filter(has_text="sim: ")).to_contain_text("latched: x")
    await house.sim.quiet("x", "y", "z", "c")
    await house.mixed.quiet("x")


async def test_a_stop_that_gets_lost_is_told_at_once(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("rig")
        await desk.page.route("**/api/stop", lambda route: route.abort())

        await desk.page.get_by_role("button", name="Stop all axes").click()

        await expect(desk.page.get_by_text("The stop did not get through")).to_contain_text("Use the emergency stop.")
        assert not (await house.sim.rig.state("x")).stop_latched


UNHEARD = {
    "stop": ("axis/sim/x", "Stop x", "**/sim/stop"),
    "halt": ("axis/sim/x", "Halt", "**/x/halt"),
    "disable": ("axis/sim/x", "Disable", "**/x/power"),
    "halt of a row": ("rig", "Halt x", "**/x/halt"),
    "halt of all": ("rig", "Halt all", "**/halt"),
}
"""What is pressed where, and the request that does not get through."""


@pytest.mark.parametrize("fails", ["on its way", "in the drive"])
async def test_a_speed_of_0_that_no_drive_has_confirmed_is_said_on_every_page_until_the_axes_have_stood(house, fails):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await runs_by_its_page(house, desk, "1")
        await desk.open("rig")

        async def answer(route):
            if fails == "on its way":
                await route.abort()
            else:
                said = "NOT confirmed by x: it may move on."
                told = {
                    "percent": 0,
                    "changed": [],
                    "unchanged": [],
                    "halted": ["x"],
                    "confirmed": [],
                    "shortfall": said,
                }
                await route.fulfill(json=told)

        await desk.page.route("**/set_speed_override", answer)
        await desk.panel("Rig sim").get_by_role("button", name="0 %", exact=True).click()
        report, told = desk.page.locator(".stop-report"), "Speed 0 % of sim did not get through"
        await expect(report).to_contain_text(told if fails == "on its way" else "Speed 0 % of sim NOT confirmed by x")

        await desk.open("events")
        await expect(report).to_contain_text("Speed 0 % of sim")

        await house.sim.rig.stop()
        await expect(report).not_to_contain_text("Speed 0 % of sim")


@pytest.mark.parametrize("act", UNHEARD)
async def test_what_did_not_end_the_motion_of_an_axis_is_said_on_every_page_for_as_long_as_that_goes_on(house, act):
    place, button, path = UNHEARD[act]
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await runs_by_its_page(house, desk, "1")
        await desk.open(place)
        await desk.page.route(path, lambda route: route.abort())
        where = desk.panel("Rig sim") if place == "rig" else desk.page
        await where.get_by_role("button", name=button, exact=True).click()
        report = desk.page.locator(".stop-report")
        await expect(report).to_contain_text("x did not get through")
        await expect(report).to_contain_text("Use the emergency stop.")

        await house.sim.rig.ask(SetSpeedOverride(percent=50))
        await expect(desk.page.get_by_role("banner")).to_contain_text("speed override 50 %")
        await desk.open("events")
        await expect(report).to_contain_text("x did not get through")

        await house.sim.rig.stop("x")
        if act != "disable":  # its motor is still on
            await expect(report).to_have_attribute("data-shown", "no")
        await house.sim.quiet("x")
        await expect(report).to_have_attribute("data-shown", "no")
    await house.sim.rig.ask(SetSpeedOverride(percent=100))


async def test_a_second_press_of_halt_is_sent_though_the_first_is_not_answered(house):
    await house.sim.quiet("x")
    sent, go_on = [], asyncio.Event()

    async def first_gets_stuck(route):
        sent.append(route)
        if len(sent) == 1:
            await go_on.wait()
        await route.continue_()

    async with house.desk() as desk:
        await runs_by_its_page(house, desk, "1")
        await desk.page.route("**/x/halt", first_gets_stuck)
        await desk.button("Halt").click()
        late = desk.page.get_by_text("no answer yet")
        await expect(late).to_be_visible()
        await desk.button("Halt").click()
        await house.sim.until("x", lambda state: state.moving == "no")
        await expect(late).to_have_count(0)  # the answer to the second says that it got through
        async with desk.page.expect_response("**/x/halt"):
            go_on.set()
    await house.sim.quiet("x")


COVERED = """(selector) => [...document.querySelectorAll(selector)].filter((button) => {
  const { left, top, width, height } = button.getBoundingClientRect();
  return !button.contains(document.elementFromPoint(left + width / 2, top + height / 2));
}).map((button) => button.textContent)"""
"""Returns what is written on the buttons that a pointer does not reach."""


@pytest.mark.parametrize("width", [1920, 1366, 1000, 600, 390])
async def test_what_is_told_of_a_stop_lies_over_nothing_that_ends_a_motion(house, width):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.page.set_viewport_size({"width": width, "height": 800})
        await desk.open("axis/sim/x")
        await desk.page.route("**/api/stop", lambda route: route.abort())
        await desk.page.get_by_role("button", name="Stop all axes").click()
        report = desk.page.get_by_text("The stop did not get through")
        await expect(report).to_be_in_viewport(ratio=1)

        covered = await desk.page.evaluate(COVERED, "button.stop, .endings button")
        assert covered == []
        await desk.page.get_by_role("button", name="Dismiss").click()
        await expect(report).to_be_hidden()


@pytest.mark.parametrize("width", [1366, 1000])
async def test_what_is_told_of_a_stop_covers_nothing_of_the_page_and_goes_once_all_axes_are_seen_to_stand(house, width):
    await house.sim.quiet("x")
    failed = {"rigs": {"sim": {"status": "error", "message": "no answer"}}}

    async def unanswered(route):
        await route.fetch()
        await route.fulfill(json=failed)

    async with house.desk() as desk:
        await desk.page.set_viewport_size({"width": width, "height": 768})
        await desk.open("axis/sim/x")
        report = desk.page.locator(".stop-report")
        await desk.page.route("**/api/stop", lambda route: route.fulfill(json=failed))
        await desk.page.keyboard.press("Escape")
        await expect(report).to_contain_text("sim: not stopped: no answer. Use the emergency stop.")
        box = await report.bounding_box()
        header = await desk.page.locator("header.frame").bounding_box()
        assert box["y"] + box["height"] <= header["y"] + header["height"] + 1
        assert (await desk.page.locator("main").bounding_box())["y"] >= box["y"] + box["height"] - 1

        await desk.page.unroute("**/api/stop")
        await desk.page.route("**/api/stop", unanswered)
        await desk.page.keyboard.press("Escape")
        await house.sim.until("x", lambda state: state.stop_latched)
        await expect(report).to_have_attribute("data-shown", "no")
    await house.sim.quiet("x", "y", "z", "c")
    await house.mixed.quiet("x")


@pytest.mark.parametrize("place", ["rig", "axis/sim/x"])
async def test_on_a_phone_on_its_side_the_header_leaves_the_page_two_thirds(house, place):
    await house.sim.quiet("x", "y", "z", "c")
    await house.mixed.quiet("x")
    async with house.desk(width=844, height=390) as desk:
        await desk.open(place)
        await expect(desk.page.locator("tr[data-axis=x], .big").first).to_be_visible()
        await expect(desk.page.locator(".notices .notice")).to_have_count(0)
        assert (await desk.page.locator("header.frame").bounding_box())["height"] <= 390 / 3
        assert await desk.page.get_by_role("button", name="Stop all axes").bounding_box()


async def test_a_fault_is_shown_with_its_remedy_and_the_remedy_helps(house):
    await house.sim.quiet("z")
    async with house.desk() as desk:
        await desk.open("axis/sim/z")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await desk.page.get_by_label("New el").fill("5")
        await desk.button("Write el = 5").click()
        await expect(desk.panel("Gains").get_by_role("row", name="el position error limit")).to_contain_text(
            "5 written"
        )

        await desk.panel("Move").get_by_label("Move", exact=True).select_option("move_relative")
        await desk.panel("Move").get_by_label("Distance").fill("2")
        await desk.button("Move").click()

        faults = desk.panel("Faults")
        await expect(faults).to_contain_text("position error")
        await expect(faults).to_contain_text("check for a jam, gains and acceleration, then reset")
        await expect(faults.get_by_role("link", name="More about position error")).to_have_attribute(
            "href", "/faults/position_error"
        )
        await expect(desk.panel("Can it move?")).to_contain_text("drive fault")
        told = await house.sim.rig.last("z", TelemetryItem.FAULT)
        assert told.first.code == "position_error"
        await expect(desk.page.locator(".strip")).to_contain_text("position error")
        await expect(desk.panel("Now").get_by_label("Inputs")).to_contain_text("amplifier enable set, motor off")

        await desk.page.get_by_label("New el").fill("4000")
        await desk.button("Write el = 4000").click()
        await desk.button("Reset z").click()
        await expect(faults).to_have_count(0)
        await desk.button("Enable").click()
        # nothing tells whether a shaft that stood was held, or moved unseen
        await expect(desk.panel("Can it move?")).to_contain_text("home the axis or set its current position")
        before = await house.sim.position("z")
        await desk.button("Move").click()
        await house.sim.reaches("z", before + 2, within=0.05)
        assert not (await house.sim.rig.last("z", TelemetryItem.FAULT)).active
        await desk.open("events")
        row = desk.page.get_by_role("row", name="position_error").first
        await expect(row).to_contain_text("the motor left the position error limit")
        await expect(desk.page.get_by_role("row", name="power on").first).to_contain_text("console-")
        await desk.page.get_by_label("Status").select_option("started")
        await expect(desk.page.get_by_role("row", name=re.compile("sim daemon started"))).to_have_count(1)


async def test_what_comes_after_a_fault_that_hides_motion_finds_the_axis_at_rest_and_without_it(house):
    await house.sim.quiet("z")
    usual = (await house.sim.registers("z"))["el"]
    await house.sim.rig.command("z", SetGains(el=5))
    await running(house.sim, "z", 1)
    await house.sim.until("z", lambda state: state.motion_hidden_by == "position_error")

    await house.sim.quiet("z")

    state = await house.sim.rig.state("z")
    assert (state.moving, state.enabled, state.motion_hidden_by) == ("no", False, "")
    await house.sim.rig.command("z", SetGains(el=usual))


WATCH_VELOCITY = """() => {
  window.seen = [];
  const look = () => window.seen.push([document.querySelector(".now-state .state")?.textContent,
    [...document.querySelectorAll(".facts div")].find((each) => each.textContent.startsWith("velocity"))
      ?.querySelector("dd").firstChild?.textContent ?? "\u2013"]);
  new MutationObserver(look).observe(document.querySelector("main"),
    { subtree: true, childList: true, characterData: true });
}"""


async def test_the_velocity_never_contradicts_the_state(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)
        await desk.page.evaluate(WATCH_VELOCITY)
        move = desk.panel("Move")
        await move.get_by_label("Move", exact=True).select_option("by a distance")
        back = await house.sim.position("x") > 0
        await move.get_by_label("Distance mm").fill("-10" if back else "10")
        await move.get_by_label("Velocity mm/s").fill("5")
        await desk.button("Move").click()
        await house.sim.until("x", lambda state: state.moving == "yes")
        await house.sim.until("x", lambda state: state.moving == "no")
        await expect(desk.page.locator(".now-state .state")).to_have_text("standstill")
        velocity = desk.page.locator(".facts div").filter(has_text="velocity").first.locator("dd")
        await expect(velocity).to_contain_text("0.000")  # it takes two positions
        seen = await desk.page.evaluate("window.seen")

    values = [(state, abs(float(text.replace("\u2212", "-")))) for state, text in seen if text != "\u2013"]
    last = max(nth for nth, (state, _) in enumerate(values) if state == "moving")
    assert max(value for _, value in values[last + 1 :]) < 0.2
    # a motion that begins can be seen in the positions one frame before the state says so
    assert sum(state == "standstill" and value > 0.2 for state, value in values) <= 3
    moving = [value for state, value in values if state == "moving"]
    assert len(moving) > 5
    assert sorted(moving)[len(moving) // 2] == pytest.approx(5, abs=0.3)
    assert sum(value < 4 for value in moving) <= 4  # while it begins and while it settles


async def test_homing_shows_no_velocity_that_the_shaft_has_not(house):
    await house.sim.quiet("x")
    await house.sim.rig.command("x", Power(on=True))
    await house.sim.rig.command("x", SetPosition(position=40.0))  # the mark gives it another number, far from this one
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.page.evaluate(WATCH_VELOCITY)
        await house.sim.rig.command("x", Home(velocity=0.1))  # slow enough that the page draws it some times
        await house.sim.until("x", lambda state: state.state == "homing")
        await house.sim.until("x", lambda state: state.referenced and state.moving == "no")
        await expect(desk.page.locator(".now-state .state")).to_have_text("standstill")
        seen = await desk.page.evaluate("window.seen")
    values = [abs(float(text.replace("\u2212", "-"))) for _, text in seen if text != "\u2013"]
    assert len(values) > 2
    assert max(values) < 10


async def test_what_is_in_the_way_of_a_move_follows_a_shaft_that_comes_to_rest(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await runs_by_its_page(house, desk, "20")
        await desk.button("Disable").click()
        await house.sim.until("x", lambda state: not state.enabled and state.moving == "no")
        way = desk.panel("Can it move?")
        await expect(way).to_contain_text("disabled")
        await expect(way).not_to_contain_text("turns with its motor off")


async def test_what_is_in_the_way_of_a_move_follows_the_speed_override(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        way = desk.panel("Can it move?")
        await expect(way).to_contain_text("Ready to move")
        await house.sim.rig.ask(SetSpeedOverride(percent=0))
        await expect(way).to_contain_text("the speed override of the rig is 0 %")
        await house.sim.quiet("x")
    await house.sim.rig.ask(SetSpeedOverride(percent=100))


async def test_a_speed_override_and_every_axis_that_was_lost_stand_on_top_of_every_page(house):
    await house.sim.quiet("x", "y", "z", "c")
    async with house.desk() as desk:
        await desk.open("rig")
        every = desk.page.get_by_role("group", name="Commands for all axes of sim")
        await every.get_by_role("button", name="Take control of all").click()
        await expect(desk.page.get_by_role("banner")).to_contain_text("You control sim · x, sim · y, sim · z, sim · c")
        await house.sim.rig.ask(SetSpeedOverride(percent=0))
        await desk.open("events")
        await expect(desk.page.get_by_role("banner")).to_contain_text("speed override 0 %: no command moves anything")

        taken = Acquire(client="ada", axes=("x", "y", "z", "c"), lease_s=60, force=True)
        lease = await house.sim.rig.ask(taken)
        await desk.page.evaluate("scrollTo(0, document.body.scrollHeight)")
        await expect(desk.page.get_by_role("banner")).to_contain_text("ada took control of")
        for axis in ("x", "y", "z", "c"):
            await expect(desk.page.locator(".notices")).to_contain_text(re.compile(rf"took control of .*\b{axis}\b"))
        await expect(desk.page.get_by_text("ada took control of")).to_be_in_viewport()
        await house.sim.rig.ask(SetSpeedOverride(percent=100, leases=(lease.lease,)))
        await expect(desk.page.get_by_role("banner")).not_to_contain_text("speed override")


async def test_whoever_loses_control_is_told_and_can_move_nothing(house):
    await house.sim.quiet("c")
    async with house.desk() as desk:
        await desk.open("axis/sim/c")
        await desk.button("Take control").click()
        await expect(desk.panel("Control")).to_contain_text("Held by this page")

        taken = Acquire(client="another operator", axes=("c",), lease_s=60, force=True)
        lease = await house.sim.rig.ask(taken)

        await expect(desk.page.get_by_text("another operator took control of sim · c.")).to_be_visible()
        await expect(desk.page).to_have_title(re.compile("^Control lost . Axis sim . c"))
        await expect(desk.panel("Control")).to_contain_text("controlled by another operator")
        await expect(desk.button("Enable")).to_be_disabled()
        await expect(desk.panel("Control")).to_contain_text("Control is held by another operator")

        await desk.page.get_by_label("Take it from another operator").check()
        await desk.button("Take control").click()
        await expect(desk.panel("Control")).to_contain_text("Held by this page")
        assert (await holder(house.sim, "c")).startswith("console-")
        assert lease.lease


async def test_taking_an_axis_again_leaves_the_word_of_the_others_that_were_lost(house):
    await house.sim.quiet("x", "y")
    async with house.desk() as desk:
        await desk.open("rig")
        rig, notices = desk.panel("Rig sim"), desk.page.locator(".notices")
        for axis in ("x", "y"):
            await rig.get_by_role("button", name=f"Take control {axis}", exact=True).click()
            # a row that is taken has other buttons, and those below it move
            await expect(rig.get_by_role("button", name=f"Take control {axis}", exact=True)).to_have_count(0)
        await expect(desk.page.get_by_role("banner")).to_contain_text("You control sim \u00b7 x, sim \u00b7 y")
        lease = await house.sim.rig.ask(Acquire(client="ada", axes=("x", "y"), lease_s=60, force=True))
        for axis in ("x", "y"):
            await expect(notices).to_contain_text(re.compile(rf"ada took control of .*\b{axis}\b"))
        await house.sim.rig.ask(Release(lease=lease.lease))

        await desk.page.mouse.move(1, 1)  # what has come under a hand that rests is not pressed
        await rig.get_by_role("button", name="Take control x", exact=True).click()
        await expect(notices).not_to_contain_text("sim \u00b7 x")
        await expect(notices).to_contain_text("ada took control of sim \u00b7 y.")


DEAF = """() => {
  const Socket = WebSocket;
  window.WebSocket = class extends Socket {
    set onmessage(hear) {
      super.onmessage = (event) => {
        if (!this.url.endsWith("/api/page") || !JSON.parse(event.data).lost) hear(event);
      };
    }
  };
}"""
"""Keeps from a page that its control is lost."""


async def test_a_page_that_was_not_told_that_its_control_is_lost_sees_it_in_the_values(house):
    await house.sim.quiet("c")
    async with house.desk() as desk:
        await desk.page.add_init_script(f"({DEAF})()")
        await desk.page.goto("about:blank")
        await desk.open("axis/sim/c")
        await desk.button("Take control").click()
        await expect(desk.panel("Control")).to_contain_text("Held by this page")
        await house.sim.rig.ask(Acquire(client="ada", axes=("c",), lease_s=60, force=True))
        await expect(desk.page.locator(".notices")).to_contain_text("ada took control of sim \u00b7 c.")
        await expect(desk.panel("Control")).to_contain_text("controlled by ada")
    await house.sim.quiet("c")


async def test_gains_are_written_by_a_click_only(house):
    await house.sim.quiet("c")
    async with house.desk() as desk:
        await desk.open("tuning/sim/c")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("c", lambda state: state.enabled)
        before = await house.sim.registers("c")
        wanted = before["kd"] + 100
        await desk.page.get_by_label("New kd").fill(f"{wanted}")
        assert await house.sim.registers("c") == before

        await desk.button(f"Write kd = {wanted}").click()

        # the field beside it says what was typed, too
        await expect(desk.panel("Gains").get_by_role("row", name="kd velocity gain")).to_contain_text(
            f"{wanted} written"
        )
        assert await house.sim.registers("c") == before | {"kd": wanted}


async def test_parameters_are_read_compared_and_written(house, tmp_path):
    dump = tmp_path / "feed.toml"
    dump.write_text(
        'axis = "feed"\ndriver_type = 0x000C\n\n[parameters]\nPn100 = 90  # Speed loop gain\nPn102 = 40\n',
        encoding="utf-8",
    )
    async with house.desk() as desk:
        await desk.open("parameters/mixed/feed")
        await desk.button("Take control").click()
        await desk.button("Read all").click()
        await expect(desk.button("Read all again")).to_be_visible()
        row = desk.page.get_by_role("row", name="Pn100")
        await expect(row).to_contain_text("80")

        await desk.page.get_by_label("Compare with a file").set_input_files(dump)
        await expect(row).to_contain_text("differs")
        await desk.button("Plan").click()
        await expect(desk.panel("Restore, save or clone")).to_contain_text("Pn100")
        await desk.button("Write 2 values").click()

        await expect(desk.panel("Restore, save or clone")).to_contain_text("the drive holds the values")
        request = ReadParameter(parameter="Pn100")
        reading = await house.mixed.rig.command("feed", request, 60)
        assert (reading.value.active, reading.value.stored) == (90, 90)

        dump.write_text(dump.read_text(encoding="utf-8").replace("Pn100 = 90", "Pn100 = 91"), encoding="utf-8")
        await desk.page.get_by_label("Compare with a file").set_input_files(dump)
        await expect(row).to_contain_text("differs")
        await expect(desk.panel("Restore, save or clone")).to_contain_text("Plan it first.")  # of the file of that name


async def test_a_button_that_has_come_under_a_resting_hand_does_nothing_before_it_is_pressed_again(house):
    """Reset is done, and Home stands where it was: a second press there would move the axis."""
    await house.sim.quiet("y")
    async with house.desk() as desk:
        await desk.open("axis/sim/y")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("y", lambda state: state.enabled)
        await desk.open("rig")
        await desk.page.keyboard.press("Escape")
        await house.sim.until("y", lambda state: state.stop_latched)
        row = desk.page.get_by_role("group", name="Commands for y", exact=True)
        reset = row.get_by_role("button", name="Reset y")
        await expect(reset).to_be_enabled()
        await reset.scroll_into_view_if_needed()
        before = await house.sim.position("y")

        await reset.hover()
        await desk.page.mouse.down()
        await desk.page.mouse.up()
        home = row.get_by_role("button", name="Home y")
        await expect(home).to_be_enabled()
        box = await home.bounding_box()
        at = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        pressed = await desk.page.evaluate(
            "() => [...document.querySelectorAll('button:hover')].map((b) => b.textContent)"
        )
        await desk.page.mouse.down()
        await desk.page.mouse.up()
        if pressed == ["Home y"]:  # a message above the table may have moved it away instead
            await expect(desk.page.locator("main")).to_contain_text("Not done: this button has come under your hand")
        await desk.page.wait_for_timeout(500)
        assert abs(await house.sim.position("y") - before) < 0.02

        await desk.page.mouse.move(at[0], at[1] + 200)
        await home.click()
        await house.sim.until("y", lambda state: state.state == "homing")
        await desk.page.keyboard.press("Escape")
        await house.sim.until("y", lambda state: state.stop_latched)
        await house.sim.quiet("y")


async def test_a_refusal_goes_with_what_was_refused(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)
        panel = desk.panel("Move")
        await panel.get_by_label("Move", exact=True).select_option("move_velocity")
        await panel.get_by_label("Velocity mm/s").fill("0")
        await desk.button("Move").click()
        refusal = panel.locator(".refusal", has_text="not a motion")
        await expect(refusal).to_be_visible()

        await panel.get_by_label("Velocity mm/s").fill("1")
        await expect(refusal).to_have_count(0)
    await house.sim.quiet("x")


async def test_home_of_all_leaves_an_axis_that_is_homed_where_it_is(house):
    """Homed again away from its mark, it would stand at another origin and say that all is well."""
    await house.sim.quiet("x", "y")
    await house.sim.rig.command("x", SetPosition(position=12.5))
    async with house.desk() as desk:
        await desk.open("rig")
        await desk.panel("Rig sim").get_by_role("button", name="Take control of all").click()
        row = desk.page.get_by_role("group", name="Commands for all axes of sim")
        await row.get_by_role("button", name="Enable all").click()
        for axis in ("x", "y"):
            await house.sim.until(axis, lambda state: state.enabled)
        await row.get_by_role("button", name="Home all").click()
        await house.sim.until("y", lambda state: state.state == "homing")
        await desk.page.keyboard.press("Escape")

        assert await house.sim.position("x") == pytest.approx(12.5, abs=0.02)
        assert (await house.sim.rig.state("x")).referenced
    await house.sim.quiet("x", "y")


async def test_no_place_and_no_word_about_it_is_cut_at_1280_pixels(house):
    await house.sim.quiet("y")
    await house.sim.rig.command("y", SetPosition(position=-90.0))
    async with house.desk(width=1280) as desk:
        await desk.open("rig")
        row = desk.panel("Rig sim").locator("tr[data-axis=y]")
        await expect(row.locator("td.main")).to_contain_text("90.000")
        cut = """(row, words) => {
          const homed = row.querySelector("td.homed");
          const mark = document.createElement("span");
          homed.replaceChildren(mark);
          return words.filter((word) => {
            [mark.className, mark.textContent] = ["mark unhomed", word];
            return homed.scrollWidth > homed.clientWidth;
          }).concat([...row.querySelectorAll("td.number")].filter((each) => each.scrollWidth > each.clientWidth)
            .map((each) => each.textContent));
        }"""
        assert await row.evaluate(cut, ["reference lost", "not homed", "line down", "no answer"]) == []


async def test_after_a_short_motion_the_page_asks_nobody_to_wait_until_the_axis_stands(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)
        move = desk.panel("Move")
        await move.get_by_label("Move", exact=True).select_option("by a distance")
        await move.get_by_label("Distance mm").fill("-0.05" if await house.sim.position("x") > 0 else "0.05")
        await expect(desk.button("Move")).to_be_enabled()
        await desk.page.evaluate(
            """() => {
              const move = [...document.querySelectorAll(".panel")].find((each) => each.innerText.startsWith("Move"));
              window.wrong = [];
              const look = () => {
                const stands = document.querySelector(".lamps").textContent.includes("moving no");
                if (stands && move.textContent.includes("wait until the axis stands")) window.wrong.push("asked");
                requestAnimationFrame(look);
              };
              move.querySelector("button.main").addEventListener("click", () => setTimeout(look, 300));
            }"""
        )
        await desk.page.keyboard.press("Tab")
        await desk.button("Move").click()
        await expect(move.locator(".story")).to_contain_text("settled")
        await expect(desk.button("Move")).to_be_enabled()
        assert not await desk.page.evaluate("() => window.wrong")


ENDED_UNHEARD = """async () => {
  const [{ rigs }, { feed }] = await Promise.all(["rigs", "feed"].map((name) => import(`/static/session/${name}.js`)));
  const rig = rigs.get("sim");
  rig.run = { end: null };
  for (const axis of rig.axes.values()) axis.trace = { phase: "recording" };
  const spoken = feed.spoken;
  feed.open();
  while (feed.spoken === spoken) await new Promise((resolve) => setTimeout(resolve, 20));
  return [rig.runs, [...rig.axes.values()].filter((axis) => axis.trace?.phase === "recording").length];
}"""
"""What a page has kept of a run and of traces that ended while its socket was lost."""


async def test_what_has_ended_while_a_page_heard_nothing_is_not_under_way_once_it_hears_again(house):
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await expect(desk.page.get_by_role("heading", name="Now")).to_be_visible()

        assert await desk.page.evaluate(ENDED_UNHEARD) == [False, 0]
