"""What a daemon keeps of its axes for the next one, on drives that outlive it, and what speaks against it."""

import asyncio
import contextlib
import errno
import json
import os
import random
import re
import subprocess
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from ldcnd import durable
from ldcnd.axis.kept import KeptFiles
from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Halt, Home, MoveAbsolute, MoveRelative, MoveVelocity, Power, Reset, SetPosition
from ldcnd.contract.errors import AxisUnreachable, LdcndError, NotReferenced, ReplyTimeout, RequestRefused, WrongState
from ldcnd.contract.events import CommandStatus, ReadEvents
from ldcnd.contract.samples import FaultSample, LinkState, Moving, PositionSample, StateSample, TelemetryItem
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.received import PlainCommand, ResetPosition
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.durable import DISK_TIME_S
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.power import FaultCondition
from tests.support.chain_rig import ChainRig, drive, rig_on, simulated_config
from tests.support.small_disk import fill, small_disk

COUNTS = 1000
"""Of x, in a millimetre."""


def chain_of(*models: str) -> Chain:
    models = models or ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")
    return build_chain(ChainSpec(tuple(ModuleSpec(model) for model in models)))


def keeping(folder: Path, axes: dict[str, object] | None = None, **bus: object) -> RigConfig:
    """Return the configuration of a rig that takes its line over, or resets it where it was never used."""
    changed = {"reference": "required", "loss": {"daemon": "halt"}} | (axes or {})
    config = simulated_config(changed, **({"start": "adopt", "adopt_fallback": "reset"} | bus))
    return config.model_copy(update={"state_dir": folder})


async def up(rig: ChainRig, axis: str) -> StateSample:
    """Wait until an axis answers, and is known to stand or to move, or a fault hides it."""

    def is_up(state: StateSample) -> bool:
        return state.link is LinkState.UP and (state.moving is not Moving.UNKNOWN or bool(state.motion_hidden_by))

    return await rig.until(axis, is_up)


async def set_out(rig: ChainRig, axis: str = "x", position: float = 40.0, at: float = 7.0) -> None:
    """Move an axis to where its drive counts 3 mm, call that place `at`, and go to a position."""
    await up(rig, axis)
    await rig.client.command(axis, Power(on=True))
    await ended(rig, axis, MoveRelative(distance=3.0))
    await rig.client.command(axis, SetPosition(position=at))
    await asyncio.sleep(2.0)  # virtual; the drive has its mark here
    await ended(rig, axis, MoveAbsolute(position=position))
    await asyncio.sleep(2.0)


async def ended(rig: ChainRig, axis: str, command: Any) -> None:
    reply = await rig.client.command(axis, command)
    await rig.client.wait_for_end(axis, reply.command_id)


async def position_of(rig: ChainRig, axis: str = "x") -> PositionSample:
    async with rig.client.samples(axis, TelemetryItem.POSITION) as positions:
        _, sample = await anext(positions)
    assert isinstance(sample, PositionSample)
    return sample


async def refusals(rig: ChainRig, axis: str = "x") -> list[str]:
    """Return what the events say of kept references."""
    events = (await rig.client.ask(ReadEvents(axis=axis))).events
    return [
        "" if event.status is CommandStatus.DONE else str(event.reason) for event in events if event.verb == "reference"
    ]


@asynccontextmanager
async def restarted(
    chain: Chain, config: RigConfig, *, kill: bool = False, position: float = 40.0
) -> AsyncIterator[ChainRig]:
    """Run a daemon that references x, end it, and run another one on the same drives."""
    async with rig_on(chain, config) as rig:
        await set_out(rig, position=position)
        if kill:
            await rig.kill()
    await asyncio.sleep(1.0)
    async with rig_on(chain, config) as rig:
        await up(rig, "x")
        yield rig


@pytest.mark.parametrize("kill", [False, True])
@pytest.mark.sweep(2)
async def test_a_reference_outlives_the_daemon_and_moves_go_where_they_are_told(tmp_path, kill):
    chain = chain_of()
    async with restarted(chain, keeping(tmp_path), kill=kill) as rig:
        state, position = await up(rig, "x"), await position_of(rig)
        others = [(await up(rig, axis)).referenced for axis in "yzc"]
        await ended(rig, "x", MoveAbsolute(position=10.0))
        went_to = (await position_of(rig)).value
        said = await refusals(rig)

    assert state.referenced
    assert others == [False, False, False]
    assert position.value == pytest.approx(40.0, abs=0.01)
    assert went_to == pytest.approx(10.0, abs=0.01)
    assert drive(chain, 1).loop.position == pytest.approx((10 - 7 + 3) * COUNTS, abs=12)
    assert said == [""]


