"""Printing never keeps a command from its end: under any encoding, into a closed pipe, without a standard output."""

import asyncio
import os
from asyncio.subprocess import PIPE

import pytest
import pytest_asyncio

from ldcnd.contract.commands import Halt, Power, SetPosition
from tests.support.process import LDCND, ROOT, client, daemon

pytestmark = [
    pytest.mark.system,
    pytest.mark.real_time,
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.timeout(200),
]

PLAIN = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
ENCODINGS = [{**PLAIN, "PYTHONIOENCODING": name} for name in ("ascii", "latin-1", "ascii:strict")] + [PLAIN]
COMMANDS = [
    "power on x",
    "power on y",
    "move x 3 --velocity 20 --wait",
    "move x 1 --velocity 20 --wait --json",
    "jog x 2 --for 0.3",
    "group move x=2 y=1 --wait",
    "halt x",
    "list",
    "axis set-position x 0",
    "axis gains x --kp 100 --kd 1000 --ki 0 --el 4000",
    "move x 300000",
    "why x",
    "log",
    "stop",
    "reset",
]

REFUSED = {"move x 300000", "why x", "group move x=2 y=1 --wait"}


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def served(tmp_path_factory):
    """Run a daemon whose unit no plain encoding has; yields its endpoint and a client."""
    config = tmp_path_factory.mktemp("rig") / "rig.toml"
    config.write_text((ROOT / "config" / "simulated.toml").read_text().replace('unit = "mm"', 'unit = "\u03bcm"'))
    async with daemon(config) as endpoint, client(endpoint) as rig:
        yield endpoint, rig


async def run(endpoint, line, environment=None, **streams):
    words = [*line.split(), "-e", endpoint]
    running = await asyncio.create_subprocess_exec(
        *LDCND, *words, stderr=PIPE, env={**os.environ, **(environment or {})}, **streams
    )
    async with asyncio.timeout(60):
        printed, errors = await running.communicate()
    return running.returncode, (printed or b"").decode("latin-1"), errors.decode("latin-1")


@pytest.mark.parametrize("environment", ENCODINGS, ids=lambda each: each.get("PYTHONIOENCODING", "none"))
async def test_every_command_that_sends_prints_under_any_encoding(served, environment):
    endpoint, _ = served
    for line in COMMANDS:
        code, _, errors = await run(endpoint, line, environment, stdout=PIPE)
        assert "Traceback" not in errors, line
        assert code == 0 or line in REFUSED, (line, errors)


async def test_a_waited_move_whose_output_has_no_reader_is_halted(served):
    endpoint, rig = served
    await ready(rig)
    reading, writing = os.pipe()
    os.close(reading)
    code, _, errors = await run(endpoint, "move x 90 --velocity 3 --wait", stdout=writing)
    os.close(writing)

    assert (code, "x: halted at" in errors) == (1, True)
    assert "Traceback" not in errors


async def test_a_move_that_goes_on_is_named_where_its_output_has_no_reader(served):
    endpoint, rig = served
    await ready(rig)
    reading, writing = os.pipe()
    os.close(reading)
    _, _, errors = await run(endpoint, "move x 90 --velocity 3", stdout=writing)
    os.close(writing)

    assert "ldcnd halt x" in errors
    await rig.command("x", Halt())


async def test_a_waited_move_without_a_standard_output_gets_to_its_end(served):
    endpoint, rig = served
    await ready(rig)
    line = f"{' '.join(LDCND)} move x 2 --velocity 10 --wait -e {endpoint} >&-"
    running = await asyncio.create_subprocess_shell(line, stderr=PIPE)
    async with asyncio.timeout(60):
        _, errors = await running.communicate()

    assert (running.returncode, errors) == (0, b"")
    assert (await rig.position("x")).value == pytest.approx(2.0, abs=0.05)


async def ready(rig):
    halt = await rig.command("x", Halt())
    await rig.wait_for_end("x", halt.command_id)
    await rig.command("x", Power(on=True))
    await rig.command("x", SetPosition(position=0.0))
