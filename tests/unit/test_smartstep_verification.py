"""Assumptions about traces, verified on simulated drives that behave in every way the manual leaves open."""

import asyncio
from itertools import product

import pytest

from ldcnd.config.edit import set_for_axis
from ldcnd.config.rig import load_config
from ldcnd.drives.smartstep.parameters import PN202, PN203
from ldcnd.drives.smartstep.profiles import (
    SMARTSTEP,
    ByteOrder,
    CommandPulseGear,
    CountUnit,
    StringChecksum,
    TraceWordLayout,
)
from ldcnd.drives.smartstep.tools import verified_tables
from ldcnd.drives.smartstep.verification import Stimulus, verify_traces
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
TURNED_S, EACH_S = 20.0, 0.005


def person(unit):
    """Do with the drive what is asked of a person."""

    async def act(stimulus: Stimulus) -> None:
        drive, now_s = unit.drive, asyncio.get_running_loop().time()
        if stimulus is Stimulus.PULSES:
            drive.set_pulse_rate(3000.0, now_s)
        if stimulus is not Stimulus.TURN:
            return

        def turned(at_s: float) -> None:
            drive.advance(at_s)
            drive.motor.speed = 40_000.0

        unit._events.clear()
        for step in range(round(TURNED_S / EACH_S)):
            unit.schedule(now_s + step * EACH_S, turned)

    return act


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda each: f"{each.trace_word_layout}-{each.trace_byte_order}")
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
    set_for_axis(config, "feed", verified_tables(list(found.values())))
    (feed,) = [each.smartstep for bus in load_config(config).bus for each in bus.axis if each.name == "feed"]
    assert feed.trace.word_layout is variant.trace_word_layout
    assert feed.trace.command_pulse_gear is variant.command_pulse_gear
    assert set(feed.verified) == set(found)


async def test_what_a_person_does_not_stimulate_stays_open_and_is_not_written():
    async def nothing(_stimulus: Stimulus) -> None:
        return

    unit = simulated(1)
    async with smartstep_line([unit]) as line:
        words = line.axis("u1").words
        found = {each.key: each async for each in verify_traces(line.bus, words, SMARTSTEP, nothing)}

    assert found["command_pulse_gear"].setting is None
    assert "1/1" in found["command_pulse_gear"].text
    assert "command_pulse_gear" not in verified_tables(list(found.values()))["smartstep.verified"]
