"""A rotor, whose velocity has two numbers: in turns a minute, and what acts at its radius."""

import re

import pytest

from ldcnd.client.lease import control
from ldcnd.contract.commands import MoveVelocity, Power
from tests.browser.house import DaemonUnderTest, Desk, console, open_browser

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(240)]

ROTOR = """
rig = "spinner"
[zenoh]
listen = []
[[bus]]
name = "line0"
port = "sim:line0"
baud = 115200
[[bus.axis]]
name = "rotor"
address = 1
model = "pic-servo-sc"
unit = "rev"
velocity_unit = "rpm"
radius_m = 0.1
counts_per_unit = 8000
modulo = 1
velocity = 30
acceleration = 20
limits = { velocity = 3300, acceleration = 20 }
gains = { kp = 20, kd = 1500, ki = 0, il = 0, ol = 255, el = 16000 }
[[sim]]
name = "line0"
module = [{ model = "pic-servo-sc", plant = { counts_per_rev = 8000, supply_v = 48, inertia_kg_m2 = 4e-4 } }]
"""
CUT = """() => [...document.querySelectorAll("tr[data-axis] td.number")].filter(
  (each) => each.scrollWidth > each.clientWidth).map((each) => each.textContent)"""


@pytest.mark.parametrize("width", [1280, 1300])
async def test_no_number_of_a_fast_rotor_is_cut(tmp_path, width):
    (tmp_path / "rotor.toml").write_text(ROTOR, encoding="utf-8")
    daemon = DaemonUnderTest(tmp_path / "rotor.toml")
    try:
        await daemon.start()
        async with (
            console(daemon.endpoint) as link,
            open_browser() as browser,
            control(daemon.rig, "the test", "rotor", lease_s=60) as held,
        ):
            await held.command("rotor", Power(on=True))
            await held.command("rotor", MoveVelocity(velocity=-55.0, acceleration=20.0, duration_s=40))
            page = await browser.new_page(viewport={"width": width, "height": 900})
            await page.goto(link)
            desk = Desk(page, link.split("/?")[0])
            velocity = desk.page.locator("tr[data-axis=rotor] td[data-label=Velocity]")
            await expect(velocity).to_contain_text(re.compile(r"3[23]\d\d\.\d\d rpm"), timeout=30_000)
            await expect(velocity).to_contain_text(" g)")

            assert await page.evaluate(CUT) == []
    finally:
        await daemon.end()


PAIR = """
[[bus.axis]]
name = "small"
address = 2
model = "pic-servo-sc"
unit = "rev"
velocity_unit = "rpm"
radius_m = 0.05
counts_per_unit = 8000
velocity = 30
acceleration = 20
gains = { kp = 20, kd = 1500, ki = 0, il = 0, ol = 255, el = 16000 }
[[bus.group]]
name = "pair"
axes = ["rotor", "small"]
[[sim]]
"""
"""A second rotor beside the first: the unit that is shown is the same, but so many g are another velocity."""


async def test_a_velocity_that_means_another_one_on_each_axis_of_a_group_is_typed_for_each(tmp_path):
    two = ROTOR.replace("modulo = 1\n", "").replace("\n[[sim]]\n", PAIR)
    two = two.replace("module = [", 'module = [{ model = "pic-servo-sc" }, ')
    (tmp_path / "pair.toml").write_text(two, encoding="utf-8")
    daemon = DaemonUnderTest(tmp_path / "pair.toml")
    try:
        await daemon.start()
        async with console(daemon.endpoint) as link, open_browser() as browser:
            page = await browser.new_page(viewport={"width": 1280, "height": 900})
            await page.goto(link)
            group = Desk(page, link.split("/?")[0]).panel("Group pair")
            await expect(group.get_by_label("rotor to rev")).to_be_visible(timeout=30_000)
            await expect(group.get_by_label("Velocity of rotor rpm")).to_be_visible()
            await expect(group.get_by_label("Velocity of small rpm")).to_be_visible()
    finally:
        await daemon.end()
