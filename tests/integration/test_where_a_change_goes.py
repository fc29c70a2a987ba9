"""The lists in CONTRIBUTING name all that has to change: a change is made by them in a copy of the house."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.process import ROOT

pytestmark = [
    pytest.mark.system,
    pytest.mark.timeout(240),
]  # two programs start in it, on a machine that may do much else

PROGRAM = """
import asyncio, json
from ldcnd.cli.quantities import sample_text
from ldcnd.client.rig import Rig
from ldcnd.config.rig import RigConfig, load_config
from tools.schemas import all_schemas
from ldcnd.contract.samples import LinkState
from tests.support.rig import SIMULATED, running_rig
from tests.support.verb_table import empty_cells
from tools.channels import channels

def config():
    document = load_config(SIMULATED).model_dump(mode="json", exclude_unset=True)
    bus = document["bus"][0]
    bus["axis"] = [bus["axis"][0] | {"model": "ls-999"}]
    document["sim"][0]["module"] = [{"model": "ls-999"}]
    return RigConfig.model_validate(document)

async def main():
    async with running_rig(config()) as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        async with Rig(rig.client, await rig.client.daemon()).control("x", client="ann") as x:
            reply = await x.blink(3)
        (info,) = await rig.client.axes()
        async with rig.client.samples("x", "doubled") as samples:
            _, sample = await anext(samples)
    print(json.dumps({
        "verb": reply.verb, "capabilities": info.capabilities, "schemas": sorted(all_schemas()),
        "keys": [channel.key for channel in channels()], "unreachable": [str(verb) for verb, _ in empty_cells()],
        "items": info.items, "text": sample_text(sample), "value": sample.value,
        "model": info.model, "identity": info.identity,
    }))

