"""`ldcnd params` against a real daemon over real Zenoh."""

import asyncio
from asyncio.subprocess import PIPE
from pathlib import Path

import pytest

from ldcnd.cli.params import load_values
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
        some.write_text(f"[parameters]\nPn102 = {load_values(saved)['Pn102']}\n")
        restored = await ldcnd("params", "restore", "feed", str(some), *there)

    assert load_values(saved)["Pn102"] == 55
    assert (code, "Pn102  40 in use, 55 stored" in differences) == (1, True)
    assert (refused[0], "[data_error]" in refused[1]) == (1, True)
    assert (restored[0], "Pn102  55" in restored[1]) == (0, True)
    assert '"Pn102": 1' in (tmp_path / "eeprom-writes.json").read_text()
