"""What can be commanded without typing: all axes of a rig, one of a row, and a jog for as long as it is held."""

import asyncio
import re

import pytest
import serial

from ldcnd.client.traces import trace_header
from ldcnd.contract.commands import Halt, SetPosition
from ldcnd.contract.leases import Acquire, ListHolders
from ldcnd.contract.traces import TakeTrace, TracePhase
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from tests.browser.house import LOOKED_EACH_S, PATIENCE_S
from tests.browser.marks import IN_THE_HOUSE

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

AXES = ("x", "y", "z", "c")
MOST_TABS = 90
IS_AT = "(element) => element === document.activeElement"


async def tab_to(desk, wanted):
    """Press Tab until the focus is there, as somebody does who has no mouse."""
    await expect(wanted).to_be_visible()
    for _ in range(MOST_TABS):
        if await wanted.evaluate(IS_AT):
            return
        await desk.page.keyboard.press("Tab")
    raise AssertionError(f"{wanted} is not reached by Tab")


async def press(desk, wanted, key="Enter"):
    await tab_to(desk, wanted)
    await expect(wanted).not_to_have_attribute("aria-disabled", "true")
    await desk.page.keyboard.press(key)


async def holders(house):
    told = await house.sim.rig.ask(ListHolders())
    return {each.axis: each.client for each in told.holders}


async def test_the_rig_page_takes_enables_halts_and_releases_all_axes(house):
    await house.sim.quiet(*AXES)
    async with house.desk() as desk:
        await desk.open("rig")
        every = desk.page.get_by_role("group", name="Commands for all axes of sim")
        for act in ("Enable", "Disable", "Reset", "Home", "Halt"):  # "all" in sight: a filter may hide some of them
            button = every.get_by_role("button", name=f"{act} all", exact=True)
            await expect(button).to_be_visible()
            await expect(button.locator(".unseen")).to_have_count(0)
        await every.get_by_role("button", name="Take control of all").click()
        await every.get_by_role("button", name="Enable all").click()
        for axis in AXES:
            await house.sim.until(axis, lambda state: state.enabled)
        assert len(set((await holders(house)).values())) == 1

        one = desk.page.get_by_role("group", name="Commands for y", exact=True)
        await one.get_by_role("button", name="Disable y").click()
        await house.sim.until("y", lambda state: not state.enabled)
        await expect(one.get_by_role("button", name="Halt y")).to_be_disabled()
        await expect(one.get_by_role("button", name="Halt y")).to_have_attribute("title", "The axis is not moving.")

        await every.get_by_role("button", name="Release control").click()
        await expect(every.get_by_role("button", name="Take control of all")).to_be_visible()
        assert set((await holders(house)).values()) == {None}


async def test_a_jog_runs_while_the_button_or_an_arrow_key_is_held(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)
        jog = desk.panel("Jog")
        await jog.get_by_label("Speed mm/s").fill("2")
        forward, backward = (jog.get_by_role("button", name=f"Hold to run {way}") for way in ("+", "−"))  # noqa: RUF001
        away, back, key = (forward, backward, "ArrowLeft")
        if await house.sim.position("x") > 0:
            away, back, key = (backward, forward, "ArrowRight")

        await expect(away).to_be_enabled()
        box = await away.bounding_box()
        await desk.page.mouse.move(box["x"] + 20, box["y"] + 10)
        await desk.page.mouse.down()
        await house.sim.until("x", lambda state: state.moving == "yes")
        await desk.page.mouse.up()
        await house.sim.until("x", lambda state: state.moving == "no")

        await back.focus()
        await desk.page.keyboard.down(key)
        await house.sim.until("x", lambda state: state.moving == "yes")
        await desk.page.keyboard.up(key)
        state = await house.sim.until("x", lambda state: state.moving == "no")
        assert not state.stop_latched

        before = await house.sim.position("x")
        step = jog.get_by_role("button", name="+1 mm", exact=True)
        await expect(step).to_be_enabled()
        await step.press("Enter")
        await house.sim.reaches("x", before + 1, within=0.05)


