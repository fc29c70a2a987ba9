"""Numbers typed key by key into every field of every page, in two engines, while axes move and values come in."""

import asyncio
import json
import time
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from ldcnd.client.lease import control
from ldcnd.contract.commands import MoveVelocity, Power, SetPosition
from ldcnd.contract.number_text import NotANumber, read_number
from ldcnd.contract.units import AxisUnits, Dimension, read_quantity, unit_table
from tests.support.marionette import CONTROL, DELETE, ENTER

windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
until = windows.until

pytestmark = [
    pytest.mark.system,
    pytest.mark.real_time,
    pytest.mark.asyncio(loop_scope="package"),
    pytest.mark.timeout(600),
]

TABLE = json.loads((Path(__file__).parents[1] / "vectors" / "typed_numbers.json").read_text(encoding="utf-8"))
LEFT_OUT = {
    *("   ", "-0", "007", ",5", "1,5E\u22122", "1.234", "-12,345", "1'000", "1/2", "5-", "- 5", "-", "-inf", "1.5 MM"),
    *("1\u066b5", "1\u0665", "100.5", "1;2", "1.234.567", "1.5 um", "Infinity", ".", "1e-999"),
}
"""Further cases of the readers; the browsers say nothing more about them."""
TEXTS = [
    each["text"]
    for each in TABLE
    if len(each["text"]) <= len("1.234.567") and each.get("unit", "mm") == "mm" and each["text"] not in LEFT_OUT
]
MOVED = ("1.5", "1.05", "1,5", "0.05", "12.25", "-1.5", "−1,25", "1e1", ".5", "5.", "+2", "2.5 mm", "1500 um")  # noqa: RUF001
REFUSED = ("1,234", "1.234,5", "1 2", "1.5 kg", "0x10", "NaN", "--5")
TURNING = AxisUnits("deg", unit_table("deg", None, None, None, {}))
SLIDE = AxisUnits("mm", unit_table("mm", None, None, None, {}))
KEY_PAUSE_MS = 8
FIELDS = "input[inputmode=decimal]"
FOUND = f"""[...document.querySelectorAll("{FIELDS}")].filter(
  (field) => !panel || field.closest(".panel").querySelector("h2").textContent === panel)"""
COUNT = f"(panel) => {FOUND}.length"
FOCUS = f"(panel, at) => {FOUND}[at].focus()"
READ = (
    f"(panel) => {FOUND}"
    """.map((field) => ({
  label: field.labels[0]?.textContent ?? field.ariaLabel,
  unit: field.labels[0]?.querySelector(".unit")?.textContent ?? "",
  text: field.value,
  invalid: field.ariaInvalid === "true",
  refusal: field.parentElement.querySelector(".unread")?.textContent ?? "",
  read: field.parentElement.querySelector(".read")?.textContent ?? "",
}))"""
)
VALUES_COME = """() => new Promise((later) => setTimeout(later, 250))"""
"""Pages are redrawn ten times a second."""
TOLD = """(text) => {
  const story = document.querySelector(".story").textContent;
  return story.includes(text) && story.includes("settled");
}"""
SAID = "(text) => document.querySelector('main').textContent.includes(text)"
PLACES = [
    ("axis/sim/x", None, None),
    ("axis/sim/x", ("Move", "by a distance"), "Move"),
    ("axis/sim/x", ("Move", "at a velocity"), "Move"),
    ("axis/sim/x", ("Move", "with a raw duty"), "Move"),
    ("axis/sim/x", ("Move", "to a sensor value"), "Move"),
    ("trace/sim/x", ("Trigger", "position"), None),
    ("tuning/sim/x", None, None),
    ("rig", None, None),
    ("network", None, None),
    ("tuning/mixed/feed", None, None),
    ("parameters/mixed/feed", "Read all", None),
]
"""Pages, what is chosen or pressed there first, and the panel whose fields are looked at, where not all are."""


PRESSED_S = 30.0
LEAST = {"tuning/mixed/feed": 8}
"""Fields of a page that come one by one, as they are read from a drive."""


async def type_over(window, text):
    await window.keys(CONTROL + "a", *(text or DELETE), pause_ms=KEY_PAUSE_MS)


@asynccontextmanager
async def moving(house, *axes):
    """Let axes run for as long as the context lasts, each towards its middle: one after another leads to no stop."""
    await house.sim.quiet(*axes)
    async with control(house.sim.rig, "the test", *axes, lease_s=60, force=True) as held:
        for axis in axes:
            velocity = -0.05 if await house.sim.position(axis) > 0 else 0.05
            await held.command(axis, Power(on=True))
            await held.command(axis, MoveVelocity(velocity=velocity))
        yield
    await house.sim.quiet(*axes)


