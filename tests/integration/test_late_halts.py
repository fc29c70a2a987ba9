"""Whatever brings an axis to rest late is told by its own name: a halt, a quick stop and a power-off are no stops."""

import asyncio
from contextlib import suppress

import pytest

from ldcnd.client.events import latest_events
from ldcnd.contract.commands import Halt, Power, QuickStop, Stop
from ldcnd.contract.errors import OutcomeUnknown
from ldcnd.contract.samples import AxisState
from tests.integration.test_pending_stops import chain_of_four, jogging, stands, unplugged
from tests.support.rig import RunningRig

ASKED = {"stop": Stop(), "halt": Halt(), "quick_stop": QuickStop(), "power": Power(on=False)}
LATE = "confirmed late, when the drive answered again"


async def ask(rig: RunningRig, verb: str) -> None:
    with suppress(OutcomeUnknown):
        await rig.client.command("x", ASKED[verb])


async def done_late(rig: RunningRig) -> list[str]:
    """Return what was confirmed late, by its name, the oldest first."""
    return [
        event.verb
        for event in sorted(await latest_events(rig.client, 1000), key=lambda event: event.seq)
        if event.axis == "x" and event.status == "done" and event.reason == LATE
    ]


@pytest.mark.promise("stop-until-confirmed")
@pytest.mark.parametrize(
    "asked",
    [("halt",), ("stop", "halt"), ("halt", "stop"), ("quick_stop", "halt"), ("power",), ("halt", "halt", "power")],
    ids="+".join,
)
async def test_what_waits_for_its_line_is_told_by_its_name_once_it_is_confirmed(asked):
    chain = chain_of_four()
    async with jogging(chain) as rig:
        await unplugged(rig, chain)
        for verb in asked:
            await ask(rig, verb)
        chain.replug()
        await rig.until("x", lambda state: not state.stop_pending)
        await asyncio.sleep(1.0)

        assert await stands(chain)
        assert await done_late(rig) == list(dict.fromkeys(asked))


@pytest.mark.parametrize("verb", ["halt", "quick_stop"])
async def test_the_motion_that_a_drive_ends_late_was_ended_by_what_was_asked_for(verb):
    chain = chain_of_four()
    async with jogging(chain, velocity=25.0) as rig:
        drive, confirms = rig.daemon.rig.axes["x"].driver, asyncio.Event()
        send = drive.stop

        async def mute(mode):
            if not confirms.is_set():
                raise OutcomeUnknown("no reply")
            return await send(mode)

        drive.stop = mute
        await ask(rig, verb)
        confirms.set()
        state = await rig.until("x", lambda state: state.state is AxisState.STOPPING)
        assert state.command.verb == verb
        assert state.last_error == f"move_velocity: aborted by {verb}"
        await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        assert await done_late(rig) == [verb]


async def test_a_halt_that_is_confirmed_first_does_not_hide_the_stop_that_waited():
    chain = chain_of_four()
    async with jogging(chain, velocity=25.0) as rig:
        drive = rig.daemon.rig.axes["x"].driver
        kept = drive.stop
        lost = [True] * 20

        async def mute(mode):
            if lost:
                lost.pop()
                raise OutcomeUnknown("no reply")
            return await kept(mode)

        drive.stop = mute
        await ask(rig, "stop")
        await ask(rig, "halt")
        lost.clear()
        await rig.until("x", lambda state: not state.stop_pending)
        await asyncio.sleep(3.0)

        events = [(event.verb, event.status.value) for event in await latest_events(rig.client, 1000)]
        assert await done_late(rig) == ["stop", "halt"]
        assert ("stop", "unknown") in events


async def test_a_quick_stop_is_told_by_its_name():
    chain = chain_of_four()
    async with jogging(chain, velocity=25.0) as rig:
        await ask(rig, "quick_stop")
        state = await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)

        assert state.stop_latched
        ended = [each for each in await latest_events(rig.client, 1000) if each.verb == "move_velocity"]
        assert "aborted by quick_stop" in {each.reason for each in ended}
