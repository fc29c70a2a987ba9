"""What keys, the mouse, an input method, the clipboard and the browser itself do to fields and to what is sent."""

import asyncio

import pytest

from ldcnd.contract.commands import SetPosition
from tests.browser.marks import IN_THE_HOUSE
from tests.support.marionette import CONTROL, ENTER, ESCAPE, SHIFT

windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
until = windows.until

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

FIND = """[...document.querySelectorAll("input[inputmode=decimal]")].find(
  (each) => each.closest(".panel").querySelector("h2").textContent === "Move")"""
READ = f"""() => {{
  const field = {FIND};
  if (!field) return null;
  const text = (kind) => field.parentElement.querySelector(kind)?.textContent ?? "";
  const focused = document.activeElement === field;
  return {{ text: field.value, read: text(".read"), refused: text(".unread"), focused }};
}}"""
FOCUS = f"() => {FIND}.focus()"
PLACE = """(text) => {
  const found = [...document.querySelectorAll("input[inputmode=decimal], main button.main")].find((each) =>
    each.closest(".panel").querySelector("h2").textContent === "Move" && each.tagName === (text ? "BUTTON" : "INPUT"));
  found.scrollIntoView({ block: "center" });
  const box = found.getBoundingClientRect();
  return [box.x + box.width / 2, box.y + box.height / 2];
}"""
COPY = """(text) => {
  const from = document.createElement("textarea");
  from.id = "copied";
  from.value = text;
  document.body.append(from);
  from.focus();
  from.select();
}"""
FORGET = "() => document.getElementById('copied').remove()"
SEEN = """() => {
  const seen = (element) => {
    const box = element.getBoundingClientRect();
    const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
    return element.contains(document.elementFromPoint(x, y)) && box.left >= 0 && box.right <= innerWidth + 1;
  };
  const field = FIELD;
  field.scrollIntoView({ block: "center" });
  const stop = document.querySelector("button.stop");
  return { field: seen(field), whole: field.scrollWidth <= field.clientWidth, stop: seen(stop) };
}""".replace("FIELD", FIND)
DRAGGED = """() => {
  const text = document.createElement("p");
  text.id = "dragged";
  text.textContent = "777";
  const field = FIELD;
  field.closest(".panel").before(text);
  getSelection().selectAllChildren(text);
  field.scrollIntoView({ block: "center" });
  const at = ({ x, y, height }) => [x + 10, y + height / 2];
  return [text, field].map((each) => at(each.getBoundingClientRect()));
}""".replace("FIELD", FIND)
DROPPED = f"""() => {{
  const event = new DragEvent("drop", {{ bubbles: true, cancelable: true, dataTransfer: new DataTransfer() }});
  return !{FIND}.dispatchEvent(event);
}}"""


AT_ONCE = f"""(text) => {{
  const field = {FIND};
  field.focus();
  field.select();
  document.execCommand("insertText", false, text);
  field.dispatchEvent(new KeyboardEvent("keydown", {{ key: "Enter", bubbles: true, cancelable: true }}));
  return true;
}}"""
"""Type a text and Enter in one turn of the browser, as programs do that type for a person."""


async def axis_page(window, house):
    await window.open("about:blank")
    await window.open(f"{house.url}/#/axis/sim/x")
    return await until(window, READ)


async def ready(window, house):
    """Open the page of an axis that stands at 0, under its control and enabled."""
    await house.sim.quiet("x")
    await house.sim.rig.command("x", SetPosition(position=0.0))
    await axis_page(window, house)
    await until(window, windows.TAKE)
    await until(window, windows.PRESS, "Enable")
    await house.sim.until("x", lambda state: state.enabled)
    await until(window, windows.PRESSABLE, "+0.1 mm")


async def type_over(window, text):
    await window.evaluate(FOCUS)
    await window.keys(CONTROL + "a", *text)


async def test_a_wheel_changes_no_number_focused_or_not(house, window):
    await axis_page(window, house)
    await type_over(window, "20")
    for focused in (True, False):
        if not focused:
            await window.evaluate("() => document.activeElement.blur()")
        at = await window.evaluate(PLACE, None)
        for by in (120, -120, 3, -3, 1):  # notches of a wheel, and what a touchpad sends
            await window.wheel(*at, by)
        found = await window.evaluate(READ)
        assert (found["text"], found["read"], found["focused"]) == ("20", "moves x to 20 mm", focused)


async def test_undo_and_redo_show_and_mean_the_same(house, window):
    await axis_page(window, house)
    await type_over(window, "12")
    await window.keys(CONTROL + "a", *"3.5")
    texts = set()
    for stroke in [CONTROL + "z"] * 4 + [CONTROL + SHIFT + "z"] * 4:
        await window.keys(stroke)
        found = await window.evaluate(READ)
        texts.add(found["text"])
        right = f"moves x to {float(found['text']):g} mm" if found["text"].strip(".") else ""
        assert found["refused"] or found["read"] == right, found
    assert len(texts) > 1


PASTED = {
    "1,5": "1.5",
    "1.5 mm": "1.5",
    "1.5\n": "1.5",
    "\n 1.5 \r\n": "1.5",
    "\u00a01.5\u00a0": "1.5",
    "1.5\u00a0mm": "1.5",
    "1\n5": None,
    "1.5\n2.5": None,
    "1\u00a0234": None,
    "1\u202f234": None,
    "1\t5": None,
}
"""What is pasted, and the number that it means."""


