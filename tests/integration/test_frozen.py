"""Frozen clients and frozen daemons: real processes, real signals, real Zenoh."""

import asyncio
import signal
import sys
from asyncio.subprocess import PIPE

import pytest

from ldcnd.client.lease import control
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.errors import OutcomeUnknown, SessionError, StopLatched
from ldcnd.contract.events import CommandStatus, ReadEvents
from ldcnd.contract.samples import AxisState, PositionSample, StateSample, TelemetryItem
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.support.browser import console, entries, feed
from tests.support.process import ROOT, answering, client, daemon, free_port, process

pytestmark = [pytest.mark.system, pytest.mark.real_time]

RIG = ROOT / "config" / "simulated.toml"
LEASE_S = 1.0
ACTED_WITHIN_S = 0.5
"""After the lease has ended, at which instant it is acted upon; this is for a busy machine."""
FROZEN_S = 3.0

JOGGER = """
import asyncio, sys
from ldcnd.client.lease import control
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import LdcndError
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.contract.commands import MoveVelocity, Power, Verb

async def main():
    async with open_zenoh_session(ZenohSettings(mode="client", connect=(sys.argv[1],))) as session:
        async with control(RigClient(session, "sim"), "jogger", "x", lease_s=float(sys.argv[2])) as held:
            await held.command("x", Power(on=True))
            await held.command("x", MoveVelocity(velocity=5.0))
            print("jogging", flush=True)
            await asyncio.get_running_loop().run_in_executor(None, sys.stdin.readline)
            code = "outcome_unknown"  # while the link that the freeze has cost is made again
            while code in ("outcome_unknown", "session_failed"):
                try:
                    await held.command("x", MoveVelocity(velocity=-5.0))
                    code = "accepted"
                except LdcndError as error:
                    code = error.code
            print(code, flush=True)

asyncio.run(main())
"""


async def test_an_axis_halts_when_its_client_is_frozen_and_what_it_sends_afterwards_is_stale():
    async with daemon(RIG) as endpoint, client(endpoint) as rig:
        jogger = await asyncio.create_subprocess_exec(
            sys.executable, "-c", JOGGER, endpoint, str(LEASE_S), stdin=PIPE, stdout=PIPE, cwd=ROOT
        )
        assert jogger.stdout
        assert await jogger.stdout.readline() == b"jogging\n"
        async with rig.samples("x", TelemetryItem.STATE) as states:
            loop = asyncio.get_running_loop()
            jogger.send_signal(signal.SIGSTOP)
            frozen_s = loop.time()

            async with asyncio.timeout(LEASE_S + ACTED_WITHIN_S):
                async for _, state in states:
                    assert isinstance(state, StateSample)
                    if state.state in (AxisState.STOPPING, AxisState.STANDSTILL):
                        break
            acted_s = loop.time() - frozen_s
            await asyncio.sleep(FROZEN_S - acted_s)  # the freeze itself is what is tested

        jogger.send_signal(signal.SIGCONT)
        async with asyncio.timeout(30):
            said, _ = await jogger.communicate(b"\n")
        print(f"acted {acted_s:.3f} s after the freeze, lease {LEASE_S} s")
        assert said == b"lease_expired\n"
        state = await rig.state("x")
        assert state
        assert state.state is AxisState.STANDSTILL


async def test_a_frozen_daemon_does_not_carry_out_what_its_client_gave_up():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with process("run", "--config", str(RIG), "--listen", endpoint) as running:
        await answering(running, endpoint)
        async with open_zenoh_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
            rig = RigClient(session, "sim")
            async with control(rig, "ann", "x", lease_s=LEASE_S) as held:
                await held.command("x", Power(on=True))

                running.send_signal(signal.SIGSTOP)
                move = MoveAbsolute(position=50.0, command_id="given-up")
                with pytest.raises(OutcomeUnknown, match="it may be carried out all the same"):
                    await held.command("x", move, timeout_s=0.5)
                with pytest.raises(SessionError):
                    await RigClient(session, "sim").command("x", move)
                await asyncio.sleep(LEASE_S)
                running.send_signal(signal.SIGCONT)

                async with rig.samples("x", TelemetryItem.POSITION) as positions, asyncio.timeout(10):
                    seen = [sample async for _, sample in _take(positions, 20)]

    assert all(isinstance(sample, PositionSample) and abs(sample.value) < 0.01 for sample in seen)


async def _take(samples, count):
    for _ in range(count):
        yield await anext(samples)


@pytest.mark.parametrize("path", ["/api/stop", "/api/rigs/sim/stop", "/api/rigs/sim/axes/x/halt"])
async def test_a_stop_that_a_page_sent_to_a_frozen_console_is_carried_out_when_that_goes_on(path):
    async with daemon(RIG) as endpoint, client(endpoint) as rig, console("-e", endpoint) as running:
        browser = await running.stranger.enter(running.link)
        await rig.command("x", Power(on=True))
        async with feed(browser) as page:
            while not any(topic == "tele/x/state" for _, topic, _ in await entries(page)):
                pass
            running.process.send_signal(signal.SIGSTOP)
            stop = asyncio.create_task(browser.post(path))
            await asyncio.sleep(2 * FROZEN_S)  # the freeze itself is what is tested: it costs the console its link
            running.process.send_signal(signal.SIGCONT)
            reply = (await stop).document

    assert {"stopping", "accepted"} & {reply.get("status"), reply.get("rigs", {}).get("sim", {}).get("status")}, reply


async def test_the_events_of_a_refused_move_reach_those_who_ask_later():
    async with daemon(RIG) as endpoint, client(endpoint) as rig:
        await rig.stop("x")

        with pytest.raises(StopLatched):
            await rig.command("x", Power(on=True))

        events = (await rig.ask(ReadEvents(axis="x"))).events
        assert events[-1].status is CommandStatus.REFUSED
        assert events[-1].code == "stop_latched"
