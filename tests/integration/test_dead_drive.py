"""What a drive that is dead costs those that are not."""

import asyncio
from itertools import pairwise

from ldcnd.contract.samples import LinkState
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.bench.saturated_rig import saturating
from tests.support.chain_rig import rig_on

DRIVES = 8
SECONDS = 6.0


def lost_s(records):
    """Return how long the line was not busy with polls that were answered."""
    busy_s = sum(
        reply.at_s - request.at_s
        for request, reply in pairwise(records)
        if (request.event, reply.event) == (WireEvent.SENT, WireEvent.RECEIVED) and len(reply.data) > 4
    )
    return records[-1].at_s - records[0].at_s - busy_s


async def test_a_dead_drive_costs_the_others_two_percent_at_most_and_is_found_when_it_is_back():
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"),) * DRIVES))
    last, loop = f"a{DRIVES}", asyncio.get_running_loop()
    async with rig_on(chain, saturating(DRIVES)) as rig:
        await rig.until(last, lambda state: state.link is LinkState.UP)
        chain.modules[-1].power(on=False, at_s=loop.time())
        await asyncio.sleep(4.0)
        log = rig.line.bus.wire_log
        from_record = len(log.records())
        await asyncio.sleep(SECONDS)
        records = log.records()[from_record:]
        chain.modules[-1].power(on=True, at_s=loop.time())
        await rig.until(last, lambda state: state.link is LinkState.UP, 3.0)

    assert any(record.event is WireEvent.TIMEOUT for record in records)
    assert lost_s(records) / SECONDS < 0.02
