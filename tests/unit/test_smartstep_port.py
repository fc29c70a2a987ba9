import pytest

from ldcnd.drivers.smartstep.commands import reference
from ldcnd.drivers.smartstep.parameters import PN100
from ldcnd.drivers.smartstep.parity import add_parity
from ldcnd.drivers.smartstep.profiles import Framing, SmartStepProfile
from tests.support.smartstep_line import simulated, smartstep_line


async def test_each_packet_waits_until_the_line_has_been_quiet():
    async with smartstep_line([simulated(1)], profile=SmartStepProfile(quiet_s=0.02)) as line:
        for _ in range(5):
            await line.bus.execute(reference(1, PN100.ram_address))
        records = line.bus.wire_log.records()

    exchange_s = 28 * 10 / 9600 + 0.01
    assert records[-1].at_s == pytest.approx(5 * exchange_s + 5 * 0.02, abs=1e-3)


async def test_soft_parity_serves_a_port_of_eight_bits():
    profile = SmartStepProfile(framing=Framing.SOFT_PARITY)
    async with smartstep_line([simulated(1)], profile=profile, framing=Framing.SOFT_PARITY) as line:
        value = await line.bus.execute(reference(1, PN100.ram_address))

    assert value == 80
    assert add_parity(b"W") != b"W"
