from ldcnd.bench.smartstep.examination import examine
from ldcnd.contract.health import Finding, Verdict
from ldcnd.drives.smartstep.packet import decode_command
from ldcnd.drives.smartstep.parameters import PN000, PN100
from ldcnd.drives.smartstep.profiles import StringChecksum, Wiring
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.smartstep_line import SmartStepLine, simulated, smartstep_line


async def findings(line: SmartStepLine, name: str = "u1") -> dict[str, Finding]:
    return {finding.what: finding async for finding in examine(line.bus, line.axis(name))}


async def test_a_healthy_drive_is_examined_by_reading_alone():
    unit = simulated(1)
    unit.drive.recorder.rings[0][:2] = [0x1234, 0xABCD]
    async with smartstep_line([unit]) as line:
        found = await findings(line)
        commands = [command for record in line.bus.wire_log.records() if (command := decode_command(record.data))]

    assert {finding.verdict for finding in found.values()} == {Verdict.FINE}
    assert "1000 bytes" in found["longest string"].text
    assert "header" in found["strings"].text
    assert {command.function for command in commands if command.address != PN000.eeprom_address} <= {0, 2}
    assert all(command.address % 2 == 0 and command.data % 2 == 0 for command in commands if command.function == 2)


async def test_other_variants_are_recognised():
    variant = SimulatedVariant(
        string_checksum=StringChecksum.TRAILER, longest_string_bytes=200, counter_strings=True, eeprom_changes_ram=True
    )
    unit = simulated(1, variant)
    unit.drive.recorder.rings[0][:2] = [0x1234, 0xABCD]
    unit.drive.memory.write(PN100.ram_address, 99)
    async with smartstep_line([unit]) as line:
        found = await findings(line)

    assert found["strings"].text.endswith("checksum covers: trailer")
    assert "chunks" in found["longest string"].text
    assert "can be read at once" in found["atomic counter"].text
    assert "Pn100 99/80" in found["memories"].text


async def test_a_silent_drive_ends_the_examination():
    async with smartstep_line([simulated(1)], numbers=[4]) as line:
        found = await findings(line, "u4")

    assert [(finding.what, finding.verdict) for finding in found.values()] == [("alive", Verdict.WRONG)]


async def test_a_drive_that_hears_itself_ends_the_examination():
    unit = simulated(1, SimulatedVariant(hears_itself=True))
    async with smartstep_line([unit], wiring=Wiring.TWO_WIRE) as line:
        found = await findings(line)

    assert list(found) == ["alive", "wires"]
    assert found["wires"].verdict is Verdict.WRONG


async def test_an_alarm_deserves_a_look():
    unit = simulated(1)
    unit.drive.provoke(0x00C3, 0.0)
    async with smartstep_line([unit]) as line:
        found = await findings(line)

    assert found["state"].verdict is Verdict.LOOK
    assert "Encoder disconnection" in found["state"].text
