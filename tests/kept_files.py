"""Writes what a version leaves on disks, once, before it is released: `python -m tests.kept_files`.

A configuration, a state directory and a recording go to `tests/kept/VERSION`; each later version has to read them
(tests/integration/test_kept_versions.py). Captures of wires are in `tests/captures`.
"""

import argparse
import asyncio
import os
import shutil
import tomllib
from pathlib import Path

from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveAbsolute, Power, SetPosition, Stop
from ldcnd.contract.parameters import Memory, WriteParameter
from ldcnd.contract.samples import LinkState
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.chain_rig import drive
from tests.support.recordings import recorded_rig

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "config" / "mixed.toml"
FILES = ("rig.toml", "state", "run.mcap")
WRITTEN = 55
"""Value of the parameter that was written into EEPROM."""


def kept_rig(place: Path, state_dir: Path) -> RigConfig:
    """Return the configuration of a version, with another state directory."""
    return load_config(place / "rig.toml").model_copy(update={"state_dir": state_dir})


async def live(place: Path) -> None:
    """Run a rig that leaves something of each kind: a reference, a fault, latches, a write of an EEPROM."""
    line0 = build_chain(ChainSpec((ModuleSpec("ls182ap"),)))
    state = place / "state"
    async with recorded_rig(place / "run.mcap", kept_rig(place, state), chains={"line0": line0}) as recorded:
        rig = recorded.rig
        for axis in ("x", "feed"):
            await rig.until(axis, lambda state: state.link is LinkState.UP)
        await rig.client.command("feed", WriteParameter(parameter="Pn102", value=WRITTEN, memory=Memory.EEPROM))
        await rig.client.command("x", Power(on=True))
        await rig.client.command("x", SetPosition(position=7.0))
        reply = await rig.client.command("x", MoveAbsolute(position=9.0))
        await rig.client.wait_for_end("x", reply.command_id)
        drive(line0, 1).loop.open()  # as after an excess position error
        await rig.until("x", lambda state: state.state == "error_stop")
        await rig.client.command("x", Stop())
        await asyncio.sleep(2.0)


def main() -> None:
    """Write the files of this version."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    os.chdir(ROOT)
    place = Path("tests", "kept", version)  # no path of the machine on which it was written gets into the recording
    place.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        shutil.rmtree(place / name, ignore_errors=True)
        (place / name).unlink(missing_ok=True)
    text = EXAMPLE.read_text(encoding="utf-8").replace('reference = "at_reset"', 'reference = "required"')
    started = 'port = "sim:line0"\nstart = "adopt"\nadopt_fallback = "reset"'
    (place / "rig.toml").write_text(text.replace('port = "sim:line0"', started), encoding="utf-8")
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        runner.run(live(place))


if __name__ == "__main__":
    main()
