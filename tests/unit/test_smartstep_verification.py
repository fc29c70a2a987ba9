"""Assumptions about traces, verified on simulated drives that behave in every way the manual leaves open."""

import asyncio
from itertools import product

import pytest

from ldcnd.bench.edit import set_for_axis
from ldcnd.bench.smartstep.verification import verified_keys, verify_traces
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import DriveFault
from ldcnd.drives.smartstep.parameters import PN202, PN203
from ldcnd.drives.smartstep.profiles import (
    SMARTSTEP,
    ByteOrder,
    CommandPulseGear,
    CountUnit,
    StringChecksum,
    TraceWordLayout,
)
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.process import ROOT
from tests.support.smartstep_line import simulated, smartstep_line

LAYOUTS = [TraceWordLayout.MSB_IO, TraceWordLayout.LSB_IO_SHIFT, TraceWordLayout.LSB_IO_MASK]
VARIANTS = [
    SimulatedVariant(
        trace_word_layout=layout,
        trace_byte_order=order,
        command_pulse_gear=gear,
        string_checksum=checksum,
        string_count_unit=unit,
        longest_string_bytes=longest,
    )
    for (layout, order), gear, checksum, unit, longest in zip(
        product(LAYOUTS, ByteOrder),
        [*CommandPulseGear] * 2,
        [StringChecksum.HEADER, StringChecksum.ALL, StringChecksum.TRAILER] * 2,
        [*CountUnit] * 2,
        [1000, 64] * 3,
        strict=True,
    )
]


def person(unit, rate=100_000.0):
    """Send the command pulses that are asked for."""

    async def act(_request: str) -> None:
        unit.drive.set_pulse_rate(rate, asyncio.get_running_loop().time())

    return act


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda each: f"{each.trace_word_layout}-{each.trace_byte_order}")
@pytest.mark.sweep(2)
async def test_a_drive_shows_how_its_traces_are_laid_out_and_geared(variant, tmp_path):
    unit = simulated(1, variant, {PN202: 4, PN203: 1})
    async with smartstep_line([unit]) as line:
        words = line.axis("u1").words
        found = {each.key: each async for each in verify_traces(line.bus, words, SMARTSTEP, person(unit))}

    assert {key: each.setting for key, each in found.items()} == {
        "trace_word_layout": variant.trace_word_layout,
        "trace_byte_order": variant.trace_byte_order,
        "command_pulse_gear": variant.command_pulse_gear,
        "string_checksum": variant.string_checksum,
        "string_count_unit": variant.string_count_unit,
        "trace_chunk_bytes": 62 if variant.longest_string_bytes == 64 else 200,
    }
    assert unit.drive.mode == 0
    assert sum(unit.drive.memory.writes.values()) == 0
    config = tmp_path / "mixed.toml"
    config.write_text((ROOT / "config" / "mixed.toml").read_text())
    set_for_axis(config, "feed", {"smartstep.trace": verified_keys(list(found.values()))})
    (feed,) = [each.smartstep for bus in load_config(config).bus for each in bus.axis if each.name == "feed"]
    assert feed.trace.word_layout is variant.trace_word_layout
    assert feed.trace.command_pulse_gear is variant.command_pulse_gear
    assert feed.trace.verified


@pytest.mark.parametrize("rate", [0.0, 100.0])
async def test_what_the_pulses_do_not_tell_apart_stays_open_and_is_not_written(rate):
    unit = simulated(1)
    async with smartstep_line([unit]) as line:
        words = line.axis("u1").words
        found = {each.key: each async for each in verify_traces(line.bus, words, SMARTSTEP, person(unit, rate))}

    assert found["command_pulse_gear"].setting is None
    assert "faster pulses" in found["command_pulse_gear"].text
    assert not {"command_pulse_gear", "verified"} & verified_keys(list(found.values())).keys()


async def test_pulses_that_change_during_the_trace_verify_nothing():
    unit = simulated(1)
    async with smartstep_line([unit]) as line:

        async def act(_request: str) -> None:
            loop = asyncio.get_running_loop()
            unit.drive.set_pulse_rate(100_000.0, loop.time())
            loop.call_later(2.0, lambda: unit.drive.set_pulse_rate(0.0, loop.time()))

        with pytest.raises(DriveFault, match="before the trace"):
            async for _ in verify_traces(line.bus, line.axis("u1").words, SMARTSTEP, act):
                pass

    assert unit.drive.mode == 0
