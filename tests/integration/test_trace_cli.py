"""`ldcnd trace` against a daemon in its own process over loopback TCP."""

import asyncio
import signal
from asyncio.subprocess import PIPE

import pytest

from ldcnd.client.traces import load_trace, trace_header
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.traces import TracePhase
from tests.support.process import LDCND, ROOT, client, daemon

pytestmark = [pytest.mark.system, pytest.mark.real_time]


async def ldcnd(*arguments):
    """Run `ldcnd ARGUMENTS` and return its exit code and what it printed, errors last."""
    running = await asyncio.create_subprocess_exec(*LDCND, *arguments, stdout=PIPE, stderr=PIPE)
    async with asyncio.timeout(45):
        printed, errors = await running.communicate()
    return running.returncode, printed.decode(), errors.decode()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_ctrl_c_and_sigterm_end_the_trace_that_waits(number):
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint, client(endpoint) as rig:
        words = ("trace", "take", "x", "-e", endpoint, "-c", "position", "--trigger", "position:rising:5")
        taking = await asyncio.create_subprocess_exec(*LDCND, *words, stdout=PIPE, stderr=PIPE)
        async with asyncio.timeout(30):
            while (header := await trace_header(rig, "x")) is None or header.phase is not TracePhase.WAITING:
                await asyncio.sleep(0.1)
            early = await ldcnd("trace", "show", "x", "-e", endpoint)
            taking.send_signal(number)
            await taking.communicate()
        header = await trace_header(rig, "x")

    assert taking.returncode == 130
    assert early[0] == 1
    assert "is waiting: it is not complete yet" in early[2]
    assert header is not None
    assert header.phase is TracePhase.ABORTED


async def test_a_move_is_traced_to_a_file_shown_and_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    file, picture = tmp_path / "move.csv", tmp_path / "move.png"
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint, client(endpoint) as rig:
        await rig.command("x", Power(on=True))
        channels = ("-c", "position", "-c", "velocity")
        trigger = ("--trigger", "velocity:rising:5", "--pre", "10", "--samples", "100")
        async with asyncio.TaskGroup() as group:
            taking = group.create_task(
                ldcnd("trace", "take", "x", "-e", endpoint, *channels, *trigger, "--out", str(file))
            )
            async with asyncio.timeout(30):
                while (header := await trace_header(rig, "x")) is None or header.phase is TracePhase.FILLING:
                    await asyncio.sleep(0.1)
            await rig.command("x", MoveAbsolute(position=10.0))
        refused = await ldcnd("trace", "take", "x", "-e", endpoint, "-c", "torque")
        last = await ldcnd("trace", "show", "x", "-e", endpoint)
    shown = await ldcnd("trace", "show", str(file))
    drawn = await ldcnd("plot", str(file), "-o", str(picture))

    code, printed, errors = taking.result()
    trace = load_trace(file)
    assert (code, shown[0], drawn[0], last[0]) == (0, 0, 0, 0)
    assert "as fast as the line allows" in errors
    assert printed == shown[1] == last[1]
    assert "trigger at sample 10: velocity rising 5" in printed
    assert trace.values[1][9] < 5.0 <= trace.values[1][10]
    assert len(trace.offsets_ns) == 100
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert refused[0] == 1
    assert "cannot trace 'torque'; there are position" in refused[2]
