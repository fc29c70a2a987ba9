"""The console's pages of a drive with parameters: digits, wear, alarms, signals, tuning by parameters."""

import asyncio
import re

import pytest

from ldcnd.contract.errors import LeaseHeld
from ldcnd.contract.parameters import Memory, ReadAllParameters, ReadParameter, WriteParameter
from ldcnd.drives.smartstep.monitors import HISTORY_LENGTH
from tests.browser.house import LOOKED_EACH_S, PATIENCE_S
from tests.browser.marks import IN_THE_HOUSE

axe = pytest.importorskip("axe_playwright_python.async_playwright", reason="needs axe-playwright-python")
playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

BROKEN_RULES = "async () => (await window.axe.run()).violations.map(({ id }) => id)"
UPLOAD_MS = 120_000
"""Maximum time of a trace of 500 samples on a line that is polled at two thirds of what it carries, milliseconds."""
FAULTS_OF_A_DRIVE = """async ({ reset }) => {
  const { html, render } = await import('/static/html.js');
  const { FaultPanel } = await import('/static/pages/axis_faults.js');
  const fault = { code: "alarm_0010", text: "A.10: Overcurrent", since: 0, source: "drive", stops: true };
  const rig = { commands: new Map() };
  const can = (verb) => verb !== "reset" || reset;
  const axis = { name: "feed", can, faults: [fault], samples: {}, rig, condition: { live: true } };
  const place = document.createElement("div");
  render(html`<${FaultPanel} axis=${axis} />`, place);
  return { text: place.innerText || place.textContent, buttons: place.querySelectorAll("button").length };
}"""


class HeldFeed:
    """The feed of a page of which nothing comes through until it is let go."""

    def __init__(self):
        self.held, self.sockets = True, []

    def connect(self, socket):
        server = socket.connect_to_server()
        kept = []
        server.on_message(lambda message: kept.append(message) if self.held else socket.send(message))
        self.sockets.append((socket, kept))

    def let_go(self):
        self.held = False
        for socket, kept in self.sockets:
            for message in kept:
                socket.send(message)


async def test_a_reset_is_offered_only_where_the_drive_has_one(house):
    async with house.desk() as desk:
        await desk.open("rig")
        without = await desk.page.evaluate(FAULTS_OF_A_DRIVE, {"reset": False})
        resettable = await desk.page.evaluate(FAULTS_OF_A_DRIVE, {"reset": True})

    assert (without["buttons"], resettable["buttons"]) == (0, 1)
    assert "reset at the drive, not over its line" in without["text"]
    assert "stops the axis" in without["text"]
    assert "motor off" not in without["text"]


REGISTERS_OF_A_DRIVE = """async ({ live }) => {
  const { html, render } = await import('/static/html.js');
  const { GainsPanel } = await import('/static/pages/axis_gains.js');
  const kp = { name: "kp", value: 200, provenance: "written_and_acknowledged" };
  const rig = { commands: new Map(), worth: null };
  const axis = { name: "y", can: () => true, samples: {}, rig, info: { registers: [kp] }, condition: { live } };
  const place = document.createElement("div");
  render(html`<${GainsPanel} axis=${axis} />`, place);
  return [place.querySelector("section").dataset.stale, place.textContent.includes("old values")];
}"""


async def test_gains_are_old_while_their_drive_does_not_answer(house):
    async with house.desk() as desk:
        await desk.open("rig")

        assert await desk.page.evaluate(REGISTERS_OF_A_DRIVE, {"live": True}) == ["no", False]
        assert await desk.page.evaluate(REGISTERS_OF_A_DRIVE, {"live": False}) == ["yes", True]


async def test_a_signal_is_shown_by_its_active_level(house):
    async with house.desk() as desk:
        await desk.open("axis/mixed/feed")

        await expect(desk.panel("Now")).to_contain_text("RUN on (high: RESET)")