async def test_why_a_jog_was_refused_is_not_said_of_another_axis(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)
        jog = desk.panel("Jog")
        await jog.get_by_label("Speed mm/s").fill("9000")
        forward = jog.get_by_role("button", name="Hold to run +")
        await expect(forward).to_be_enabled()
        await forward.focus()
        await desk.page.keyboard.down("ArrowRight")
        await expect(jog).to_contain_text("is above the limit")
        await desk.page.keyboard.up("ArrowRight")
        await desk.page.evaluate("() => { location.hash = '#/axis/sim/y'; }")
        await expect(desk.panel("Jog").get_by_role("group", name="Jog y")).to_be_visible()
        await expect(desk.page.locator("main")).not_to_contain_text("is above the limit")


async def test_a_group_is_moved_together_from_the_rig_page_by_keyboard(house):
    await house.sim.quiet("x", "y")
    for axis in ("x", "y"):
        await house.sim.rig.command(axis, SetPosition(position=0.0))
    async with house.desk(width=1280) as desk:
        await desk.open("rig")
        every = desk.page.get_by_role("group", name="Commands for all axes of sim")
        group = desk.panel("Group gantry")
        await expect(group).to_contain_text("x: Take control first.")
        for name in ("Take control of all", "Enable all"):
            await expect(every.get_by_role("button", name=name)).to_be_enabled()
            await every.get_by_role("button", name=name).focus()
            await desk.page.keyboard.press("Enter")
        for axis in ("x", "y"):
            await house.sim.until(axis, lambda state: state.enabled)

        await group.get_by_label("x to mm").focus()
        await desk.page.keyboard.type("3")
        await desk.page.keyboard.press("Tab")
        await desk.page.keyboard.type("-2")
        await expect(group.get_by_role("button", name="Move x and y together")).to_be_enabled()
        await desk.page.keyboard.press("Enter")

        await house.sim.reaches("x", 3, within=0.05)
        await house.sim.reaches("y", -2, within=0.05)


async def test_a_press_that_did_nothing_says_so_also_once_its_reason_is_over(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)
        before = await house.sim.position("x")
        move = desk.panel("Move")
        await house.sim.rig.stop("x")
        await expect(move).to_contain_text("press Reset")
        await move.get_by_label("Position mm").press_sequentially("7")
        await desk.page.keyboard.press("Enter")
        await desk.button("Reset").click()
        await expect(move).to_contain_text(re.compile("Not done: .*press Reset"))
        await expect(move).not_to_contain_text("Not done")
        assert await house.sim.position("x") == pytest.approx(before, abs=0.05)


async def test_a_move_that_waits_for_its_turn_says_so_and_its_refusal_is_said_where_the_person_is(house):
    await house.sim.quiet("x")
    sent = []

    async def unanswered(route):
        sent.append(route)

    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)
        for question, button in (("read_all_parameters", "Read all"), ("read_alarms", "Read alarms")):
            await desk.page.route(f"**/{question}", unanswered)
            await desk.open("parameters/mixed/spool")
            await desk.button(button).click()
        await desk.open("axis/sim/x")
        move = desk.panel("Move")
        await move.get_by_label("Position mm").fill("7")
        await expect(move).to_contain_text("Waits for an answer of spool")
        await desk.page.evaluate(
            """() => {
              window.said = [];
              const main = document.querySelector("main");
              const reasons = () => [...main.querySelectorAll("p.reason")].map((each) => each.textContent);
              const note = () => window.said.push(...reasons());
              new MutationObserver(note).observe(main, { subtree: true, childList: true, characterData: true });
            }"""
        )
        await move.get_by_label("Position mm").press("Enter")
        await expect(move).to_contain_text("axis x: what was asked before has no answer yet; nothing was sent")
        await expect(move).to_contain_text("Press again once spool has answered.", ignore_case=True)
        said = await desk.page.evaluate("() => window.said.filter((text) => text.startsWith('This motion'))")
        assert set(said) == {
            "This motion waits for an answer to what was asked before: it is sent within a second, or not at all."
        }

        notices = desk.page.locator(".notices")
        for pressed, button in (
            ("Move", desk.button("Move")),
            ("Home", desk.panel("Rig sim").get_by_role("button", name="Home x", exact=True)),
        ):
            await button.evaluate("(button) => { button.click(); location.hash = '#/events'; }")
            await expect(notices).to_contain_text(
                f"{pressed}: axis x: what was asked before has no answer yet; nothing was sent"
            )
            await notices.get_by_role("button", name="Dismiss").click()
            await expect(notices).not_to_contain_text("nothing was sent")
            await desk.open("rig")
        assert len(sent) == 2
    await house.sim.quiet("x")