@pytest.mark.long
async def test_a_reference_outlives_many_restarts(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with restarted(chain, config):
        pass
    for _ in range(3):
        async with rig_on(chain, config) as rig:
            assert (await up(rig, "x")).referenced
            await rig.kill()
    async with rig_on(chain, config) as rig:
        assert (await position_of(rig)).value == pytest.approx(40.0, abs=0.01)


@pytest.mark.long
async def test_a_homed_axis_has_its_mark_from_its_homing(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await up(rig, "z")
        await rig.client.command("z", Power(on=True))
        await ended(rig, "z", Home(method="index", velocity=0.5, position=2.0, move_to=20.0))
        await asyncio.sleep(2.0)
        marks = [packet for packet in rig.sent if packet.command is CommandCode.SAVE_CURRENT_POSITION_AS_HOME]
        before = await position_of(rig, "z")

    async with rig_on(chain, config) as rig:
        state, after = await up(rig, "z"), await position_of(rig, "z")

    assert not marks or abs(drive(chain, 3).loop.home) >= 100
    assert (state.referenced, after.value) == (True, pytest.approx(before.value, abs=0.001))


@pytest.mark.long
async def test_a_daemon_killed_in_mid_move_is_followed_by_one_that_knows_where_it_is(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
        await rig.client.command("x", MoveAbsolute(position=90.0, velocity=10.0))
        await asyncio.sleep(1.0)
        await rig.kill()

    async with rig_on(chain, config) as rig:
        state = await up(rig, "x")
        moving = await position_of(rig)
        await rig.until("x", lambda state: state.state == "standstill")
        await asyncio.sleep(1.0)
        there = await position_of(rig)

    assert state.referenced
    assert 45 < moving.value < 89
    assert there.value == pytest.approx(90.0, abs=0.01)


@pytest.mark.long
async def test_turns_of_a_rotary_axis_outlive_the_daemon(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    (bus,) = config.bus
    axes = tuple(axis.model_copy(update={"modulo": 360.0}) if axis.name == "c" else axis for axis in bus.axis)
    config = config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
    async with rig_on(chain, config) as rig:
        await up(rig, "c")
        await rig.client.command("c", Power(on=True))
        await rig.client.command("c", SetPosition(position=0.0))
        await ended(rig, "c", MoveRelative(distance=2 * 360.0 + 90.0))
        await asyncio.sleep(2.0)

    async with rig_on(chain, config) as rig:
        await up(rig, "c")
        after = await position_of(rig, "c")

    assert (after.turns, after.value) == (2, pytest.approx(90.0, abs=0.1))


@pytest.mark.long
async def test_a_motion_is_written_once_however_long_it_takes(tmp_path, monkeypatch):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
        replace, written = durable.replace, []

        def counted(path: Path, text: str) -> None:
            written.append(json.loads(text))
            replace(path, text)

        monkeypatch.setattr(durable, "replace", counted)
        await rig.client.command("x", MoveAbsolute(position=90.0, velocity=1.0))
        await asyncio.sleep(45.0)
        in_motion = list(written)

    assert [(kept["low"], kept["high"]) for kept in in_motion] == [
        (pytest.approx(36 * COUNTS, abs=12), pytest.approx(86 * COUNTS, abs=12))
    ]


@pytest.mark.long
async def test_one_reading_that_proves_a_reference_is_enough(tmp_path, monkeypatch):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
    read, readings = LdcnAxis.evidence, []

    async def once(axis: LdcnAxis) -> Any:
        readings.append(axis)
        if len(readings) > 1:
            raise ReplyTimeout("no reply")
        return await read(axis)

    monkeypatch.setattr(LdcnAxis, "evidence", once)
    async with rig_on(chain, config) as rig:
        state, said = await up(rig, "x"), await refusals(rig)

    assert (state.referenced, said) == (True, [""])


# -- what speaks against it ------------------------


async def between(chain: Chain, config: RigConfig, tamper: Any, **how: Any) -> tuple[bool, list[str]]:
    """Reference x, end the daemon, tamper with its drive; return whether the next one believes, and what it says."""
    async with rig_on(chain, config) as rig:
        await set_out(rig, **how)
    tamper(drive(chain, 1))
    await asyncio.sleep(2.0)
    async with rig_on(chain, config) as rig:
        state = await up(rig, "x")
        return state.referenced, await refusals(rig)


@pytest.mark.parametrize(
    ("cut", "why"), [(slice(None), "its line was reset"), (slice(1), "its drive had lost power")], ids=["all", "alone"]
)
@pytest.mark.long
async def test_a_drive_that_lost_power_has_no_reference(tmp_path, cut, why):
    def switch(_drive: object) -> None:
        now_s = asyncio.get_running_loop().time()
        for module in chain.modules[cut]:
            module.power(on=False, at_s=now_s)
            module.power(on=True, at_s=now_s + 0.1)

    chain = chain_of()
    assert await between(chain, keeping(tmp_path), switch) == (False, [f"not kept: {why}"])


@pytest.mark.long
async def test_a_reference_that_is_lost_under_a_daemon_is_off_the_disk_before_it_ends(tmp_path):
    chain = chain_of()
    async with rig_on(chain, keeping(tmp_path)) as rig:
        await set_out(rig)
        kept = list(tmp_path.glob("references/*"))
        drive(chain, 1).loop.renumber(0)  # as another program does
        await rig.until("x", lambda state: not state.referenced)
        await asyncio.sleep(2.0)
        left = list(tmp_path.glob("references/*"))

    assert (kept, left) == ([tmp_path / "references" / "x.json"], [])


@pytest.mark.promise("kept-reference")
@pytest.mark.long
async def test_a_drive_that_was_reset_and_addressed_by_another_program_has_no_reference(tmp_path):
    """Address, identity and rate are what they were, and even the counter is near where it was."""

    def reset(module: Any) -> None:
        address, group, baud = module.address, module.group, module.baud
        module.restart()
        module.address, module.group, module.baud = address, group, baud
        module.loop.renumber(3000 + 33 * COUNTS)
        module.loop.close()
        module.loop.home = 0

    believed, said = await between(chain_of(), keeping(tmp_path), reset)
    assert not believed
    assert "its mark is 0 and was " in said[0]


@pytest.mark.promise("kept-reference")
@pytest.mark.parametrize(
    ("tamper", "why"),
    [
        (lambda module: module.execute(ResetPosition()), "its counter reads 0, as after a reset"),
        (lambda module: module.execute(PlainCommand(CommandCode.SAVE_CURRENT_POSITION_AS_HOME)), "another program"),
        (lambda module: module.loop.open(), "its loop is open and was closed"),
        (lambda module: module.loop.renumber(module.loop.position + 500), "it is 500 counts from where it was left"),
    ],
)
@pytest.mark.sweep(3)
async def test_what_another_program_did_meanwhile_costs_the_reference(tmp_path, tamper, why):
    believed, said = await between(chain_of(), keeping(tmp_path), tamper)
    assert (believed, len(said)) == (False, 1)
    assert why in said[0]


@pytest.mark.long
async def test_an_axis_that_was_pushed_has_no_reference(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
        await rig.client.command("x", Power(on=False))
        await asyncio.sleep(2.0)
    drive(chain, 1).shaft.position_counts += 2000
    async with rig_on(chain, config) as rig:
        state, said = await up(rig, "x"), await refusals(rig)

    assert not state.referenced
    assert "it was moved while no daemon watched it, or could keep that" in said[0]


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"counts_per_unit": 2000}, "scale, unit or modulo was"),
        ({"direction": "reverse"}, "scale, unit or modulo was"),
    ],
)
@pytest.mark.sweep(2)
async def test_another_configuration_costs_the_reference(tmp_path, changed, why):
    chain = chain_of()
    async with rig_on(chain, keeping(tmp_path)) as rig:
        await set_out(rig)
    async with rig_on(chain, keeping(tmp_path, changed)) as rig:
        state, said = await up(rig, "x"), await refusals(rig)
    assert not state.referenced
    assert why in said[0]


@pytest.mark.parametrize(
    ("text", "why"),
    [("", "cannot be read"), ("{", "cannot be read"), ('{"format": 9}', "cannot be read"), (None, "another version")],
)
@pytest.mark.sweep(3)
async def test_a_file_that_makes_no_sense_costs_the_reference(tmp_path, text, why):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
    file = tmp_path / "references" / "x.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"format": 2}) if text is None else text)
    async with rig_on(chain, config) as rig:
        state, said = await up(rig, "x"), await refusals(rig)
    assert not state.referenced
    assert why in said[0]
    assert not file.exists()


async def tar(what: str, folder: Path) -> None:
    command = ["tar", what, "backup.tar", "references"]
    await asyncio.to_thread(subprocess.run, command, cwd=folder, check=True)


@pytest.mark.long
async def test_a_backup_that_is_put_back_brings_no_old_origin(tmp_path):
    """The axis stands where it stood, on the same mark, and has another position 0 by now."""
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
    await tar("cf", tmp_path)
    async with rig_on(chain, config) as rig:
        await up(rig, "x")
        await rig.client.command("x", SetPosition(position=30.0))
        await asyncio.sleep(1.0)
    await asyncio.to_thread(time.sleep, DISK_TIME_S + 0.5)  # the disk has the clock of the machine
    await tar("xf", tmp_path)
    async with rig_on(chain, config) as rig:
        state, said = await up(rig, "x"), await refusals(rig)
    assert not state.referenced
    assert "a copy that was put there" in said[0]


async def test_latches_of_a_backup_are_no_word_of_now_though_a_clock_was_ahead_when_it_was_made(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await up(rig, "x")
    kept = tmp_path / "latches.json"
    ahead = json.loads(kept.read_text())
    kept.write_text(json.dumps(ahead | {"on_disk": ahead["on_disk"] + 86_400 * 10**9}))
    async with rig_on(chain, config) as rig:
        state = await up(rig, "x")

    assert state.stop_latched


@pytest.mark.parametrize("elsewhere", ["in another folder", "without a folder", "under another name"])
@pytest.mark.sweep(1)
async def test_a_place_that_another_daemon_has_given_costs_the_reference(tmp_path, elsewhere):
    """Nothing was moved, switched or reset meanwhile: only the drive's mark can tell."""
    chain, config = chain_of(), keeping(tmp_path)
    another, name = config, "x"
    if elsewhere == "under another name":
        name = "gantry"
        line = config.bus[0]
        axes = tuple(axis.model_copy(update={"name": "gantry"}) if axis.name == "x" else axis for axis in line.axis)
        another = config.model_copy(update={"bus": (line.model_copy(update={"axis": axes}), *config.bus[1:])})
    else:
        other = tmp_path / "other" if elsewhere == "in another folder" else None
        another = config.model_copy(update={"state_dir": other})
    async with rig_on(chain, config) as rig:
        await set_out(rig)
    async with rig_on(chain, another) as rig:
        await up(rig, name)
        if (await rig.client.state(name)).stop_latched:
            await rig.until(name, lambda state: state.moving is Moving.NO and not state.stop_pending)
            await rig.client.command(name, Reset())
        await rig.client.command(name, SetPosition(position=30.0))
    async with rig_on(chain, config) as rig:
        state, said = await up(rig, "x"), await refusals(rig)
    assert not state.referenced
    assert "its mark is" in said[0]


@pytest.mark.long
async def test_a_refused_reference_is_seen_where_an_operator_looks_and_stays_refused(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
    drive(chain, 1).loop.renumber(500)
    async with rig_on(chain, config) as rig:
        await up(rig, "x")
        fault = await rig.client.last("x", TelemetryItem.FAULT)
        with pytest.raises(NotReferenced, match="what was kept of it was refused: it is -35"):
            await rig.client.command("x", MoveAbsolute(position=1.0))
        await rig.kill()
    async with rig_on(chain, config) as rig:
        again, said = await up(rig, "x"), await refusals(rig)
        await rig.client.command("x", SetPosition(position=1.0))
        cleared = await rig.until("x", lambda state: state.referenced)
        await asyncio.sleep(1.0)
        later = await rig.client.last("x", TelemetryItem.FAULT)

    assert isinstance(fault, FaultSample)
    assert isinstance(later, FaultSample)
    assert [(entry.code, entry.stops, entry.source) for entry in fault.active] == [
        ("reference_refused", False, "daemon")
    ]
    assert fault.first is None
    assert (again.referenced, said) == (False, [])
    assert (cleared.referenced, later.active) == (True, ())


async def test_a_shaft_that_was_let_go_of_in_motion_under_an_earlier_daemon_may_turn_until_that_time_is_over(tmp_path):
    # an encoder that has died beside the daemon looks like rest
    chain, config = chain_of(), keeping(tmp_path, {"coast_s": 4.0})
    async with rig_on(chain, config) as rig:
        await set_out(rig)
        await rig.client.command("x", MoveAbsolute(position=90.0, velocity=10.0))
        await asyncio.sleep(1.0)
        await rig.client.command("x", Power(on=False))
        await rig.kill()
    now_s = asyncio.get_running_loop().time()
    drive(chain, 1).set_condition(FaultCondition.ENCODER_STUCK, present=True, at_s=now_s)
    async with rig_on(chain, config) as rig:
        begun_s = asyncio.get_running_loop().time()
        state = await rig.until("x", lambda state: state.link is LinkState.UP)
        with pytest.raises(WrongState, match="may turn with its motor off: it was not read while it moved"):
            await rig.client.command("x", Power(on=True))
        await rig.client.command("x", Power(on=False))
        await rig.until("x", lambda state: state.moving is Moving.NO)
        unseen_s = asyncio.get_running_loop().time() - begun_s
        await rig.client.command("x", Power(on=True))
        await rig.client.command("x", SetPosition(position=7.0))
        await asyncio.sleep(2.0)
    async with rig_on(chain, config) as rig:  # it stood
        begun_s = asyncio.get_running_loop().time()
        await rig.until("x", lambda state: state.moving is Moving.NO)
        seen_s = asyncio.get_running_loop().time() - begun_s

    assert state.moving is Moving.UNKNOWN
    assert 15.9 < unseen_s < 17.0
    assert seen_s < 1.0


# -- a crash between what happens and what is written ------------------------


@pytest.mark.promise("kept-reference")
@pytest.mark.long
async def test_a_crash_right_behind_a_new_origin_never_brings_back_the_old_one(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
        await rig.client.command("x", SetPosition(position=-5.0))
        await rig.kill()
    async with rig_on(chain, config) as rig:
        state, said = await up(rig, "x"), await refusals(rig)

    assert (state.referenced, said) == (False, [])


@pytest.mark.long
async def test_a_crash_in_mid_homing_leaves_no_reference(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
        await rig.client.command("x", Home(method="index", velocity=0.5, position=0.0))
        await rig.kill()
    async with rig_on(chain, config) as rig:
        assert not (await up(rig, "x")).referenced


async def test_a_counter_is_not_set_back_before_the_reference_is_off_the_disk(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
        keeper = rig.daemon.rig.axes["x"].reference
        file = tmp_path / "references" / "x.json"
        assert file.exists()

        await keeper._drive.about_to_renumber()

        assert not file.exists()
        assert rig.daemon.rig.axes["x"].driver.about_to_renumber == keeper.forget


# -- disks ------------------------


@pytest.mark.long
async def test_a_full_disk_costs_the_reference_and_nothing_else(tmp_path, monkeypatch):
    def full(path: Path, text: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    chain, config = chain_of(), keeping(tmp_path)
    monkeypatch.setattr(durable, "replace", full)
    async with restarted(chain, config) as rig:
        state = await up(rig, "x")
        await rig.client.command("x", SetPosition(position=1.0))
        await ended(rig, "x", MoveAbsolute(position=2.0))
        there = await position_of(rig)

    assert not state.referenced
    assert there.value == pytest.approx(2.0, abs=0.01)
    assert not (tmp_path / "references" / "x.json").exists()


@pytest.mark.long
async def test_a_reference_that_cannot_be_removed_from_the_disk_is_made_void_in_the_drive(tmp_path, monkeypatch):
    def read_only(path: Path, *_text: str) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
        monkeypatch.setattr(durable, "replace", read_only)
        monkeypatch.setattr(durable, "remove", read_only)

        await rig.client.command("x", SetPosition(position=-5.0))
        await ended(rig, "x", MoveAbsolute(position=-4.0))
        there = await position_of(rig)
        await rig.kill()
    monkeypatch.undo()
    async with rig_on(chain, config) as rig:
        state, said = await up(rig, "x"), await refusals(rig)

    assert there.value == pytest.approx(-4.0, abs=0.01)
    assert not state.referenced
    assert re.search("its mark is 36... and was 3...:", said[0])


@pytest.mark.parametrize("what", ["moved", "set", "switched off"])
async def test_a_reference_that_a_full_disk_has_cost_is_refused_for_that(tmp_path, what):
    with small_disk(tmp_path / "state", 256 * 1024) as disk:
        chain, config = chain_of(), keeping(disk)
        async with rig_on(chain, config) as rig:
            await set_out(rig)
            await asyncio.sleep(2.0)
            fill(disk)
            if what == "moved":
                await ended(rig, "x", MoveAbsolute(position=12.0))
            elif what == "set":
                await rig.client.command("x", SetPosition(position=1.0))
                fill(disk)  # what it has removed has made room
            else:
                await rig.client.command("x", Power(on=False))
            await asyncio.sleep(15.0)  # virtual: until it has tried to keep it
            await rig.kill()
        async with rig_on(chain, config) as rig:
            state, said = await up(rig, "x"), await refusals(rig)
            # a reference that was refused is not looked at again
            await rig.kill()
        async with rig_on(chain, config) as rig:
            await up(rig, "x")
            again = await refusals(rig)

    assert not state.referenced
    assert [each for each in said if "did not get onto the disk" not in each] == []
    assert len(said) == 1
    assert "another program" not in said[0]
    assert "no daemon watched" not in said[0]
    assert again == []


@pytest.mark.parametrize("kill", [False, True])
async def test_a_disk_that_was_full_for_a_while_costs_no_reference(tmp_path, kill):
    with small_disk(tmp_path / "state", 256 * 1024) as disk:
        chain, config = chain_of(), keeping(disk)
        async with rig_on(chain, config) as rig:
            await set_out(rig)
            await asyncio.sleep(2.0)
            fill(disk)
            await ended(rig, "x", MoveAbsolute(position=12.0))
            await asyncio.sleep(2.0)
            (disk / "ballast").unlink()
            await asyncio.sleep(12.0)  # virtual: it is tried again every 10 s
            if kill:
                await rig.kill()
        async with rig_on(chain, config) as rig:
            state, said = await up(rig, "x"), await refusals(rig)
            there = await position_of(rig)

    assert state.referenced
    assert said == [""]
    assert there.value == pytest.approx(12.0, abs=0.05)


@pytest.mark.promise("kept-reference")
@pytest.mark.long
async def test_where_neither_disk_nor_drive_can_forget_a_reference_there_is_no_other(tmp_path, monkeypatch):
    def read_only(path: Path, *_text: str) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig, position=7.0)
        drive(chain, 1).loop.home = drive(chain, 1).loop.position  # it stands on its mark to the count
        await asyncio.sleep(15.0)
        monkeypatch.setattr(durable, "replace", read_only)
        monkeypatch.setattr(durable, "remove", read_only)

        for command in (SetPosition(position=-5.0), Home(method="index", velocity=0.5)):
            with pytest.raises(WrongState, match="the reference that is kept cannot be removed: Read-only file system"):
                await rig.client.command("x", command)
        await ended(rig, "x", MoveAbsolute(position=41.0))
        assert (await position_of(rig)).value == pytest.approx(41.0, abs=0.01)


@pytest.mark.long
async def test_a_disk_that_does_not_answer_holds_up_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(asyncio.get_running_loop().__class__, "run_in_executor", _never)
    chain = chain_of()
    async with rig_on(chain, keeping(tmp_path)) as rig:
        await up(rig, "x")
        await rig.client.command("x", Power(on=True))
        for position in (0.0, 10.0):
            await rig.client.command("x", SetPosition(position=position))
            await ended(rig, "x", MoveAbsolute(position=5.0))
            assert (await position_of(rig)).value == pytest.approx(5.0, abs=0.01)
            await asyncio.sleep(5.0)
            await ended(rig, "x", MoveRelative(distance=1.0))


def _never(loop: asyncio.AbstractEventLoop, *_work: object) -> asyncio.Future[None]:
    return loop.create_future()


# -- faults ------------------------


@pytest.mark.long
async def test_faults_outlive_the_daemon(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await set_out(rig)
        drive(chain, 1).loop.open()  # as after an excess position error
        await rig.until("x", lambda state: state.state == "error_stop")
        await asyncio.sleep(1.0)
        first = next(info for info in await rig.client.axes() if info.axis == "x").past_faults
    async with rig_on(chain, config) as rig:
        await up(rig, "x")
        await asyncio.sleep(0.1)
        kept = next(info for info in await rig.client.axes() if info.axis == "x").past_faults

    assert [fault.code for fault in first] == ["position_error"]
    assert kept[: len(first)] == first


# -- killed at any instant ------------------------------------------------


async def _random_step(rig: ChainRig, chain: Chain, dice: random.Random, origins: list[float]) -> None:
    """Do something with x; `origins` are the places of 0 on its counter, in mm, that it may have been told."""
    state = await rig.client.state("x")
    assert state is not None
    if state.state == "error_stop":
        await rig.client.command("x", Reset())
    if not state.enabled:
        await rig.client.command("x", Power(on=True))
    if not state.referenced or dice.random() < 0.3:
        told = dice.uniform(-50.0, 50.0)
        here = drive(chain, 1).loop.position / COUNTS
        origins.append(here - told)
        try:
            await rig.client.command("x", SetPosition(position=told))
        except RequestRefused:
            origins.pop()
            raise
        del origins[:-1]
    await asyncio.sleep(dice.choice((0.0, 0.3, 0.7, 2.0)))
    reply = await rig.client.command("x", MoveRelative(distance=dice.uniform(-9.0, 10.0)))
    if dice.random() < 0.2:
        await rig.client.command("x", Halt())
    elif dice.random() < 0.2:
        await rig.client.command("x", Power(on=False))
    else:
        await rig.client.wait_for_end("x", reply.command_id)
    await asyncio.sleep(dice.choice((0.0, 0.3, 0.7, 2.0)))


async def _live(rig: ChainRig, chain: Chain, dice: random.Random, origins: list[float]) -> None:
    while True:
        await asyncio.sleep(0.05)  # a refusal takes no virtual time
        with contextlib.suppress(LdcndError):
            await _random_step(rig, chain, dice, origins)


@pytest.mark.parametrize(("lives", "seed"), [(12, 5), pytest.param(500, 7, marks=pytest.mark.soak)])
@pytest.mark.long
async def test_whenever_a_daemon_is_killed_no_reference_that_is_believed_is_wrong(tmp_path, lives, seed):
    dice = random.Random(seed)
    chain, config = chain_of(), keeping(tmp_path)
    origins: list[float] = []
    kept = refused = 0
    for _ in range(lives):
        async with rig_on(chain, config) as rig:
            state = await up(rig, "x")
            if state.referenced:
                kept += 1
                sample = await position_of(rig)
                believed = sample.counts / COUNTS - sample.value
                assert min(abs(believed - origin) for origin in origins) < 0.05, (believed, origins)
                origins = [origin for origin in origins if abs(believed - origin) < 0.05]
            else:
                refused += 1
            living = asyncio.create_task(_live(rig, chain, dice, origins), name="living")
            await asyncio.sleep(dice.uniform(0.0, 6.0))
            await rig.kill()
            living.cancel()
            await asyncio.wait([living])
        await asyncio.sleep(dice.choice((0.0, 1.0)))

    print(f"{lives} lives: reference kept {kept} times, refused or not kept {refused} times, wrong never")
    assert kept > lives / 10


@pytest.mark.promise("stop-until-confirmed")
async def test_a_stop_waits_for_no_disk_that_hangs_while_references_are_recalled(tmp_path, monkeypatch):
    """Nor does an axis wait for those behind it; where one is is told, and it moves, once that is judged."""
    reading = asyncio.Event()

    async def hangs(*_args: object) -> None:
        reading.set()
        await asyncio.sleep(DISK_TIME_S)  # virtual
        raise TimeoutError

    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await up(rig, "x")
        await rig.client.command("x", Power(on=True))
        await rig.client.command("x", MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.3)
        await rig.kill()
    monkeypatch.setattr(KeptFiles, "reference", hangs)
    async with rig_on(chain, config, up=False) as rig:
        await reading.wait()
        await rig.client.stop("x")
        await asyncio.sleep(0.5)  # it brakes in a tenth of that
        stopped_at = drive(chain, 1).shaft.position_counts
        with pytest.raises(AxisUnreachable):
            await rig.client.command("y", Power(on=True))
        shown = [await rig.client.last("x", TelemetryItem.POSITION), drive(chain, 1).loop.servo_on]
        await up(rig, "x")
        others = rig.line.problem
        await rig.daemon.wait_up()
        state = await up(rig, "x")
        went_on = drive(chain, 1).shaft.position_counts - stopped_at

    assert abs(went_on) < 20  # a closed loop hunts
    assert shown == [None, True]
    assert "being read" in others
    assert (state.stop_latched, state.referenced) == (True, False)