async def test_parameters_are_shown_with_factory_values_as_hints_and_written_digit_by_digit(house):
    async with house.desk() as desk:
        await desk.open("parameters/mixed/spool")
        await desk.button("Take control").click()
        await desk.button("Read all").click()
        await expect(desk.button("Read all again")).to_be_visible()
        table = desk.page.get_by_role("region", name="Parameters")
        heads = await table.get_by_role("columnheader").all_inner_texts()
        row = table.get_by_role("row", name="Pn505")
        cells = await row.get_by_role("cell").all_inner_texts()

        assert cells[heads.index("Factory (a hint)") - 1] == "1024"
        change = desk.panel("Change one")
        await change.get_by_label("Parameter").select_option("Pn001")
        await expect(change.get_by_label("Pn001.0")).to_contain_text("2: coasting")
        await change.get_by_label("Pn001.0").select_option("2")
        await expect(change.get_by_label("New value")).to_have_value("0002H")
        await change.get_by_label("New value").fill("1,5")
        await expect(change.locator(".reason")).to_have_text(
            "New value: \u201c1,5\u201d is not 0 to 65535, without zeros in front, nor 0x0000 to 0xFFFF."
        )
        await change.get_by_label("New value").fill("0x0102")
        await expect(change.get_by_label("Pn001.2")).to_have_value("1")
        await change.get_by_label("Memory").select_option("eeprom")
        await desk.button("Write Pn001").click()

        await expect(table.get_by_role("row", name="Pn001")).to_contain_text("0102H")
        reading = await house.mixed.rig.command("spool", ReadParameter(parameter="Pn001"), 60)
        assert reading.value.stored == 0x0102

        wear = desk.panel("EEPROM writes")
        await expect(wear).to_contain_text("Only for a drive that was replaced.")
        await wear.get_by_label("The drive was replaced by a new one").check()
        await desk.button("Count anew").click()
        await expect(wear).to_contain_text("0 writes counted for this drive.")
        dump = await house.mixed.rig.command("spool", ReadAllParameters(), 60)
        assert {value.eeprom_total for value in dump.values} == {0}


async def test_an_axis_is_enabled_while_all_parameters_of_two_drives_are_read(house):
    await house.mixed.quiet("x")
    held = []

    async def unanswered(route):
        held.append(route)

    async with house.desk() as desk:
        await desk.page.route("**/read_all_parameters", unanswered)
        for drive in ("spool", "feed"):
            await desk.open(f"parameters/mixed/{drive}")
            await expect(desk.panel(f"Memories of {drive}")).to_be_visible()
            await desk.button("Read all").click()
        await desk.open("axis/mixed/x")
        await desk.button("Take control").click()
        await desk.button("Enable").click()
        await house.mixed.until("x", lambda state: state.enabled)
        assert held
    await house.mixed.quiet("x")


async def write(house, drive, parameter, value, memory=Memory.RAM):
    """Write a parameter as another client, once the page that was closed has given control back."""
    written = WriteParameter(parameter=parameter, value=value, memory=memory, client="ann")
    async with asyncio.timeout(30):
        while True:
            try:
                return await house.mixed.rig.command(drive, written, 60)
            except LeaseHeld:
                await asyncio.sleep(0.1)


async def test_what_is_in_use_is_saved_and_a_drive_is_cloned_by_the_page(house):
    await write(house, "spool", "Pn401", 77)
    await house.mixed.rig.command("feed", WriteParameter(parameter="Pn402", value=222, memory=Memory.EEPROM), 60)
    async with house.desk() as desk:
        await desk.open("parameters/mixed/spool")
        await desk.button("Take control").click()
        await desk.button("Read all").click()
        panel = desk.panel("Restore, save or clone")
        await panel.get_by_label("Values of").select_option("what spool has in use, for good")
        await desk.button("Plan").click()
        await expect(panel.get_by_role("row", name=re.compile("Pn401 "))).to_contain_text("004DH")
        await panel.get_by_role("button", name=re.compile("^Write ")).click()
        await expect(panel).to_contain_text("the drive holds the values")

        await panel.get_by_label("Values of").select_option("the drive mixed · feed")
        await desk.button("Plan").click()
        await expect(panel.get_by_role("row", name=re.compile("Pn402 .* eeprom"))).to_contain_text("222 (00DEH)")

    saved = await house.mixed.rig.command("spool", ReadParameter(parameter="Pn401"), 60)
    assert saved.value.stored == 77