@pytest.mark.parametrize("text", PASTED, ids=repr)
async def test_what_is_pasted_means_what_it_looks_like_or_is_refused(house, window, text):
    await axis_page(window, house)
    await window.evaluate(COPY, text)
    await window.keys(CONTROL + "c")
    await window.evaluate(FORGET)
    await window.evaluate(FOCUS)
    await window.keys(CONTROL + "a", CONTROL + "v")

    found = await until(window, READ, wanted=lambda field: field["text"])
    if PASTED[text] is None:
        assert found["refused"], found
    else:
        assert (found["read"], found["refused"]) == (f"moves x to {PASTED[text]} mm", "")


async def test_a_dropped_text_changes_nothing(house, window):
    await axis_page(window, house)
    await type_over(window, "20")
    start, field = await window.evaluate(DRAGGED)
    await window.drag(start, field)
    assert (await window.evaluate(READ))["text"] == "20"
    assert await window.evaluate(DROPPED)
    await window.evaluate("() => document.getElementById('dragged').remove()")


async def test_at_twice_the_size_the_number_and_the_stop_are_seen(house, window):
    await axis_page(window, house)
    await type_over(window, "-1234.567")
    try:
        for size in ((640, 400), (320, 568)):
            await window.resize(*size)
            assert await window.evaluate(SEEN) == {"field": True, "whole": True, "stop": True}, size
    finally:
        await window.resize(1400, 900)


async def test_what_a_program_types_with_enter_in_one_turn_is_what_moves(house, window):
    await ready(window, house)
    for text, where in (("1", 1.0), ("2", 2.0), ("-1.5", -1.5), ("0.5", 0.5)):
        assert await window.evaluate(AT_ONCE, text)
        await house.sim.reaches("x", where, 0.02)
        await until(window, windows.PRESSABLE, "+0.1 mm")


async def test_the_enter_that_ends_a_composition_sends_nothing(house, window):
    await ready(window, house)
    await window.evaluate(FOCUS)
    await window.keys(CONTROL + "a")
    await window.compose("2", "2.5")
    found = await until(window, READ, wanted=lambda field: field["read"])
    assert (found["text"], found["read"]) == ("2.5", "moves x to 2.5 mm")
    await asyncio.sleep(0.5)  # that nothing comes cannot be waited for
    assert abs(await house.sim.position("x")) < 0.01

    await window.keys(ENTER)
    await house.sim.reaches("x", 2.5, within=0.02)


@pytest.mark.parametrize("way", ["enter", "click", "enter held on the button"])
async def test_twice_is_one_motion_even_where_a_second_would_wait_its_turn(house, window, way):
    await ready(window, house)
    await until(window, windows.CHOOSE, "Move", "by a distance")
    await until(window, windows.CHOOSE, "If it moves already", "wait for its end")
    await until(window, READ)
    await type_over(window, "0.2")
    await until(window, READ, wanted=lambda field: field["read"] == "moves x by 0.2 mm")
    await until(window, windows.PRESSABLE, "Move")
    if way == "enter":
        await window.keys(ENTER, ENTER, ENTER, pause_ms=60)
    elif way == "click":
        await window.click(*(await window.evaluate(PLACE, "button")), count=2)
    else:
        await window.evaluate(f"() => {FIND}.closest('.panel').querySelector('button.main').focus()")
        await window.hold(ENTER, times=12, pause_ms=120)
    await house.sim.reaches("x", 0.2, within=0.02)
    await asyncio.sleep(0.7)  # for a second motion that was let through
    assert abs(await house.sim.position("x") - 0.2) < 0.02


async def test_an_increment_that_is_double_clicked_is_one(house, window):
    await ready(window, house)
    box = """() => {
      const found = [...document.querySelectorAll("button")].find((each) => each.textContent.trim() === "+0.1 mm");
      found.scrollIntoView({ block: "center" });
      const { x, y, width, height } = found.getBoundingClientRect();
      return [x + width / 2, y + height / 2];
    }"""
    at = await window.evaluate(box)
    await window.click(*at, count=2)
    await house.sim.reaches("x", 0.1, within=0.02)
    await asyncio.sleep(0.5)  # for a second motion that was let through
    assert abs(await house.sim.position("x") - 0.1) < 0.02


@pytest.mark.parametrize("way", ["reload", "back"])
async def test_a_page_that_comes_back_has_its_fields_empty_or_as_typed_and_no_control(house, window, way):
    await ready(window, house)
    fields = """() => [...document.querySelectorAll("input[inputmode=decimal]")].map((each) => each.value)"""
    before = await window.evaluate(fields)
    await type_over(window, "12.5")
    if way == "reload":
        await window.reload()
    else:
        await window.open(f"{house.url}/faults/stop_latched")
        await window.back()
    await until(window, READ)
    await until(window, "() => document.querySelector('.now-state')?.textContent.includes('good')")
    found = await window.evaluate(READ)
    assert found["text"] in ("", "12.5")
    assert found["read"] == ("moves x to 12.5 mm" if found["text"] else "")
    after = await window.evaluate(fields)
    assert after[:1] == before[:1]
    assert {*after} <= {*before, "12.5", ""}
    await until(window, "() => !document.querySelector('.summary').textContent.includes('You control')")


async def test_escape_stops_and_leaves_the_text(house, window):
    await ready(window, house)
    await type_over(window, "12.5")
    await window.keys(ESCAPE)
    await house.sim.until("x", lambda state: state.stop_latched)
    assert (await window.evaluate(READ))["text"] == "12.5"
    await house.sim.quiet("x", "y", "z", "c")
