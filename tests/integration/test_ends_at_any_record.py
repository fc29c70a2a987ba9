"""Nothing begins once the end of the daemon has begun, whatever its line is at."""

import asyncio
from contextlib import suppress
from typing import Any

import pytest

from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import LinkState
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.sim.ldcn.chain import build_chain
from tests.integration.test_intruders import four_drives
from tests.support.chain_rig import rig_on, simulated_config

RECORDS = 16
"""More than a move leaves in the wire log before it has begun: packets, replies, and what settles them."""
STEPS = 5


async def started_after_end(record: int, steps: int) -> tuple[bool, bool]:
    """End a daemon some steps of its loop behind a record of the wire; return whether a move began, and since then."""
    loop, ended_at = asyncio.get_running_loop(), list[int]()
    async with rig_on(build_chain(four_drives()), simulated_config({"reference": "at_reset"})) as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await rig.client.command("x", Power(on=True))
        before, left, log = len(rig.sent), record, rig.line.bus.wire_log
        add = log.add

        def end(after: int) -> None:
            if after:
                loop.call_soon(end, after - 1)
                return
            ended_at.append(len(rig.sent))
            rig.daemon.end()

        def watched(*entry: Any) -> None:
            nonlocal left
            add(*entry)
            left -= 1
            if left == 0:
                end(steps)

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(log, "add", watched)
            with suppress(LdcndError):
                await rig.client.command("x", MoveAbsolute(position=5.0))
            await asyncio.sleep(3.0)
        starts = [n for n, packet in enumerate(rig.sent) if n >= before and packet.command is CommandCode.START_MOTION]
    return bool(starts), any(n >= ended_at[0] for n in starts)


async def test_nothing_begins_once_a_daemon_has_begun_to_end():
    outcomes = [await started_after_end(record, steps) for record in range(1, RECORDS) for steps in range(STEPS)]

    assert {began for began, _ in outcomes} == {True, False}
    assert not any(after for _, after in outcomes)