async def test_what_is_saved_is_in_use_when_it_is_planned(house):
    await write(house, "spool", "Pn401", 78)
    async with house.desk() as desk:
        await desk.open("parameters/mixed/spool")
        await desk.button("Read all").click()
        await expect(desk.button("Read all again")).to_be_visible()
        await write(house, "spool", "Pn401", 79)
        await desk.button("Take control").click()
        panel = desk.panel("Restore, save or clone")
        await panel.get_by_label("Values of").select_option("what spool has in use, for good")
        await desk.button("Plan").click()
        await expect(panel.get_by_role("row", name=re.compile("Pn401 "))).to_contain_text("004FH")
        await panel.get_by_role("button", name=re.compile("^Write ")).click()
        await expect(panel).to_contain_text("the drive holds the values")

    saved = await house.mixed.rig.command("spool", ReadParameter(parameter="Pn401"), 60)
    assert (saved.value.stored, saved.value.active) == (79, 79)


async def test_digits_that_were_not_chosen_are_written_as_they_are_and_not_as_they_were(house):
    await write(house, "spool", "Pn001", 0x0002, Memory.EEPROM)
    async with house.desk() as desk:
        await desk.open("parameters/mixed/spool")
        await desk.button("Read all").click()
        await expect(desk.button("Read all again")).to_be_visible()
        await write(house, "spool", "Pn001", 0x0100, Memory.EEPROM)
        await desk.button("Take control").click()
        change = desk.panel("Change one")
        await change.get_by_label("Parameter").select_option("Pn001")
        await change.get_by_label("Memory").select_option("eeprom")
        await change.get_by_label("Pn001.0").select_option("1")
        doubt = change.get_by_text("Read Pn001 again: ann has written since then.")
        await expect(doubt).to_be_visible()
        async with asyncio.timeout(PATIENCE_S):
            while await doubt.count():  # that the write is done comes behind that it was accepted
                await desk.button("Read Pn001 again").click()
                await expect(change.get_by_label("New value")).to_have_value("0101H")
                await asyncio.sleep(LOOKED_EACH_S)
        await desk.button("Write Pn001").click()
        await expect(
            desk.page.get_by_role("region", name="Parameters").get_by_role("row", name="Pn001")
        ).to_contain_text("0101H")

    written = await house.mixed.rig.command("spool", ReadParameter(parameter="Pn001"), 60)
    assert written.value.stored == 0x0101


async def test_a_plan_is_not_carried_out_on_a_drive_that_has_changed_since(house):
    await house.mixed.rig.command("feed", WriteParameter(parameter="Pn402", value=223, memory=Memory.EEPROM), 60)
    async with house.desk() as desk:
        await desk.open("parameters/mixed/spool")
        await desk.button("Read all").click()
        panel = desk.panel("Restore, save or clone")
        await panel.get_by_label("Values of").select_option("the drive mixed \u00b7 feed")
        await desk.button("Plan").click()
        await expect(panel.get_by_role("row", name=re.compile("Pn402 ")).first).to_be_visible()
        await house.mixed.rig.command("spool", WriteParameter(parameter="Pn102", value=62, client="ann"), 60)
        await desk.button("Take control").click()

        await expect(panel).to_contain_text("Plan it again: ann has written since then.")


async def test_what_was_read_says_when_and_that_another_client_has_written_since(house):
    async with house.desk() as desk:
        await desk.open("parameters/mixed/spool")
        await desk.button("Read all").click()
        memories = desk.panel("Memories of spool")
        await expect(memories).to_contain_text(re.compile(r"Read at \d\d:\d\d:\d\d\."))
        await expect(memories).not_to_contain_text("old values")
        await desk.open("tuning/mixed/spool")
        gains = desk.panel("Gains")
        await expect(gains).to_contain_text("Read at")

        await house.mixed.rig.command("spool", WriteParameter(parameter="Pn102", value=61, client="ann"), 60)

        await expect(gains).to_contain_text("old values: ann has written since then.")
        again, old = gains.get_by_role("button", name="Read again"), gains.get_by_text("old values")
        async with asyncio.timeout(PATIENCE_S):
            while await old.count():  # that the write is done comes behind that it was accepted
                await again.click()
                await expect(gains.get_by_label(re.compile("^Pn102 "))).to_have_value("61")
                await asyncio.sleep(LOOKED_EACH_S)


