"""Every verb of an axis and of the rig, typed: what it prints, in which units, and how it ends."""

import asyncio
import re

import pytest

from ldcnd.contract.samples import Moving
from tests.support.command_line import run_all
from tests.support.process import ROOT, client, daemon

pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(200)]


async def test_what_a_drive_can_do_can_be_typed(tmp_path):
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint, client(endpoint) as rig:
        typed = [
            "power on",
            "axis set-position x 1.5",
            "move x 3 --velocity 10 --wait",
            "axis preview x --position 400",
            "axis preview x --distance -1",
            "axis gains z --kp 400",
            "jog z 1 --for 0.2",
            "axis quick-stop z",
            "move z 1",
            "why z",
            "watch x --item position --count 2",
            "lease list",
            "lease hold --axis x -- true",
            "move X 1",
            "axis monitors x",
            "bus list --rig sum",
            "trace take x",
            "log --axis x --count 3",
            "stop",
        ]
        typed_at_rest = ["reset", "power off"]
        at = f"-e {endpoint.removeprefix('tcp/')}"
        lines = (f"ldcnd {line.replace(' -- ', f' {at} -- ')}" for line in typed)
        ran = await run_all(tmp_path, *(line if " -- " in line else f"{line} {at}" for line in lines))
        while {(await rig.state(axis)).moving for axis in "xyzc"} != {Moving.NO}:  # reset is refused until then
            await asyncio.sleep(0.05)
        ran += await run_all(tmp_path, *(f"ldcnd {line} {at}" for line in typed_at_rest))
        typed += typed_at_rest
        state = await rig.state("x")

    went = dict(zip(typed, ran, strict=True))
    refused = {
        "move z 1": 1,
        "why z": 1,
        "move X 1": 1,
        "axis monitors x": 1,
        "bus list --rig sum": 3,
    }
    assert {line: each.code for line, each in went.items()} == {line: refused.get(line, 0) for line in went}, went
    accepted, done = went["move x 3 --velocity 10 --wait"].printed.splitlines()
    assert accepted == "sim: x: move absolute accepted: to 3.000 mm, at 10 mm/s, with 200 mm/s², in 200 ms"
    assert re.fullmatch(r"sim: x: done, standstill at (2\.99|3\.00)\d mm, 0\.00\d mm off its target", done)
    assert (
        went["axis preview x --position 400"].printed.splitlines()[1]
        == "  the nearest value that would be accepted is 100 mm"
    )
    assert "z: halted at " in went["jog z 1 --for 0.2"].printed
    assert "ldcnd reset z" in went["move z 1"].errors
    assert "ldcnd reset z" in went["why z"].printed
    assert went["move X 1"].errors.startswith("there is no axis 'X'; did you mean 'x'?")
    assert went["bus list --rig sum"].errors.startswith("no rig 'sum' answers; did you mean 'sim'?")
    assert "position" in went["trace take x"].printed.splitlines()
    assert went["stop"].printed == "sim: stop latched, confirmed by x, y, z, c\n"
    assert went["power off"].printed.count("power done") == 4
    assert not state.enabled
