"""Samples are made without checks: what is published is checked here, of all drives, in every state they come to."""

import asyncio
from collections import Counter

import pytest

from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.codec import decode
from ldcnd.contract.commands import Halt, MoveVelocity, Power
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import SAMPLE_MODELS, AxisState, LinkState, TelemetryItem
from ldcnd.net.session import Publication, SampleKind
from tests.support.rig import SIMULATED, RunningRig, running_rig

FAULT_AT_S = 5.0


def simulated(encoding: str, events: list[dict[str, object]]) -> RigConfig:
    document = load_config(SIMULATED).model_dump(mode="json", exclude_unset=True)
    document["sim"][0]["event"] = events
    return RigConfig.model_validate({**document, "telemetry": {"encoding": encoding}})


async def samples_of(rig: RunningRig, taken: list[Publication]) -> None:
    keys = Keys(rig.client.rig)
    await rig.session.subscribe(keys.telemetry_pattern("*", "*"), taken.append)


def kinds(taken: list[Publication]) -> Counter[str]:
    """Count the samples of each item; each must be what its model says, to the letter."""
    found: Counter[str] = Counter()
    for sample in taken:
        item = sample.key.rpartition("/")[2]
        if sample.kind is SampleKind.PUT and item in SAMPLE_MODELS:
            decode(SAMPLE_MODELS[TelemetryItem(item)], sample.payload, sample.encoding)
            found[item] += 1
    return found


@pytest.mark.parametrize("encoding", ["json", "msgpack"])
@pytest.mark.sweep(2)
async def test_what_is_published_of_drives_that_move_stop_fail_and_fall_silent(encoding: str):
    events: list[dict[str, object]] = [
        {"at_s": FAULT_AT_S, "module": 2, "begins": "overvoltage"},
        {"at_s": FAULT_AT_S, "module": 4, "power": "off"},
    ]
    taken: list[Publication] = []
    async with running_rig(simulated(encoding, events)) as rig:
        await samples_of(rig, taken)
        for axis in ("x", "c"):
            await rig.until(axis, lambda state: state.link is LinkState.UP)
        await rig.client.command("x", Power(on=True))
        await rig.client.command("x", MoveVelocity(velocity=1.0))
        await asyncio.sleep(0.5)
        await rig.client.command("x", Halt())
        await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        await rig.client.stop("x")
        await rig.until("c", lambda state: state.link is LinkState.DOWN)

    found = kinds(taken)
    unseen = {TelemetryItem.IO, TelemetryItem.LATCH, TelemetryItem.SHADOW}  # no I/O module, no probe, no observer
    assert set(found) == set(TelemetryItem) - unseen
    assert min(found.values()) > 10


@pytest.mark.long
async def test_what_is_published_of_smartsteps():
    taken: list[Publication] = []
    mixed = load_config(SIMULATED.with_name("mixed.toml")).model_copy(update={"state_dir": None})
    async with running_rig(mixed) as rig:
        await samples_of(rig, taken)
        await asyncio.sleep(10.0)

    smartsteps = kinds([sample for sample in taken if sample.key.split("/")[-2] in {"feed", "spool"}])
    assert set(smartsteps) >= {"position", "velocity", "state", "fault"}