async def test_a_group_of_other_units_has_a_velocity_for_each_axis(house):
    await house.sim.quiet("z", "c")
    for axis in ("z", "c"):
        await house.sim.rig.command(axis, SetPosition(position=0.0))
    async with house.desk(width=1280) as desk:
        await desk.open("rig")
        every = desk.page.get_by_role("group", name="Commands for all axes of sim")
        group = desk.panel("Group table")
        for name in ("Take control of all", "Enable all"):
            await every.get_by_role("button", name=name).click()
        for axis in ("z", "c"):
            await house.sim.until(axis, lambda state: state.enabled)
        for label, typed in (
            ("z to mm", "2"),
            ("c to deg", "3"),
            ("Velocity of z mm/s", "4"),
            ("Velocity of c deg/s", "1"),
        ):
            await group.get_by_label(label).press_sequentially(typed)
        await group.get_by_role("button", name="Move z and c together").click()
        await house.sim.reaches("z", 2, within=0.05)
        assert await house.sim.position("c") < 2.5  # it is slower
        await house.sim.reaches("c", 3, within=0.05)


async def test_pins_become_outputs_and_a_slow_velocity_can_be_read(house):
    await house.sim.quiet("z")
    async with house.desk() as desk:
        await desk.open("axis/sim/z")
        await desk.button("Take control").click()
        outputs = desk.panel("Outputs")
        await outputs.get_by_label("Limit 1 (reverse)").select_option("output, high")
        await outputs.get_by_role("button", name="Set outputs").click()
        await expect(outputs.get_by_role("alert")).to_be_empty()
        await expect(outputs.get_by_label("Limit 1 (reverse)")).to_have_value("")
        await outputs.get_by_label("Limit 1 (reverse)").select_option("input")
        await outputs.get_by_role("button", name="Set outputs").click()
        await expect(outputs.get_by_label("Limit 1 (reverse)")).to_have_value("")

        await desk.button("Enable").click()
        await house.sim.until("z", lambda state: state.enabled)
        await desk.panel("Move").get_by_label("Move", exact=True).select_option("at a velocity")
        await desk.panel("Move").get_by_label(re.compile("^Velocity")).fill("0.3")
        await desk.button("Move").click()
        await expect(desk.panel("Now")).to_contain_text(re.compile(r"velocity\s*0\.3[0-9]*"))
        await desk.button("Halt").click()
        await house.sim.until("z", lambda state: state.moving == "no")


