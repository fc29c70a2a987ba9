"""What is asked of all axes at once says what became of it on each, and why it cannot be asked."""

import asyncio
import re
from contextlib import AsyncExitStack

import pytest
import pytest_asyncio

from tests.browser.house import PATIENCE_S, DaemonUnderTest, Desk, console, open_browser

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [
    pytest.mark.system,
    pytest.mark.real_time,
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.timeout(240),
]

AXES = ("x", "y", "z")
HOMES = {
    "x": 'method = "index", velocity = 0.5, index_width = 4',
    "y": 'method = "reverse_limit", velocity = -0.5, distance = 4',
    "z": 'method = "index", velocity = 0.5, index_width = 4',
}
"""The limit switch of y lies further away than y may search."""


def bench() -> str:
    """Return the configuration of a rig of three axes, of which y never finds its mark."""
    parts = ['rig = "bench"\n[zenoh]\nlisten = []\n[[bus]]\nname = "line0"\nport = "sim:line0"\nbaud = 115200']
    parts += [
        f'[[bus.axis]]\nname = "{name}"\naddress = {address}\nmodel = "ls-182ap"\nunit = "mm"\ncounts_per_unit = 1000\n'
        "velocity = 5\nacceleration = 50\nlimits = { position_min = -100, position_max = 100 }\n"
        "gains = { kp = 100, kd = 1000, ki = 50, il = 100, ol = 250, el = 4000 }\n"
        f"home = {{ {HOMES[name]} }}"
        for address, name in enumerate(AXES, 1)
    ]
    parts.append(
        '[[sim]]\nname = "line0"\nmodule = [{ model = "ls-182ap" }, { model = "ls-182ap" }, { model = "ls-182ap" }]'
    )
    return "\n".join(parts)


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def there(tmp_path_factory):
    """The daemon of that rig, and a desk that was let in."""
    config = tmp_path_factory.mktemp("bench") / "bench.toml"
    config.write_text(bench(), encoding="utf-8")
    daemon = DaemonUnderTest(config)
    async with AsyncExitStack() as stack:
        stack.push_async_callback(daemon.end)
        await daemon.start()
        browser = await stack.enter_async_context(open_browser())
        link = await stack.enter_async_context(console(daemon.endpoint))
        context = await browser.new_context(viewport={"width": 1400, "height": 900}, reduced_motion="reduce")
        stack.push_async_callback(context.close)
        context.set_default_timeout(PATIENCE_S * 1e3)
        expect.set_options(timeout=PATIENCE_S * 1e3)
        page = await context.new_page()
        await page.goto(link)
        await expect(page.locator("tr[data-axis]")).to_have_count(3)
        yield daemon, Desk(page, link.split("/?")[0])


def commands(desk):
    return desk.page.get_by_role("group", name="Commands for all axes of bench")


async def taken_and_enabled(daemon, desk):
    """Begin with disabled axes and end with enabled ones that the page controls; returns the commands for all axes."""
    await daemon.quiet(*AXES)
    await desk.open("rig")
    await desk.page.reload()
    every = commands(desk)
    await every.get_by_role("button", name="Take control of all").click()
    await every.get_by_role("button", name="Enable all").click()
    await expect(every.locator(".told")).to_have_text(re.compile(r"^Enable at [0-9:]+: x, y, z done\.$"))
    return every


async def test_home_of_all_says_of_each_axis_how_it_ended(there):
    daemon, desk = there
    every = await taken_and_enabled(daemon, desk)
    told = every.locator(".told")
    await every.get_by_role("button", name="Home all").click()
    await daemon.until("y", lambda state: state.state == "homing")
    await expect(told).to_contain_text("y under way")
    await expect(told).to_contain_text("x, z done")  # homed within a few hundredths of a millimetre
    assert (await daemon.rig.state("y")).state == "homing"

    await expect(told).to_contain_text("y failed: no reverse")
    await desk.open("events")
    await desk.open("rig")
    await expect(told).to_contain_text("y failed: no reverse")


