"""Reading trace memories over the real bus, from drives that answer in different ways."""

import asyncio

import pytest

from ldcnd.drivers.smartstep.profiles import CountUnit, SmartStepProfile, StringChecksum
from ldcnd.drivers.smartstep.simulated_variant import SimulatedVariant
from ldcnd.drivers.smartstep.trace_upload import TraceUpload
from ldcnd.errors import BadReply, ByteCountRefused
from tests.support.smartstep_line import simulated, smartstep_line

RAMP = [(7 * point) & 0xFFFF for point in range(500)]


def filled(variant=None):
    drive = simulated(1, variant)
    for ring in drive.drive.recorder.rings:
        ring[:] = RAMP
    return drive


async def fetched(drive, profile):
    async with smartstep_line([drive], profile=profile) as line:
        upload = TraceUpload(line.bus, line.axis("u1").words, profile)
        words = await upload.fetch(2)
        return list(words), upload.string_checksum, line.bus.statistics.exchanges


async def test_everything_is_read_twice_unless_told_otherwise():
    words, _, twice = await fetched(filled(), SmartStepProfile())
    _, _, once = await fetched(filled(), SmartStepProfile(trace_verify=False))

    assert words == RAMP
    assert (once, twice) == (5, 10)


async def test_pieces_that_are_too_long_for_a_drive_are_halved():
    words, _, exchanges = await fetched(
        filled(SimulatedVariant(longest_string_bytes=50)), SmartStepProfile(trace_verify=False)
    )

    assert words == RAMP
    assert exchanges == 5 * (1 + 2 + 4)


async def test_a_drive_that_refuses_a_single_word_is_believed():
    with pytest.raises(ExceptionGroup) as refused:
        await fetched(filled(SimulatedVariant(longest_string_bytes=1)), SmartStepProfile())

    assert refused.group_contains(ByteCountRefused)


async def test_the_checksum_of_the_drive_is_learnt_on_the_way():
    _, found, _ = await fetched(filled(SimulatedVariant(string_checksum=StringChecksum.ALL)), SmartStepProfile())

    assert found is StringChecksum.ALL


async def test_another_count_unit_is_recognised_and_named():
    with pytest.raises(ExceptionGroup) as refused:
        await fetched(filled(SimulatedVariant(string_count_unit=CountUnit.CHARS)), SmartStepProfile())

    assert refused.group_contains(BadReply, match="count unit seems to be chars")


async def test_memory_that_changes_while_it_is_read_is_read_until_it_rests():
    drive, profile = filled(), SmartStepProfile()
    ring = drive.drive.recorder.rings[1]
    async with smartstep_line([drive], profile=profile) as line:
        upload = TraceUpload(line.bus, line.axis("u1").words, profile)
        async with asyncio.TaskGroup() as group:
            fetching = group.create_task(upload.fetch(2), name="fetch")
            await asyncio.sleep(0.3)  # the reply of the first reading is on its way
            ring[0] = 0x1234

    assert fetching.result()[0] == 0x1234


async def test_memory_that_never_rests_is_no_trace():
    drive, profile = filled(), SmartStepProfile()
    ring = drive.drive.recorder.rings[1]

    async def disturb():
        while True:
            ring[0] = (ring[0] + 1) & 0xFFFF
            await asyncio.sleep(0.05)

    async with smartstep_line([drive], profile=profile) as line:
        upload = TraceUpload(line.bus, line.axis("u1").words, profile)
        async with asyncio.TaskGroup() as group:
            disturbing = group.create_task(disturb(), name="disturb")
            with pytest.raises(BadReply, match="read differently each time"):
                await upload.fetch(2)
            disturbing.cancel()