async def test_when_something_was_read_is_not_known_before_the_daemon_has_told_the_time(house):
    """A page that counted from 1970 until then took every event on record for one since the reading."""
    await house.mixed.rig.command("spool", WriteParameter(parameter="Pn102", value=61, client="ann"), 60)
    feed = HeldFeed()
    async with house.desk() as desk:
        await desk.page.route_web_socket(re.compile("/api/feed"), feed.connect)
        await desk.page.reload()
        await desk.open("tuning/mixed/spool")
        gains = desk.panel("Gains")
        await expect(gains).to_contain_text("Read at --:--:--.")
        await asyncio.sleep(1.0)  # what was read is older than the first sample
        feed.let_go()

        read_at = gains.get_by_text(re.compile(r"Read at \d\d:\d\d:\d\d\."))
        await read_at.wait_for()
        told, now = await read_at.inner_text(), await desk.page.evaluate("Date.now()")
        times = await desk.page.evaluate(
            "(now) => [...Array(60)].map((_, s) => new Date(now - 1e3 * s).toTimeString().slice(0, 8))", now
        )
        assert any(time in told for time in times)
        await expect(gains).not_to_contain_text("old values")


async def test_the_alarm_history_is_numbered_as_in_the_manual(house):
    async with house.desk() as desk:
        await desk.open("parameters/mixed/feed")
        await desk.button("Read alarms").click()
        rows = desk.page.get_by_role("region", name="Alarms", exact=True).get_by_role("rowheader")
        await expect(rows).to_have_count(1 + HISTORY_LENGTH)

        assert await rows.all_inner_texts() == ["now", *map(str, range(HISTORY_LENGTH))]


async def test_a_drive_is_tuned_by_its_parameters_and_its_recorder(house):
    async with house.desk() as desk:
        await desk.open("tuning/mixed/feed")
        await desk.button("Take control").click()
        gain = desk.page.get_by_label(re.compile("^Pn102 "))
        await expect(gain).not_to_have_value("")
        await gain.fill("47")
        await desk.panel("Gains").get_by_role("button", name="Write").nth(2).click()
        await expect(desk.panel("Gains")).to_contain_text(re.compile(r"\d+ is stored"))
        reading = await house.mixed.rig.command("feed", ReadParameter(parameter="Pn102"), 60)
        assert reading.value.active == 47

        await desk.page.get_by_label("Duration").fill("1")
        await desk.button("Record").click()

        upload = desk.panel("Record").get_by_role("progressbar", name="Upload of the trace")
        await expect(upload).to_be_visible(timeout=UPLOAD_MS)
        await expect(desk.panel("Record")).to_contain_text(re.compile(r"uploading: \d+ samples of .*[1-9]\d? %"))
        await desk.page.evaluate(axe.Axe().axe_script)
        assert await desk.page.evaluate(BROKEN_RULES) == []

        row = desk.panel("Runs").get_by_role("row", name=re.compile("^1 "))
        await expect(row).to_contain_text("Pn102 47", timeout=UPLOAD_MS)
        top_speed = float(await row.get_by_role("cell").nth(2).inner_text())
        assert top_speed == pytest.approx(6.0, abs=1.0)  # 200 command units a second, geared by 4, of 8000 counts


async def test_a_stop_names_what_it_does_not_reach_on_every_page(house):
    """The feed turns by pulses that are not the daemon's."""
    await house.mixed.until("feed", lambda state: state.moving == "yes")
    try:
        async with house.desk() as desk:
            await desk.open("axis/mixed/x")
            await expect(desk.panel("Now")).to_be_visible()
            await desk.page.keyboard.press("Escape")
            stops = desk.page.locator(".stops", has_text="mixed: ")
            for place in ("axis/mixed/x", "events"):
                await desk.open(place)
                await expect(stops).to_contain_text("No stop reaches feed, spool; feed may move: emergency stop.")
                await expect(stops).not_to_contain_text("Nothing moves before Reset")
    finally:
        await house.mixed.quiet("x")
        await house.sim.quiet("x", "y", "z", "c")
