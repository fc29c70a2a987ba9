"""What a drive that is dead costs those that are not."""

import asyncio
from itertools import pairwise

import pytest

from ldcnd.contract.commands import Power
from ldcnd.contract.questions import Why
from ldcnd.contract.samples import LinkState
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.bench.saturated_rig import saturating
from tests.support.chain_rig import rig_on
from tests.support.rig import running_rig

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


@pytest.mark.long
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


async def test_of_a_drive_that_answers_again_nothing_says_that_it_does_not():
    chain = build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))
    async with running_rig(chains={"line0": chain}) as rig:
        await rig.until("c", lambda state: state.link is LinkState.UP)
        await rig.client.command("c", Power(on=True))
        chain.modules[3].power(on=False, at_s=asyncio.get_running_loop().time())
        await rig.until("c", lambda state: state.link is LinkState.DOWN)
        away = await rig.client.ask(Why(each_command=True), "c")
        chain.modules[3].power(on=True, at_s=asyncio.get_running_loop().time())
        await rig.until("c", lambda state: state.link is LinkState.UP, 10.0)
        again = await rig.client.ask(Why(each_command=True), "c")

    assert "does not answer" in away.causes[0].text
    said = [*again.causes, *(cause for each in again.commands for cause in each.causes)]
    assert not [cause.text for cause in said if "does not answer" in cause.text]
    assert any("in error stop because of link lost, which is over" in cause.text for cause in again.causes)
    assert all(cause.remedy == "send reset" for cause in said if "in error stop" in cause.text)
    assert again.first_fault == "link lost, which is over"