async def go(window, house, place, choice):
    await window.open("about:blank")
    await window.open(f"{house.url}/#/{place}")
    await until(window, "() => document.querySelector('h1, .rig') !== null")
    if isinstance(choice, tuple):
        await until(window, windows.CHOOSE, *choice)
    elif choice:
        await until(window, windows.PRESS, choice)
    await until(window, COUNT, None)


def judge(field, text):
    """Return what is wrong with a field into which a text was typed; None when nothing is."""
    if field["text"] != text:
        return f"{field['label']}: {text!r} became {field['text']!r}"
    try:
        if not text.strip():
            value = None
        elif field["unit"] == "deg/s":  # of an axis that turns: rpm and rev/s are taken, too
            value = read_quantity(text, TURNING, Dimension.VELOCITY)
        else:
            value = read_number(text, field["unit"])
    except NotANumber as error:
        quoted = (said.partition(" is not ")[0] for said in (field["refusal"], str(error)))  # units differ by the field
        right = field["invalid"] and len({*quoted}) == 1
    else:
        beyond = field["invalid"] and " is not " in field["refusal"]  # its range, or whole numbers only
        shown = "" if value is None else f"{value:g}"
        right = beyond or (not field["invalid"] and shown in field["read"])
    return None if right else f"{field['label']}: {text!r} is taken as {field}"


@pytest.mark.parametrize(("place", "choice", "panel"), PLACES, ids=str)
async def test_no_key_changes_what_was_typed_before_it(house, window, place, choice, panel, capsys):
    began_s, wrong, least = time.monotonic(), [], LEAST.get(place, 1)
    async with moving(house, "x", "y", "z"):
        await go(window, house, place, choice)
        count = await until(window, COUNT, panel, wanted=lambda found: found >= least)
        for nth in range(len(TEXTS)):
            entries = [TEXTS[(nth + at) % len(TEXTS)] for at in range(count)]
            for at, entry in enumerate(entries):
                await window.evaluate(FOCUS, panel, at)
                await type_over(window, entry)
            await window.evaluate(VALUES_COME)
            found = await window.evaluate(READ, panel)
            assert len(found) == count
            wrong += [each for each in map(judge, found, entries) if each]
    with capsys.disabled():
        took_s = time.monotonic() - began_s
        engine = type(window).__name__
        print(f"\n{engine} {place}: {count} fields x {len(TEXTS)} texts, {len(wrong)} wrong, {took_s:.0f} s")
    assert not wrong, wrong[:10]


async def began(house, place):
    """Tell whether x has gone a part of the way to a place, or is there, within a second."""
    until_s = time.monotonic() + 1.0
    while time.monotonic() < until_s:
        state = await house.sim.rig.state("x")
        if state and (state.moving != "no" or abs(await house.sim.position("x") - place) < 0.02):
            return True
        await asyncio.sleep(0.05)
    return False


async def test_the_shaft_stands_where_the_text_says(house, window):
    await house.sim.quiet("x")
    await house.sim.rig.command("x", SetPosition(position=0.0))
    await go(window, house, "axis/sim/x", None)
    await until(window, windows.TAKE)
    await until(window, windows.PRESS, "Enable")
    await house.sim.until("x", lambda state: state.enabled)
    labels = [each["label"] for each in await window.evaluate(READ, None)]
    at = labels.index("Position mm")
    stands = 0.0
    for refused in REFUSED:
        await window.evaluate(FOCUS, None, at)
        await type_over(window, refused)
        await window.keys(ENTER, ENTER)
        assert (await window.evaluate(READ, None))[at]["refusal"]
    assert abs(await house.sim.position("x") - stands) < 0.01
    await window.evaluate(FOCUS, None, at)
    await type_over(window, "5000")  # beyond the limit: the daemon refuses it, each time
    await until(window, windows.PRESSABLE, "Move")
    await window.keys(ENTER)
    await until(window, SAID, "position_limit")
    await window.keys(ENTER)
    assert not await window.evaluate(SAID, "sent just now")
    await until(window, SAID, "position_limit")
    assert abs(await house.sim.position("x") - stands) < 0.01
    for text in MOVED:
        stands = read_quantity(text, SLIDE, Dimension.POSITION)
        await window.evaluate(FOCUS, None, at)
        await type_over(window, text)
        await until(window, windows.PRESSABLE, "Move")
        said = (await window.evaluate(READ, None))[at]["read"]
        assert said == f"moves x to {stands:g} mm"
        async with asyncio.timeout(PRESSED_S):
            # what the axis tells in the moment of a press may stand in its way; a second one leads to the same place
            await window.keys(ENTER)
            while not await began(house, stands):
                await window.keys(ENTER)
        await house.sim.reaches("x", stands, within=0.02)
        await until(window, TOLD, f"to {stands:.3f}:".replace("-", "\N{MINUS SIGN}"))
        await until(window, windows.PRESSABLE, "Move")  # the same again would be one motion more
