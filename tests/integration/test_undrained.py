"""Fifty programs that subscribe to everything and never look at it, and then freeze: nobody else notices."""

import asyncio
import signal
import sys
from asyncio.subprocess import PIPE
from pathlib import Path

import pytest

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import Power, Reset
from ldcnd.contract.errors import StopLatched
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.support.process import ROOT, daemon

pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(120)]

SUBSCRIBERS = 50
ANSWERED_WITHIN_S = 4.0
"""Zenoh gives a program that does not read 5 s before it closes its link, and each of them would cost that."""
FLOODED_SAMPLES = 40
"""Of one axis: by then the channels and the small buffers of those who never look have long been full."""
SMALL_BUFFERS = "{transport: {link: {tcp: {so_sndbuf: 4096}}}}"
NEVER_LOOKS = """
import json, sys, zenoh
small = {"link": {"tcp": {"so_rcvbuf": 4096}}}
off = {"multicast": {"enabled": False}}
config = {"mode": "client", "connect": {"endpoints": [sys.argv[1]]}, "scouting": off, "transport": small}
sessions = [zenoh.open(zenoh.Config.from_json5(json.dumps(config))) for _ in range(int(sys.argv[2]))]
kept = [session.declare_subscriber("ldcn/**", zenoh.handlers.FifoChannel(1)) for session in sessions]
print("ready", flush=True)
sys.stdin.read()
"""


async def answered(rig: RigClient) -> None:
    """Stop, be refused, reset, and have a command carried out, each in time."""
    limit = asyncio.timeout
    async with limit(ANSWERED_WITHIN_S):
        assert (await rig.stop()).confirmed == ("x", "y", "z", "c")
    async with limit(ANSWERED_WITHIN_S):
        with pytest.raises(StopLatched):
            await rig.command("x", Power(on=True))
    for axis in "xyzc":
        async with limit(ANSWERED_WITHIN_S):
            await rig.command(axis, Reset())
    async with limit(ANSWERED_WITHIN_S):
        await rig.command("x", Power(on=False))


async def test_stops_and_commands_are_answered_in_time_while_fifty_subscribers_never_drain(tmp_path: Path):
    rig_file = tmp_path / "rig.toml"
    listen = 'listen = ["tcp/127.0.0.1:7447"]'
    text = (ROOT / "config" / "simulated.toml").read_text()
    assert listen in text
    rig_file.write_text(text.replace(listen, 'config_file = "small.json5"'))
    (tmp_path / "small.json5").write_text(SMALL_BUFFERS)
    async with daemon(rig_file) as endpoint:
        idle = await asyncio.create_subprocess_exec(
            sys.executable, "-c", NEVER_LOOKS, endpoint, str(SUBSCRIBERS), stdin=PIPE, stdout=PIPE
        )
        try:
            assert idle.stdout
            async with asyncio.timeout(30):
                assert await idle.stdout.readline() == b"ready\n"
            settings = ZenohSettings(mode="client", connect=(endpoint,))
            async with open_zenoh_session(settings) as session:
                rig = RigClient(session, "sim")
                async with rig.samples("x", "position") as positions, asyncio.timeout(30):
                    for _ in range(FLOODED_SAMPLES):
                        await anext(positions)
                await answered(rig)

                idle.send_signal(signal.SIGSTOP)
                async with rig.samples("x", "position") as positions, asyncio.timeout(30):
                    for _ in range(FLOODED_SAMPLES):
                        await anext(positions)
                await answered(rig)
        finally:
            idle.kill()
            await idle.communicate()