async def test_a_command_that_a_halt_overtakes_moves_nothing(there):
    daemon, desk = there
    every = await taken_and_enabled(daemon, desk)
    halted = asyncio.Event()

    async def slowly(route):
        await halted.wait()
        await route.continue_()

    await desk.page.route("**/axes/y/home", slowly)
    await every.get_by_role("button", name="Home all").click()
    async with desk.page.expect_response("**/axes/y/halt"):
        await every.get_by_role("button", name="Halt all").click(force=True)  # what stands is halted, too
    async with desk.page.expect_response("**/axes/y/home"):
        halted.set()
    await expect(desk.page.locator("tr.refusal").filter(has_text="y: ")).to_contain_text(
        "came after this was asked for"
    )
    await desk.page.unroute("**/axes/y/home")
    assert (await daemon.rig.state("y")).state == "standstill"


async def test_a_halt_of_another_page_keeps_what_was_pressed_before_it_from_beginning(there):
    daemon, desk = there
    await taken_and_enabled(daemon, desk)
    halted = asyncio.Event()

    async def slowly(route):
        await halted.wait()
        await route.continue_()

    other = await desk.page.context.new_page()
    await other.goto(f"{desk.url}/#/rig")
    await desk.page.route("**/home", slowly)
    for axis in "yz":
        await desk.button(f"Home {axis}").click()
    async with other.expect_response("**/axes/y/halt"):
        await other.get_by_role("button", name="Halt y", exact=True).click(force=True)  # what stands is halted, too
    async with desk.page.expect_response("**/axes/y/home"), desk.page.expect_response("**/axes/z/home") as beside:
        halted.set()
    await expect(desk.page.locator("tr.refusal").filter(has_text="y: ")).to_contain_text(
        "came after this was asked for"
    )
    await desk.page.unroute("**/home")
    await other.close()
    assert (await daemon.rig.state("y")).state == "standstill"
    assert (await beside.value).status == 200


@pytest.mark.parametrize("got_through", [True, False])
async def test_what_is_pressed_behind_a_halt_that_is_not_answered_waits_for_nothing(there, got_through):
    """It is sent where the page shows the halt, and refused where it may overtake it; it never comes later."""
    daemon, desk = there
    await taken_and_enabled(daemon, desk)
    sent, go_on = [], asyncio.Event()

    async def slowly(route):
        answer = await route.fetch() if got_through else None
        await go_on.wait()
        await (route.fulfill(response=answer) if answer else route.continue_())

    desk.page.on("request", lambda request: sent.append(request.url.rpartition("/")[2]))
    stops = (await daemon.rig.state("y")).stops
    await desk.page.route("**/axes/y/halt", slowly)
    await desk.button("Halt y").click(force=True)  # what stands is halted, too
    await expect(desk.page.get_by_role("alert").filter(has_text="no answer yet")).to_be_visible()  # it moves the rows
    if got_through:
        await daemon.until("y", lambda state: state.stops > stops)
    await desk.button("Home y").click()
    if got_through:
        await daemon.until("y", lambda state: state.state == "homing")
    else:
        await expect(commands(desk)).to_contain_text("not known whether your stop has come through; nothing was sent")
    async with desk.page.expect_response("**/axes/y/halt"):
        go_on.set()
    await desk.page.unroute("**/axes/y/halt")
    await daemon.until("y", lambda state: state.state == "standstill" or got_through)
    assert sent.count("home") == got_through


async def test_what_is_pressed_behind_what_has_no_answer_is_said_not_to_be_sent_and_is_not_sent_later(there):
    daemon, desk = there
    await taken_and_enabled(daemon, desk)
    sent, go_on = [], asyncio.Event()

    async def slowly(route):
        await go_on.wait()
        await route.continue_()

    desk.page.on("request", lambda request: sent.append(request.url.partition("/axes/")[2]))
    await desk.page.route("**/home", slowly)
    for axis in "yzx":
        await desk.button(f"Home {axis}").click()
    await expect(commands(desk)).to_contain_text("what was asked before has no answer yet; nothing was sent")
    async with desk.page.expect_response("**/axes/y/home"), desk.page.expect_response("**/axes/z/home"):
        go_on.set()
    await desk.page.unroute("**/home")
    await daemon.until("z", lambda state: state.state == "standstill" and state.command is None)
    assert sorted(each for each in sent if each.endswith("/home")) == ["y/home", "z/home"]


