"""The same daemon, the same chain, but through a pseudo-terminal and the serial transport."""

import asyncio

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import Home, MoveAbsolute, Power
from ldcnd.contract.samples import AxisState, PositionSample, TelemetryItem
from tests.support.process import ROOT, client, daemon, simulated_terminal

pytestmark = [pytest.mark.system, pytest.mark.real_time]

COUNTS_PER_MM = {"x": 1000, "z": 2000}


async def test_the_daemon_moves_and_homes_drives_behind_a_terminal(tmp_path):
    simulated = (ROOT / "config" / "simulated.toml").read_text().replace("margin_ms = 50", "margin_ms = 250")
    link = tmp_path / "line0"
    config = tmp_path / "pty.toml"
    config.write_text(simulated[: simulated.index("[[sim]]")].replace('"sim:line0"', f'"{link}"'))
    assert load_config(config).bus[0].port == str(link)

    async with simulated_terminal(link, "ls182ap", "ls182ap", "picservo-v4", "picservo-v4"):
        async with daemon(config) as endpoint, client(endpoint) as rig:
            for axis, target in (("x", 10.0), ("z", -5.0)):
                await rig.command(axis, Power(on=True))
                reply = await rig.command(axis, MoveAbsolute(position=target))
                state = await rig.wait_for_end(axis, reply.command_id)
                assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
                async with rig.samples(axis, TelemetryItem.POSITION) as positions, asyncio.timeout(5):
                    async for _, position in positions:
                        assert isinstance(position, PositionSample)
                        if abs(position.counts - target * COUNTS_PER_MM[axis]) <= 1:
                            break

            reply = await rig.command("z", Home())
            state = await rig.wait_for_end("z", reply.command_id)
            assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)

            (bus,) = await rig.buses()
            assert (bus.up, bus.baud) == (True, 115_200)
