"""The lists in CONTRIBUTING name all that has to change: a change is made by them in a copy of the house."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.process import ROOT

VERB = "blink"
PROGRAM = """
import asyncio
from tests.support.verb_table import empty_cells
from tests.support.rig import running_rig
from ldcnd.daemon.publish.contract import all_schemas, channels
from ldcnd.client.rig import Rig
from ldcnd.model.samples import LinkState

async def main():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        async with Rig(rig.client, await rig.client.daemon()).control("x", client="ann") as x:
            reply = await x.blink(3)
        info = {axis.axis: axis for axis in await rig.client.axes()}["x"]
    print(reply.verb, "blink" in info.capabilities, "blink_request" in all_schemas())
    print(any(channel.key.endswith("/blink") for channel in channels()), [str(verb) for verb, _ in empty_cells()])

asyncio.run(main())
"""


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """Return a copy of what a verb is made of."""
    for part in ("ldcnd", "tests/support", "docs", "config"):
        shutil.copytree(ROOT / part, tmp_path / part, ignore=shutil.ignore_patterns("__pycache__", "images"))
    (tmp_path / "tests" / "__init__.py").touch()
    return tmp_path


def insert(file: Path, before: str, text: str) -> None:
    content = file.read_text(encoding="utf-8")
    assert content.count(before) >= 1, f"{file.name} has no {before!r}"
    file.write_text(content.replace(before, text + before, 1), encoding="utf-8")


def run(house: Path, *words: str) -> list[str]:
    command = [sys.executable, *words]
    done = subprocess.run(command, cwd=house, capture_output=True, text=True, check=False, timeout=50)  # noqa: S603
    assert done.returncode == 0, done.stderr[-600:]
    return [line for line in done.stdout.splitlines() if not line.startswith("20")]


def test_a_verb_is_added_by_its_list(house: Path):
    commands = house / "ldcnd" / "model" / "commands.py"
    insert(commands, '    SET_OUTPUTS = "set_outputs"\n', '    BLINK = "blink"\n')
    insert(
        commands,
        "class SetOutputs(AxisCommand[CommandReply]):",
        'class Blink(AxisCommand[CommandReply]):\n    """Blink with the lamp."""\n\n    verb = Verb.BLINK\n\n'
        '    times: int = Field(ge=1)\n    """How often."""\n\n\n',
    )
    insert(commands, "    SetOutputs,\n", "    Blink,\n")
    axis = house / "ldcnd" / "daemon" / "axis" / "commands.py"
    insert(axis, "    AxisCommand,\n", "    Blink,\n")
    insert(
        axis,
        "            case Reset():\n",
        "            case Blink():\n                return self._motion.reply(turn)\n",
    )
    cli = house / "ldcnd" / "cli" / "axis.py"
    insert(cli, "    Halt,\n", "    Blink,\n")
    with cli.open("a", encoding="utf-8") as file:
        file.write(
            '\n\n@command.command()\n@click.argument("axis")\n@commanding\n'
            "def blink(sender: Sender, axis: str) -> None:\n"
            '    """Blink with the lamp of AXIS."""\n    sender.send(axis, Blink(times=1))\n'
        )
    (house / "docs" / "how-to" / "blink.md").write_text("# Blink\n\n`ldcnd axis blink x` blinks.\n", encoding="utf-8")
    table = house / "tests" / "support" / "verb_table.py"
    table.write_text(
        table.read_text(encoding="utf-8").replace(
            "EXPLAINED = {\n", 'EXPLAINED = {\n    ("blink", "console"): "a page cannot see the lamp",\n', 1
        ),
        encoding="utf-8",
    )
    run(house, "-m", "ldcnd", "schema", "client")

    told = run(house, "-c", PROGRAM)

    assert told[-2:] == ["blink True True", "True []"]
    assert "Blink with the lamp of AXIS." in "\n".join(run(house, "-m", "ldcnd", "axis", "blink", "--help"))


def test_the_list_names_the_files_that_the_test_changes():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    listed = page.partition("## Where a change goes")[2].partition("\n## ")[0]

    for name in ("ldcnd/model/commands.py", "ldcnd/daemon/axis/commands.py", "ldcnd/cli/axis.py", "docs/how-to"):
        assert name in listed
