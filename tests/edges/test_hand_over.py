"""A centrifuge that PyLabRobot's own backend spins is handed to ldcnd in mid-spin, and goes back to that backend.

The simulated rotor and its door decide what moved.
"""

import asyncio
import sys
from collections import deque
from contextlib import nullcontext
from unittest.mock import patch

import pytest
from pylabrobot.centrifuge import Centrifuge

from ldcnd.client.rig import Rig
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import RegisterUnknown
from ldcnd.contract.rig_commands import SetIo
from ldcnd.contract.samples import AxisState, Moving
from ldcnd.testing.rig import lines_of
from tests.edges.test_vspin_port import BareLine, backend, cycle, given_up, shaft, simulated_clock, spin_until_fast
from tests.support.process import ROOT
from tests.support.rig import running_rig

sys.path.insert(0, str(ROOT / "examples"))
from pylabrobot_centrifuge import LdcndCentrifuge

pytestmark = pytest.mark.edges
SAFE = 0.2
"""Revolutions a second; faster than the hunting of a rotor that stands."""
SLOW = 1.0
"""Revolutions a second; below it a homing ends, too, which brakes at its mark."""
OUTPUTS = (9, 10, 11)
"""Lines of the pin, the door and its lock."""
RAMP = 10.5
"""Revolutions a second, each second: the limit of the configuration, and a twentieth."""


class Looker:
    """Looks at rotor and door in every hundredth of a second."""

    def __init__(self, chain):
        self.chain = chain
        self.steepest = 0.0

    async def look(self):
        now_s = asyncio.get_running_loop().time
        past = deque([shaft(self.chain)[1]] * 20, maxlen=20)
        while True:
            await asyncio.sleep(0.01)
            io = self.chain.modules[1]
            io.catch_up(now_s())
            velocity = shaft(self.chain)[1]
            if abs(velocity) > SLOW:
                self.steepest = max(self.steepest, (abs(past[0]) - abs(velocity)) / 0.2)
            past.append(velocity)
            assert abs(velocity) < SAFE or io.around.at("door") == 0.0, f"{velocity} rev/s with an open door"


async def left_spinning(chain):
    """Let the native backend spin the rotor, and end its program as a kill does."""
    program = backend(BareLine(chain))
    with simulated_clock():
        await program.setup()
        await given_up(await spin_until_fast(program, chain))


def taking_over(folder):
    """Return the rig of the example, which takes its line over as it is."""
    text = (ROOT / "config" / "centrifuge.toml").read_text()
    for old, new in (
        ("margin_ms = 50", 'margin_ms = 50\nstart = "adopt"'),
        ("unbalanced = { line = 6, inverted = true }\n", ""),  # the other program has its lamp there
        (', { input = "unbalanced", value = false }', ""),
    ):
        assert old in text
        text = text.replace(old, new)
    (folder / "centrifuge.toml").write_text(text)
    return load_config(folder / "centrifuge.toml")


async def spun_by_ours(connected):
    """Spin with the backend of ldcnd until its daemon is gone."""
    with patch("ldcnd.connect", lambda _endpoint: connected):
        ours = Centrifuge(backend=LdcndCentrifuge(), name="ours", size_x=1, size_y=1, size_z=1)
        await ours.setup()
        try:
            await ours.spin(g=100, duration=600, acceleration=1.0)
        finally:
            await ours.stop()


async def handed_over_and_back(config, chain, looker):
    await asyncio.sleep(2)
    assert shaft(chain)[1] > 15  # nobody stops it

    async with running_rig(config, {"line0": chain}) as rig:
        found = await rig.until("rotor", lambda state: state.moving is not Moving.UNKNOWN)
        assert found.moving is Moving.YES
        assert not found.referenced
        rested = await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL)
        assert "interlock door_shut: output door is not known" in (rested.last_error or "")

        with pytest.raises(RegisterUnknown):  # what a program has made an output no module tells
            await rig.client.ask(SetIo(module="cabinet", low=("pin",)))
        inputs = tuple(set(range(1, 13)) - set(OUTPUTS))
        await rig.client.ask(SetIo(module="cabinet", low=OUTPUTS, inputs=inputs, pwm1=0, pwm2=0))
        spinning = asyncio.create_task(spun_by_ours(nullcontext(Rig(rig.client, await rig.client.daemon()))))
        async with asyncio.timeout(120):
            while shaft(chain)[1] < 15:
                await asyncio.sleep(0.02)
    await asyncio.gather(spinning, return_exceptions=True)
    assert abs(shaft(chain)[1]) < SAFE  # the daemon brings it to rest before it ends
    assert looker.steepest < RAMP  # both times on a ramp

    # not in mid-spin: on the bare line, too, that program waits for ever for the home of a rotor that it left spinning
    with simulated_clock():
        did = await cycle(backend(BareLine(chain)), chain)
    assert did["fastest"] == pytest.approx(945 / 60, rel=0.02)
    assert did["door open"] is did["door shut"] is True


async def test_a_rotor_is_handed_over_in_mid_spin_and_goes_back(tmp_path):
    config = taking_over(tmp_path)
    (chain,) = lines_of(config).values()
    await left_spinning(chain)
    looker = Looker(chain)
    looking = asyncio.create_task(looker.look())
    try:
        await handed_over_and_back(config, chain, looker)
        assert not looking.done()
    finally:
        await given_up(looking)
