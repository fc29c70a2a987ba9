"""Events during a gap of the feed of a page, or while it changes its streams, are shown on the page."""

import re

import msgpack
import pytest

from ldcnd.contract.commands import Power
from tests.browser.marks import IN_THE_HOUSE

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

FEED, EVENTS = re.compile("/api/feed"), re.compile("/rigs/sim/rig/events$")


class Wire:
    """The connection between a page and the feed of the console, which can be cut and blocked."""

    def __init__(self):
        self.open, self.sockets = True, []

    def connect(self, socket):
        if self.open:
            self.sockets.append(socket)
            socket.connect_to_server()

    async def cut(self):
        self.open = False
        for each in self.sockets:
            await each.close()


async def test_an_event_of_a_gap_is_shown_although_the_first_request_for_it_fails(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        wire, failed = Wire(), []

        async def lost(route):
            if wire.open and not failed:
                failed.append(route.request.url)
                await route.abort()
            else:
                await route.continue_()

        await desk.page.route_web_socket(FEED, wire.connect)
        await desk.page.reload()
        await desk.open("events")
        rows = desk.page.locator("tbody tr")
        await expect(rows.first).to_be_visible()
        await desk.page.route(EVENTS, lost)
        await wire.cut()
        await expect(desk.page.get_by_text("No data from the console process")).to_be_visible()
        await house.sim.rig.command("x", Power(on=True))
        wire.open = True

        await expect(desk.page.get_by_text("No data from the console process")).to_have_count(0)
        await expect(rows.first).to_contain_text("power on")
        await expect(rows.first).to_contain_text("done")
        assert failed
    await house.sim.quiet("x")


def without_events(frame):
    sent_ns, dropped, entries = msgpack.unpackb(frame)
    return msgpack.packb([sent_ns, dropped, [each for each in entries if not str(each[1]).endswith("event")]])


async def test_the_end_of_a_command_whose_event_was_lost_is_asked_for(house):
    await house.sim.quiet("x", "y", "z", "c")
    lost = []

    def connect(socket):
        def pass_on(frame):
            kept = without_events(frame)
            lost.append(len(kept) < len(frame))
            socket.send(kept)

        socket.connect_to_server().on_message(pass_on)

    async with house.desk() as desk:
        await desk.page.route_web_socket(FEED, connect)
        await desk.page.reload()
        await desk.open("rig")
        every = desk.page.get_by_role("group", name=re.compile("Commands for all axes of sim"))
        await every.get_by_role("button", name="Take control of all").click()
        await every.get_by_role("button", name="Enable all").click()

        await expect(every.locator(".told")).to_have_text(re.compile(r"^Enable at [0-9:]+: x, y, z, c done\.$"))
        assert any(lost)
    await house.sim.quiet("x", "y", "z", "c")


async def test_a_page_keeps_its_values_while_it_changes_its_streams(house):
    await house.sim.quiet("x")
    async with house.desk() as desk:
        wire = Wire()
        await desk.page.route_web_socket(FEED, wire.connect)
        await desk.page.reload()
        await desk.open("axis/sim/x")
        place = desk.page.get_by_label("Position", exact=True)
        await expect(place).not_to_contain_text("(")
        wire.open = False
        await desk.open("scope/sim/x")  # it wants other streams, and no socket that it opens speaks
        await house.sim.rig.command("x", Power(on=True))
        await desk.open("axis/sim/x")
        await expect(desk.page.locator(".strip.of-axis")).to_contain_text("standstill")
        await expect(desk.page.get_by_text("No data from the console process")).to_have_count(0)
        wire.open = True
