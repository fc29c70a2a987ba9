"""Whether everybody can use a page: what axe finds on it, and whether it fits on a screen."""

from collections.abc import Mapping

from axe_playwright_python.async_playwright import Axe
from playwright.async_api import Page

from tests.support.marionette import Firefox

SCREENS = {
    "phone": (390, 844),
    "zoomed to 200 %": (640, 400),
    "laptop": (1280, 800),
    "desktop": (1440, 900),
    "large": (1920, 1080),
}
"""Widths and heights in pixels of the page; a laptop's screen has half as many at a zoom of 200 %."""
FITS = """
(width) => {
  const wrong = [];
  const page = document.documentElement.scrollWidth;
  if (page > width) wrong.push(`the page is ${page} wide`);
  for (const field of document.querySelectorAll("input[inputmode=decimal], select"))
  {
    let { left, right } = field.getBoundingClientRect();
    for (let around = field.parentElement; around; around = around.parentElement) {
      if (getComputedStyle(around).overflowX === "visible") continue;
      const box = around.getBoundingClientRect();
      [left, right] = [Math.max(left, box.left), Math.min(right, box.right)];
    }
    if (right - left < 60) wrong.push(`${Math.round(right - left)} of ${field.ariaLabel ?? field.id} can be seen`);
  }
  for (const link of document.querySelectorAll("nav a")) {
    const box = link.getBoundingClientRect();
    if (box.left < 0 || box.right > width) wrong.push(`the link ${link.textContent} is off the screen`);
  }
  const stop = [...document.querySelectorAll("button")].find((button) => button.textContent.includes("Stop all axes"));
  const box = stop?.getBoundingClientRect();
  if (!box || box.left < 0 || box.top < 0 || box.right > width || box.bottom > innerHeight)
    wrong.push("Stop all axes is off the screen");
  return wrong;
}
"""
EVERYTHING = {"resultTypes": ["violations"], "preload": False, "iframes": False, "elementRef": False}
COLOURS = EVERYTHING | {"runOnly": {"type": "rule", "values": ["color-contrast", "link-in-text-block"]}}
"""Only colours depend on the scheme."""
FOUND = """
async (rules) => (await axe.run(rules)).violations.map(
  (each) => `${each.id}: ${each.help}: ${each.nodes.slice(0, 3).map((node) => node.target.join(" ")).join(", ")}`)
"""


async def examine(page: Page) -> None:
    """Load axe into a page; it stays until the page is loaded anew."""
    await page.evaluate(Axe().axe_script)


async def found_wrong(page: Page, screens: Mapping[str, tuple[int, int]]) -> list[str]:
    """Return what axe finds on a page in the dark and in the light, and what does not fit on screens."""
    wrong = []
    for scheme, rules in (("dark", EVERYTHING), ("light", COLOURS)):
        await page.emulate_media(color_scheme=scheme)
        wrong += [f"{scheme}: {found}" for found in await page.evaluate(FOUND, rules)]
    for screen, (width, height) in screens.items():
        await page.set_viewport_size({"width": width, "height": height})
        wrong += [f"{screen}: {found}" for found in await page.evaluate(FITS, width)]
    return wrong


async def examine_in_firefox(window: Firefox) -> None:
    """Load axe into a page of Firefox."""
    await window.command("WebDriver:ExecuteScript", script=Axe().axe_script, args=[])


async def found_wrong_in_firefox(window: Firefox, screens: Mapping[str, tuple[int, int]]) -> list[str]:
    """Return the same of a page of Firefox."""
    wrong = []
    await window.resize(1400, 900)  # as pages of the other browser are when axe sees them
    for scheme, rules in (("dark", EVERYTHING), ("light", COLOURS)):
        await window.prefer(scheme)
        wrong += [f"{scheme}: {found}" for found in await window.evaluate(FOUND, rules)]
    for screen, (width, height) in screens.items():
        await window.resize(width, height)
        wrong += [f"{screen}: {found}" for found in await window.evaluate(FITS, width)]
    return wrong
