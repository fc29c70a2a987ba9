"""The page of an axis while somebody works at it: place and stop are in sight, whatever is filled in."""

import pytest

from tests.browser.marks import IN_THE_HOUSE

windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
until = windows.until

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

SIZES = ((1280, 800), (1920, 1080), (390, 844))
COVERED = """() => {
  const shown = (each, name) => {
    const box = each?.getBoundingClientRect();
    const outside = !box || box.top < 0 || box.bottom > innerHeight || box.left < 0 || box.right > innerWidth + 1;
    if (outside) return [`${name} is off the screen`];
    const over = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
    return each.contains(over) || over?.contains(each) ? [] : [`${over.className || over.tagName} covers ${name}`];
  };
  const button = (name) => [...document.querySelectorAll("button")].find((each) => each.textContent.includes(name));
  const wrong = [];
  for (const field of document.querySelectorAll("main input, main select")) {
    field.focus();
    field.scrollIntoView({ block: "nearest" });
    const name = field.labels?.[0]?.textContent ?? field.ariaLabel;
    wrong.push(...shown(field, `the field ${name}`));
    wrong.push(...shown(document.querySelector(".strip .where"), `the place, at ${name},`));
    wrong.push(...shown(button("Stop x"), `Stop x, at ${name},`));
    wrong.push(...shown(button("Stop all axes"), `Stop all axes, at ${name},`));
  }
  return wrong;
}"""
"""What is not in sight while a field has the focus, field by field."""
JUMP = """async (title) => {
  for (let frame = 0; frame < 3; frame += 1) await new Promise(requestAnimationFrame);
  const button = [...document.querySelectorAll(".jumps button")].find((each) => each.textContent === title);
  const box = button.getBoundingClientRect();
  return [box.left + box.width / 2, box.top + box.height / 2];
}"""
"""Where a button is, some frames after the page got another size."""
WHERE = """(title) => {
  const heading = [...document.querySelectorAll("main h2")].find((each) => each.textContent === title);
  const box = heading.getBoundingClientRect();
  const frame = document.querySelector("header.frame").getBoundingClientRect().bottom;
  return box.top >= frame - 1 && box.bottom < innerHeight / 2;
}"""


async def test_place_and_stop_are_in_sight_in_whatever_field_one_types(house, window):
    await window.open("about:blank")
    await window.open(f"{house.url}/#/axis/sim/x")
    await until(window, "() => document.querySelector('.strip .where') !== null")
    wrong = {}
    try:
        for size in SIZES:
            await window.resize(*size)
            if found := await window.evaluate(COVERED):
                wrong[size] = found
    finally:
        await window.resize(1400, 900)
    assert not wrong


async def test_on_a_phone_each_part_of_the_page_is_one_press_of_the_thumb_away(house, window):
    await window.open("about:blank")
    await window.open(f"{house.url}/#/axis/sim/x")
    await until(window, "() => document.querySelector('.strip .where') !== null")
    try:
        await window.resize(390, 844)
        for title in ("Home", "Jog", "Move", "Control"):
            x, y = await window.evaluate(JUMP, title)
            assert y > 844 * 2 / 3
            await window.click(x, y)
            await until(window, WHERE, title)
    finally:
        await window.resize(1400, 900)
