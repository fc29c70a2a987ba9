"""A link to the console on another page leads a browser that is logged in to where it points, a stranger nowhere."""

import pytest

from tests.browser.marks import IN_THE_HOUSE

windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
until = windows.until

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

LINK = """(url) => {
  document.body.innerHTML = "<a>console</a>";
  const link = document.querySelector("a");
  link.href = url;
  const { x, y, width, height } = link.getBoundingClientRect();
  return [x + width / 2, y + height / 2];
}"""
HEADING = "() => document.querySelector('h1')?.textContent ?? ''"


@pytest.mark.parametrize("elsewhere", ["about:blank", "another site"])
async def test_a_link_elsewhere_leads_a_browser_that_is_logged_in_to_the_page_that_it_names(house, window, elsewhere):
    await window.open("about:blank")
    if elsewhere == "another site":  # to a browser, whoever serves it
        await window.open(house.url.replace("127.0.0.1", "localhost"))
        await until(window, "() => location.search === '?again' && document.querySelector('h1') !== null")
    await window.click(*(await window.evaluate(LINK, f"{house.url}/#/axis/sim/x")))
    await until(window, HEADING, wanted=lambda text: text == "sim / x")
    assert await window.evaluate("() => location.href") == f"{house.url}/#/axis/sim/x"


async def test_a_stranger_asks_once_more_and_no_further(house):
    context = await house.browser.new_context()
    page, asked = await context.new_page(), []
    page.on("request", lambda request: asked.append(request.url) if request.is_navigation_request() else None)
    await page.goto("about:blank")
    await page.evaluate(LINK, f"{house.url}/#/rig")
    await page.get_by_role("link", name="console").click()
    await page.wait_for_url("**/?again#/rig")
    await page.wait_for_load_state("networkidle")
    assert "not let in yet" in await page.inner_text("h1")
    assert asked == [f"{house.url}/", f"{house.url}/?again"]
    await context.close()
