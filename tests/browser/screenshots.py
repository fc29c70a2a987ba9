"""`python -m tests.browser.screenshots FOLDER`: the pictures of the documentation, of rigs that do something."""

import argparse
import asyncio
import io
import tempfile
from pathlib import Path

from PIL import Image
from playwright.async_api import expect

from ldcnd.contract.commands import MoveAbsolute, Power, SetGains
from tests.browser.house import Desk, House, open_house

LARGEST_BYTES = 150_000
COLOURS = 128


async def rig(house: House, desk: Desk) -> None:
    """Show one axis that runs, one that stands, one with a fault."""
    client = house.sim.rig
    for axis in ("x", "y", "z"):
        await client.command(axis, Power(on=True))
    await client.command("y", MoveAbsolute(position=41.25))
    await client.command("z", SetGains(el=5))
    await client.command("z", MoveAbsolute(position=5))
    await house.sim.reaches("y", 41.25, within=0.05)
    await client.command("x", MoveAbsolute(position=60, velocity=5))
    await desk.open("rig")
    await expect(desk.page.get_by_text("position error").first).to_be_visible()
    await expect(desk.panel("Rig sim").locator("tr[data-axis=x] .state")).to_contain_text("moving")
    await expect(desk.panel("Rig sim").locator("tr[data-axis=y] .state")).to_have_text("standstill")


async def axis(house: House, desk: Desk) -> None:
    """Show an axis under control, with a preview."""
    await desk.open("axis/sim/x")
    await desk.button("Take control").click()
    await desk.panel("Move").get_by_label("Position mm").fill("75")
    await expect(desk.panel("Move")).to_contain_text("Ends at 75.000 mm")
    await expect(desk.panel("Control")).to_contain_text("Held by this page")


async def scope(house: House, desk: Desk) -> None:
    """Show moves to and fro, with cursors on them."""
    await house.sim.quiet("x", "y", "z", "c")
    for name in ("x", "c"):
        await house.sim.rig.command(name, Power(on=True))
    await desk.open("scope")
    boxes = desk.page.get_by_role("group", name="sim · x")
    await desk.page.get_by_role("group", name="mixed · x").get_by_label("position", exact=True).uncheck()
    await desk.page.get_by_role("group", name="mixed · feed").get_by_label("position", exact=True).uncheck()
    for label in ("position", "velocity"):
        await boxes.get_by_label(label, exact=True).check()
    await expect(desk.page.get_by_text("redraws a second")).to_be_visible()
    for target in (20, -20, 15, 0):
        await house.sim.rig.command("x", MoveAbsolute(position=target))
        await house.sim.reaches("x", target, within=0.05)
    await desk.button("Pause").click()
    await desk.page.get_by_label("Cursor A").fill("380")
    await desk.page.get_by_label("Cursor B").fill("620")


async def tuning(house: House, desk: Desk) -> None:
    """Show two runs with different gains."""
    await desk.open("tuning/sim/x")
    await desk.button("Take control").click()
    await desk.page.get_by_label("Shape").select_option("steep")
    await desk.page.get_by_label("Record after it").fill("0.3")
    await desk.button("Move 1.000 mm and record").click()
    await expect(desk.page.get_by_role("row", name="Run 1")).to_be_visible()
    await desk.page.get_by_label("New kp").fill("200")
    await desk.button("Write kp = 200").click()
    await expect(desk.button("Write gains")).to_be_visible()
    await desk.page.get_by_role("button", name="Move").and_(desk.page.locator(".main")).click()
    await expect(desk.page.get_by_role("row", name="Run 2")).to_be_visible()


async def commissioning(house: House, desk: Desk) -> None:
    """Show what a step will do, before it is agreed to."""
    await house.sim.quiet("x")
    await desk.open("commissioning/sim/x")
    await desk.button("Begin: Motor against encoder").click()
    await expect(desk.button("Run it")).to_be_visible()


PICTURES = (
    ("rig", rig, "dark", 960),
    ("axis", axis, "light", 1000),
    ("scope", scope, "dark", 860),
    ("tuning", tuning, "light", 900),
    ("commissioning", commissioning, "light", 960),
)


async def take(folder: Path, keep: Path) -> None:
    """Take all pictures.

    Args:
        folder: for the pictures.
        keep: for what the daemons keep.
    """
    async with open_house(keep) as house:
        for name, prepare, scheme, height in PICTURES:
            async with house.desk(scheme, 1280, height) as desk:
                await prepare(house, desk)
                await desk.page.mouse.move(0, 0)
                await desk.page.evaluate("document.activeElement.blur()")
                picture = folder / f"console-{name}.png"
                taken = Image.open(io.BytesIO(await desk.page.screenshot()))
                taken.convert("RGB").quantize(COLOURS).save(picture, optimize=True)
                size = picture.stat().st_size
                assert size < LARGEST_BYTES, f"{picture} has {size} bytes"
                print(f"{picture}: {size} bytes")


def main() -> None:
    """Take the pictures into a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as keep:
        asyncio.run(take(folder, Path(keep)))


if __name__ == "__main__":
    main()