async def test_an_operator_without_a_mouse_does_everything_that_a_day_asks_for(house):
    await house.sim.quiet("x")
    await house.sim.rig.command("x", SetPosition(position=0.0))
    async with house.desk(width=1280) as desk:
        await desk.open("rig")
        await press(desk, desk.panel("Rig sim").get_by_role("link", name="x", exact=True))
        await press(desk, desk.button("Take control"))
        await press(desk, desk.button("Enable"))
        await house.sim.until("x", lambda state: state.enabled)

        await tab_to(desk, desk.panel("Move").get_by_label("Position mm"))
        await desk.page.keyboard.type("2")
        await expect(desk.panel("Move")).to_contain_text("Ends at 2.000 mm")
        await desk.page.keyboard.press("Enter")
        await house.sim.reaches("x", 2, within=0.05)

        await tab_to(desk, desk.panel("Jog").get_by_role("button", name="Hold to run +"))
        await desk.page.keyboard.down("ArrowRight")
        await house.sim.until("x", lambda state: state.moving == "yes")
        await desk.page.keyboard.up("ArrowRight")
        await house.sim.until("x", lambda state: state.moving == "no")
        before = await house.sim.position("x")
        await press(desk, desk.panel("Jog").get_by_role("button", name="+1 mm", exact=True), "Space")
        await house.sim.reaches("x", before + 1, within=0.05)

        await press(desk, desk.page.get_by_role("button", name="Stop all axes"))
        await house.sim.until("x", lambda state: state.stop_latched)
        await press(desk, desk.button("Reset"))
        await house.sim.until("x", lambda state: not state.stop_latched)

        await press(desk, desk.page.get_by_role("link", name="Trace", exact=True).first)
        await tab_to(desk, desk.panel("Record x").get_by_label("Samples"))
        await desk.page.keyboard.press("Control+A")
        await desk.page.keyboard.type("20")
        await press(desk, desk.button("Record"))
        await expect(desk.panel("Captures")).to_contain_text("20 samples")
        await press(desk, desk.page.get_by_role("link", name="Rig", exact=True))
        await press(desk, desk.page.get_by_role("group", name="Commands for x").get_by_role("button", name="Disable x"))
        await house.sim.until("x", lambda state: not state.enabled)


async def test_a_program_at_a_port_is_seen_on_the_network_page_and_sent_away(house):
    await house.sim.quiet("x", "y", "z", "c")
    link = house.sim.config.parent / "labview"
    async with house.desk() as desk:
        await desk.open("network")
        ports = desk.panel("Ports of sim on line0")
        await expect(ports).to_contain_text("no program")
        with serial.Serial(str(link), 19_200, timeout=10) as program:
            program.write(encode_packet(Packet(0, CommandCode.SET_ADDRESS, b"\x01\xff")))
            assert len(await asyncio.to_thread(program.read, 2)) == 2
            program.write(encode_packet(Packet(1, CommandCode.CLEAR_STICKY_BITS)))
            assert len(await asyncio.to_thread(program.read, 2)) == 2
            await expect(ports).to_contain_text("labview")
            await expect(ports.get_by_role("cell", name="x", exact=True)).to_be_visible()

            await desk.button("Send labview away").click()

            await expect(ports).to_contain_text("no program")
            with pytest.raises(serial.SerialException):
                await asyncio.to_thread(program.read, 1)
        assert link.is_symlink()


async def test_an_output_is_set_and_an_instant_taken_from_the_network_page(house):
    await house.sim.quiet("x", "y", "z", "c")
    async with house.desk() as desk:
        await desk.open("rig")
        every = desk.page.get_by_role("group", name="Commands for all axes of sim")
        await every.get_by_role("button", name="Take control of all").click()
        await expect(every.get_by_role("button", name="Enable all")).to_be_enabled()
        await desk.open("network")
        module = desk.panel("Module cabinet")
        lines = module.locator("dl")
        await expect(lines).to_contain_text(re.compile("door(on|off)"))
        # what is an input, by its name or its number, cannot be driven
        assert await module.get_by_label("Line").get_by_role("option").all_text_contents() == ["lamp"]
        await module.get_by_role("button", name="Set line lamp").click()
        await expect(lines).to_contain_text("lampon")
        await module.get_by_label("Becomes").select_option("output, low")
        await module.get_by_role("button", name="Set line lamp").click()
        await expect(lines).to_contain_text("4 low")
        await expect(lines).to_contain_text("outputs4")
        await expect(lines).to_contain_text("lampoff")

        await desk.button("Take a snapshot of sim on line0").click()
        taken = desk.panel("Snapshot of sim on line0")
        await expect(taken).to_contain_text("cabinet")
        await expect(taken.get_by_role("row")).to_have_count(6)
        await module.get_by_label("Becomes").select_option("input")
        await module.get_by_role("button", name="Set line lamp").click()
        await expect(lines).to_contain_text("outputsnone")

        await desk.page.evaluate("() => { location.hash = '#/rig'; }")
        await expect(desk.panel("Rig sim").get_by_role("link", name="x", exact=True)).to_be_visible()
        await expect(desk.page.get_by_text("sim · cabinet")).to_have_count(0)  # a module is no axis without values


