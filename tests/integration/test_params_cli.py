"""`ldcnd params` against a real daemon over real Zenoh."""

import asyncio
from asyncio.subprocess import PIPE
from pathlib import Path

import pytest

from ldcnd.cli.parameter_file import load_parameters
from tests.support.process import LDCND, ROOT, daemon


async def ldcnd(*arguments: str) -> tuple[int, str]:
    running = await asyncio.create_subprocess_exec(*LDCND, *arguments, stdout=PIPE, stderr=PIPE, cwd=ROOT)
    async with asyncio.timeout(50):
        output, complaints = await running.communicate()
    return running.returncode or 0, (output + complaints).decode()


@pytest.mark.real_time
async def test_parameters_are_set_saved_compared_and_put_back(tmp_path: Path):
    text = (ROOT / "config" / "mixed.toml").read_text()
    config = tmp_path / "mixed.toml"
    config.write_text(text.replace('state_dir = "state"', f'state_dir = "{tmp_path}"'))
    saved = tmp_path / "feed.toml"
    async with daemon(config) as endpoint:
        there = ("-e", endpoint)

        assert (await ldcnd("params", "set", "feed", "Pn102", "55", "--eeprom", *there))[0] == 0
        assert (await ldcnd("params", "dump", "feed", str(saved), *there))[0] == 0
        code, differences = await ldcnd("params", "diff", "feed", str(saved), *there)
        refused = await ldcnd("params", "set", "feed", "Pn100", "3000", *there)
        some = tmp_path / "some.toml"
        some.write_text("[parameters]\nPn102 = 56\n")
        without_type = await ldcnd("params", "restore", "feed", str(some), "--yes", *there)
        restored = await ldcnd("params", "restore", "feed", str(some), "--yes", "--any-type", *there)
        cloned = await ldcnd("params", "clone", "feed", "spool", "--dry-run", *there)

    assert load_parameters(saved).values["Pn102"] == 55
    assert (code, differences) == (0, "")
    assert (without_type[0], "driver" in without_type[1] or "type" in without_type[1]) == (1, True)
    assert (cloned[0], "Pn102 EEPROM 40 (0028H) -> 56 (0038H)" in cloned[1]) == (0, True)
    assert (refused[0], "[data_error]" in refused[1]) == (1, True)
    assert (restored[0], "read back: the drive holds the values" in restored[1]) == (0, True)
    assert '"Pn102": 2' in (tmp_path / "eeprom-writes.json").read_text()