async def test_a_stop_of_all_finds_a_connection_while_a_halt_of_many_is_not_answered(there):
    daemon, desk = there
    every = await taken_and_enabled(daemon, desk)
    sent, go_on = [], asyncio.Event()

    async def slowly(route):
        sent.append(route.request.url)
        await go_on.wait()
        await route.continue_()

    await desk.page.route("**/halt", slowly)
    await every.get_by_role("button", name="Halt all").click(force=True)  # what stands is halted, too
    async with desk.page.expect_response("**/api/stop"):
        await desk.page.keyboard.press("Escape")
    assert len(sent) == 2

    async with desk.page.expect_response("**/axes/z/halt"):
        go_on.set()
    await desk.page.unroute("**/halt")


async def test_a_homing_that_a_stop_ends_is_said_to_be_stopped(there):
    daemon, desk = there
    every = await taken_and_enabled(daemon, desk)
    await every.get_by_role("button", name="Home all").click()
    await daemon.until("y", lambda state: state.state == "homing")
    await desk.page.keyboard.press("Escape")
    await daemon.until("y", lambda state: state.stop_latched)

    # the others may have found their marks by then, or not
    await expect(every.locator(".told")).to_contain_text(re.compile(r"y(, z)? stopped"))
    await expect(every.locator(".told")).not_to_contain_text("y done")


async def test_a_command_for_all_that_cannot_be_sent_says_what_each_axis_wants_first(there):
    daemon, desk = there
    await daemon.quiet(*AXES)
    await desk.open("rig")
    await desk.page.reload()
    every = commands(desk)
    await desk.page.get_by_role("button", name="Take control x").click()
    await desk.page.get_by_role("button", name="Enable x").click()
    await daemon.until("x", lambda state: state.enabled)
    await daemon.rig.stop()
    await desk.page.get_by_role("button", name="Reset x").click()
    await daemon.until("x", lambda state: not state.stop_latched)

    await expect(every.get_by_role("button", name="Reset all")).to_have_attribute("title", "y, z: Take control first.")
    await expect(every.get_by_role("button", name="Enable all")).to_have_attribute("title", "y, z: Take control first.")
    await every.get_by_role("button", name="Take control of all").click()
    await every.get_by_role("button", name="Disable all").click()
    await expect(every.get_by_role("button", name="Home all")).to_have_attribute(
        "title", re.compile("y(, z)?: .*press Reset")
    )
    await every.get_by_role("button", name="Reset all").click()
    await expect(every.locator(".told")).to_have_text(re.compile(r"^Reset at [0-9:]+: y, z done\.$"))
    await expect(every.get_by_role("button", name="Home all")).to_have_attribute(
        "title", re.compile("x, y, z: it is disabled: press Enable|y: it is disabled: press Enable")
    )
    await expect(every.get_by_role("button", name="Reset all")).to_have_attribute(
        "title", re.compile("Nothing to reset")
    )


async def test_a_preview_is_that_of_now(there):
    """It was typed at another speed override; where an axis is not homed, its end is no place."""
    daemon, desk = there
    await taken_and_enabled(daemon, desk)
    await desk.open("axis/bench/x")
    preview, position = desk.panel("Move").locator(".preview"), desk.panel("Move").get_by_label("Position mm")
    if not (await daemon.rig.state("x")).referenced:
        await position.fill("50")
        await expect(preview).to_contain_text("Ends at (50.000) mm, not homed")
    await desk.panel("Home").get_by_label("Current position is").fill("0")
    await desk.button("Set position").click()
    await position.fill("20")
    await expect(preview).to_contain_text("Ends at 20.000 mm, at 5.000 mm/s")
    for percent, said in (
        (25, "by the speed override of 25 %"),
        (0, "override of the rig is 0 %"),
        (100, "at 5.000 mm/s,"),
    ):
        await override(desk, percent)
        await expect(preview).to_contain_text(said)
        await expect(preview).not_to_contain_text("by rounding")
    await expect(preview).not_to_contain_text("refused")


async def override(desk, percent):
    """Set it as a colleague would, with the control that this page has."""
    await desk.page.evaluate(
        """async (percent) => {
          const { rigs } = await import("/static/session/rigs.js");
          const { setSpeedOverride } = await import("/static/session/control.js");
          await setSpeedOverride(rigs.get("bench"), percent);
        }""",
        percent,
    )