async def test_a_page_without_the_tick_says_where_control_is_taken_from_another_client(house):
    await house.sim.quiet("x", "y", "z", "c")
    async with house.desk() as desk:
        await house.sim.rig.ask(Acquire(client="anna", axes=("x", "y", "z", "c"), lease_s=60, force=True))
        await desk.open("network")
        module = desk.panel("Module cabinet")
        await module.get_by_role("button", name="Set line lamp").click()
        refusal = module.get_by_role("alert").filter(has_text="controlled by anna")
        await expect(refusal).to_contain_text(re.compile(r"or take it from there on the page of \w+\b"))
        await expect(refusal).not_to_contain_text("tick")

        await refusal.get_by_role("link", name=re.compile("the page of")).click()
        await desk.page.get_by_label("Take it from anna").check()
        await desk.button("Take control").click()
        await expect(desk.panel("Control")).to_contain_text("Held by this page")
    await house.sim.quiet("x", "y", "z", "c")


async def test_a_page_without_the_button_says_on_which_page_it_is(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        await desk.open("axis/sim/x")
        await desk.button("Ask what is in its way").click()
        await expect(desk.panel("Can it move?")).to_contain_text("press Enable.")
        await desk.button("Take control").click()
        await expect(desk.panel("Move")).to_contain_text("press Enable.")
        await desk.page.evaluate("() => { location.hash = '#/tuning/sim/x'; }")
        await expect(desk.panel("Test move")).to_contain_text("press Enable.")  # its button is on that page, too
        await desk.page.evaluate("() => { location.hash = '#/rig'; }")
        row = desk.page.get_by_role("group", name="Commands for x", exact=True)
        await expect(row.get_by_role("button", name="Home x")).to_have_attribute("title", re.compile("press Enable.$"))


async def test_the_events_page_has_all_events_and_says_since_when_they_are_known(house):
    await house.sim.quiet("x")
    for _ in range(80):  # more than one reply takes
        await house.sim.rig.command("x", Halt())
    started = (await house.sim.rig.daemon()).started
    async with house.desk() as desk:
        await desk.open("events")
        panel = desk.panel("Commands and how they ended")
        lost = panel.get_by_text("Events of sim before")
        await expect(lost).to_contain_text("are not known: its daemon began then. A recorder keeps them: ldcnd record.")
        clock = await desk.page.evaluate("(ms) => new Date(ms).toTimeString().slice(0, 8)", started / 1e6)
        await expect(lost).to_contain_text(clock)
        await panel.get_by_label("Axis").select_option("sim/x")
        shown = await panel.get_by_role("status").inner_text()
    assert int(shown.split()[0]) >= 160


async def test_an_event_leads_to_its_packets_and_to_the_trace_of_that_moment(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        trace = TakeTrace(channels=("position",), samples=200, interval_s=0.01)
        taken = await house.sim.rig.command("x", trace)
        async with asyncio.timeout(PATIENCE_S):
            while (
                (header := await trace_header(house.sim.rig, "x")) is None
                or header.trace_id != taken.trace_id
                or (header.phase is not TracePhase.RECORDING)
            ):
                await asyncio.sleep(LOOKED_EACH_S)
        await house.sim.rig.command("x", Halt())
        await desk.open("events")
        panel = desk.panel("Commands and how they ended")
        await panel.get_by_label("Axis").select_option("sim/x")
        row = panel.get_by_role("row", name=re.compile(" halt .*done")).first
        await expect(row.get_by_role("link", name="trace of x")).to_have_attribute("href", "#/trace/sim/x")
        await row.get_by_role("link", name="wire log of x").click()
        packets = desk.page.get_by_role("region", name="Wire log of sim on line0")
        await expect(packets).to_be_in_viewport()
        await expect(packets).to_contain_text("halt")
        await expect(desk.panel("sim · line0").get_by_text("Around ")).to_be_visible()
        times_s = [float(line.split()[0]) for line in (await packets.inner_text()).splitlines()]
        assert times_s[-1] - times_s[0] <= 1.0