asyncio.run(main())
"""


def insert(file: Path, before: str, text: str) -> None:
    content = file.read_text(encoding="utf-8")
    assert content.count(before) >= 1, f"{file.name} has no {before!r}"
    file.write_text(content.replace(before, text + before, 1), encoding="utf-8")


def run(house: Path, *words: str) -> list[str]:
    command = [sys.executable, *words]
    done = subprocess.run(command, cwd=house, capture_output=True, text=True, check=False, timeout=110)  # noqa: S603
    assert done.returncode == 0, done.stdout[-600:] + done.stderr[-600:]
    return [line for line in done.stdout.splitlines() if not line.startswith("20")]


def add_verb(house: Path) -> None:
    commands = house / "ldcnd" / "contract" / "commands.py"
    insert(commands, '    SET_OUTPUTS = "set_outputs"\n', '    BLINK = "blink"\n')
    insert(
        commands,
        "class SetOutputs(AxisCommand[CommandReply]):",
        'class Blink(AxisCommand[CommandReply]):\n    """Blink with the lamp."""\n\n    verb = Verb.BLINK\n\n'
        '    times: int = Field(ge=1)\n    """How often."""\n\n\n',
    )
    insert(commands, "    SetOutputs,\n", "    Blink,\n")
    axis = house / "ldcnd" / "axis" / "commands.py"
    insert(axis, "    AxisCommand,\n", "    Blink,\n")
    insert(
        axis,
        "        Home: _procedure(HomeSequence),\n",
        "        Blink: _blink,\n",
    )
    insert(
        axis,
        "    async def _set_outputs(",
        "    async def _blink(self, permit: Permit, _request: Blink) -> CommandReply:\n"
        "        return self._motion.reply(permit)\n\n",
    )
    cli = house / "ldcnd" / "cli" / "axis.py"
    insert(cli, "    Halt,\n", "    Blink,\n")
    with cli.open("a", encoding="utf-8") as file:
        file.write(
            '\n\n@command.command()\n@click.argument("axis")\n@commanding\n'
            "def blink(sender: Sender, axis: str) -> None:\n"
            '    """Blink with the lamp of AXIS."""\n    sender.send(axis, Blink(times=1))\n'
        )


def add_item(house: Path) -> None:
    samples = house / "ldcnd" / "contract" / "samples.py"
    insert(samples, '    ADC = "adc"\n', '    DOUBLED = "doubled"\n')
    insert(
        samples,
        "class AdcSample(Sample):",
        'class DoubledSample(Sample):\n    """Twice the position."""\n\n'
        '    value: float\n    """In axis units."""\n\n\n',
    )
    insert(samples, "    TelemetryItem.ADC: AdcSample,\n", "    TelemetryItem.DOUBLED: DoubledSample,\n")
    insert(
        house / "ldcnd" / "axis" / "telemetry.py",
        "        if TelemetryItem.VELOCITY in asked:\n",
        "        topic = self._publisher.item(self._name, TelemetryItem.DOUBLED)\n"
        '        doubled = {"t": t, "t_error_ns": t_error_ns, "seq": 0, "quality": quality}\n'
        '        topic.publish(doubled | {"value": 2.0 * scale.position(reading.position_counts)})\n',
    )
    words = house / "ldcnd" / "cli" / "quantities.py"
    insert(words, "    LatchSample,\n", "    DoubledSample,\n")
    insert(
        words,
        "        case AdcSample():\n",
        '        case DoubledSample():\n            return f"doubled  {sample.value:.1f}"\n',
    )


def add_model(house: Path) -> None:
    profiles = house / "ldcnd" / "drives" / "ldcn" / "profiles.py"
    insert(
        profiles,
        'LS_231 = Profile(\n    "ls-231"',
        'LS_999 = replace(LS_182AP, name="ls-999", title="Logosol LS-999", device_id=91, versions=range(1, 2))\n',
    )
    insert(profiles, "        LS_231,\n", "        LS_999,\n")
    chain = house / "ldcnd" / "sim" / "ldcn" / "chain.py"
    insert(chain, "    LS_182AP,\n", "    LS_999,\n")
    insert(
        chain,
        "            (LS_182AP, ",
        "            (LS_999, ModuleSettings(version=1, always_obeys_global_reset=True)),\n",
    )


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy in which a verb, an item and a model were added, each by its list."""
    copy = tmp_path_factory.mktemp("house")
    for part in ("ldcnd", "tests/support", "tools", "docs", "config"):
        shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__", "images"))
    (copy / "tests" / "__init__.py").touch()
    for add in (add_verb, add_item, add_model):
        add(copy)
    shutil.copy(ROOT / "pyproject.toml", copy)
    run(copy, "-m", "tools", "client")
    run(copy, "-m", "ruff", "format", "--no-cache", "ldcnd")
    run(copy, "-m", "ruff", "check", "--fix", "--no-cache", "ldcnd")
    return copy


@pytest.fixture(scope="module")
def seen(house: Path) -> dict[str, Any]:
    """Return what a program sees of a daemon of that copy."""
    found: dict[str, Any] = json.loads(run(house, "-c", PROGRAM)[-1])
    return found


def test_a_verb_is_added_by_its_list(house: Path, seen: dict[str, Any]):
    assert seen["verb"] == "blink"
    assert "blink" in seen["capabilities"]
    assert "blink_request" in seen["schemas"]
    assert any(key.endswith("/blink") for key in seen["keys"])
    assert seen["unreachable"] == []
    assert "Blink with the lamp of AXIS." in "\n".join(run(house, "-m", "ldcnd", "axis", "blink", "--help"))


def test_a_telemetry_item_is_added_by_its_list(seen: dict[str, Any]):
    assert "doubled" in seen["items"]
    assert "doubled_sample" in seen["schemas"]
    assert seen["text"] == f"doubled  {seen['value']:.1f}"


def test_a_drive_model_is_added_by_its_list(seen: dict[str, Any]):
    assert (seen["model"], seen["identity"]) == ("ls-999", "Logosol LS-999 (id 91, version 1)")
