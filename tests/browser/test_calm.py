"""Every condition of an axis on the rig page and on the axis page, as a person reads them."""

import asyncio

import pytest

from ldcnd.console.conditions import as_payload
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
  for (const name of axes) rig.axis(name).samples.condition = condition;
  const bus = rig.buses.get("line0");
  if (bus.health) bus.health.up = lineUp;
  changed();
}"""
"""Put what the console process sends into the page; it sends a condition when it is another, so this one stays."""


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
            else:
                await playwright.expect(cell).to_contain_text("(")
                await playwright.expect(cell).to_contain_text(payload(case)["mark"])
                await playwright.expect(desk.page.get_by_text("Nothing needs attention")).to_have_count(0)
                await playwright.expect(attention.get_by_role("link", name="sim · x")).not_to_have_count(0)
        await desk.page.evaluate(SHOW, [["x"], payload(CASES[0]), True])


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
        await desk.page.evaluate(SHOW, [["x"], payload(CASES[0]), True])


async def test_a_line_that_is_down_is_one_cause_with_the_names_of_its_axes(house):
    (down,) = [case for case in CASES if case.name == "line down"]
    async with house.desk() as desk:
        await desk.open("rig")
        line = desk.page.get_by_role("region", name="Line line0 of sim")
        await playwright.expect(line).to_contain_text("in use")
        async with asyncio.timeout(30):
            while True:  # a report of the living line may come in between
                await desk.page.evaluate(SHOW, [["x", "y", "z", "c"], payload(down), False])
                causes = desk.page.locator(".attention li").filter(has_text="The line is not up")
                texts = await causes.all_inner_texts()
                if len(texts) == 1 and all(f"sim · {name}" in texts[0] for name in ("line0", "x", "y", "z", "c")):
                    break
                await asyncio.sleep(0.05)
        assert await desk.page.locator(".attention li").count() == 1
        await playwright.expect(desk.page.locator(".summary")).to_contain_text("1 needs attention")
        await desk.page.evaluate(SHOW, [["x", "y", "z", "c"], payload(CASES[0]), True])
