"""What forbids an axis to move until it is reset outlasts the daemon, however that ends, on drives that outlive it."""

import asyncio
import json
import os
import shutil
import time
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from ldcnd import durable
from ldcnd.axis import kept as kept_files
from ldcnd.axis.kept import LATCH_ROOM_BYTES, LATCHES
from ldcnd.client.fleet import survey
from ldcnd.config.rig import RigConfig, single_line
from ldcnd.contract.commands import Halt, MoveRelative, MoveVelocity, Power, QuickStop, Reset
from ldcnd.contract.errors import OutcomeUnknown, RequestRefused, WrongState
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.daemon.service import describe
from ldcnd.drives.ldcn.config import ModuleConfig
from ldcnd.durable import DISK_TIME_S
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.power import FaultCondition
from tests.integration.test_kept_references import chain_of, keeping
from tests.support.chain_rig import ChainRig, drive, rig_on
from tests.support.small_disk import fill, small_disk

pytestmark = pytest.mark.promise("latch-outlasts-daemon")
AXES = ("x", "y", "z", "c")
HUNTS = 20
"""Counts that a closed loop at rest goes; the motions here are of 5000 counts/s."""


async def up(rig: ChainRig, axis: str = "x") -> None:
    await rig.until(
        axis, lambda state: state.link is LinkState.UP and (state.moving != "unknown" or state.motion_hidden_by)
    )


async def jogging(rig: ChainRig, axis: str = "x") -> None:
    await up(rig, axis)
    await rig.client.command(axis, Power(on=True))
    await rig.client.command(axis, MoveVelocity(velocity=5.0))
    await asyncio.sleep(0.3)


async def end(rig: ChainRig, how: str) -> None:
    if how == "SIGKILL":
        await rig.kill()
    else:
        rig.daemon.end()
        await asyncio.wait([rig.running])


async def refused_motion(rig: ChainRig, axis: str = "x") -> list[str]:
    """Return with what everything that could begin a motion is refused; the axis stays where it is."""
    before = shown(rig, axis)
    codes = []
    for command in (Power(on=True), MoveRelative(distance=1.0), MoveVelocity(velocity=1.0)):
        with pytest.raises(RequestRefused) as refused:
            await rig.client.command(axis, command)
        codes.append(refused.value.code.value)
    await asyncio.sleep(0.5)
    assert abs(shown(rig, axis) - before) < HUNTS
    return codes


def shown(rig: ChainRig, axis: str) -> float:
    reading = rig.daemon.rig.axes[axis].tracker.reading
    assert reading
    return reading.position_counts


async def settled(rig: ChainRig, axis: str = "x") -> None:
    await rig.until(axis, lambda state: state.moving == "no" and not state.stop_pending)


@pytest.mark.parametrize("start", ["adopt", "reset"])
@pytest.mark.parametrize("how", ["SIGKILL", "SIGTERM"])
@pytest.mark.parametrize("scope", ["axis", "rig", "quick_stop"])
@pytest.mark.sweep(5)
async def test_a_latched_stop_forbids_motion_in_the_next_daemon_until_reset(tmp_path, how, scope, start):
    chain, config = chain_of(), keeping(tmp_path, start=start)
    async with rig_on(chain, config) as rig:
        await jogging(rig)
        if scope == "quick_stop":
            await rig.client.command("x", QuickStop())
        else:
            reply = await rig.client.stop("x" if scope == "axis" else None)
            assert set(reply.kept) == set(reply.axes) == set(reply.confirmed)
        await end(rig, how)
    async with rig_on(chain, config) as rig:
        await up(rig)
        await settled(rig)
        latched = [axis for axis in AXES if (await rig.client.state(axis)).stop_latched]
        codes = await refused_motion(rig)
        await rig.client.command("x", Reset())
        await rig.client.command("x", Power(on=True))
        await end(rig, how)
    async with rig_on(chain, config) as rig:
        await up(rig)
        state = await rig.client.state("x")

    assert latched == (list(AXES) if scope == "rig" else ["x"])
    assert codes == ["stop_latched"] * 3
    assert not state.stop_latched


@pytest.mark.parametrize("latches", [True, False], ids=["stop", "halt"])
async def test_a_daemon_killed_before_the_drive_was_sent_the_stop_is_followed_by_one_that_stops_it(tmp_path, latches):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await jogging(rig)
        chain.injector = FaultInjector(FaultPlan((LineFault(FaultKind.REQUEST_LOST, 1.0),)))
        if latches:
            reply = await rig.client.stop("x")
            assert (reply.confirmed, reply.kept) == ((), ("x",))
        else:
            with pytest.raises(OutcomeUnknown):
                await rig.client.command("x", Halt())
            await asyncio.sleep(0.2)
        await rig.kill()
    chain.injector = FaultInjector(FaultPlan())
    async with rig_on(chain, config) as rig:
        await up(rig)
        await settled(rig)
        before = drive(chain, 1).shaft.position_counts
        await asyncio.sleep(1.0)
        state = await rig.client.state("x")

    assert drive(chain, 1).shaft.position_counts == pytest.approx(before, abs=HUNTS)
    assert (state.stop_latched, state.stop_pending) == (latches, False)


@pytest.mark.parametrize("start", ["adopt", "reset"])
@pytest.mark.parametrize("how", ["SIGKILL", "SIGTERM"])
@pytest.mark.sweep(2)
async def test_an_axis_in_error_stop_is_in_error_stop_in_the_next_daemon_with_its_cause(tmp_path, how, start):
    chain, config = chain_of(), keeping(tmp_path, start=start)
    async with rig_on(chain, config) as rig:
        await jogging(rig)
        now_s = asyncio.get_running_loop().time()
        drive(chain, 1).set_condition(FaultCondition.STALLED, present=True, at_s=now_s)
        await rig.until("x", lambda state: state.state is AxisState.ERROR_STOP)
        first = rig.daemon.rig.axes["x"].tracker.status.first_fault
        await asyncio.sleep(0.2)
        await end(rig, how)
    drive(chain, 1).set_condition(FaultCondition.STALLED, present=False, at_s=asyncio.get_running_loop().time())
    async with rig_on(chain, config) as rig:
        await up(rig)
        state, fault = await rig.client.state("x"), await rig.client.last("x", "fault")
        with pytest.raises(WrongState, match="error stop"):
            await rig.client.command("x", Power(on=True))
        await rig.client.command("x", Reset())
        await rig.client.command("x", Power(on=True))
        await end(rig, how)
    async with rig_on(chain, config) as rig:
        await up(rig)
        after = await rig.client.state("x")

    assert state.state is AxisState.ERROR_STOP
    assert first
    assert fault.first == first
    assert after.state is not AxisState.ERROR_STOP


@pytest.mark.parametrize("content", [b"", b"\0" * 40, b"{", b'{"format": 2, "axes": {}}', b"\xff", "folder"])
@pytest.mark.sweep(2)
async def test_a_file_that_cannot_be_read_latches_every_axis_and_says_so_in_one_line(tmp_path, content):
    path = tmp_path / "latches.json"
    path.mkdir() if content == "folder" else path.write_bytes(content)
    chain, config = chain_of(), keeping(tmp_path)
    with capture_logs() as logs:
        async with rig_on(chain, config) as rig:
            await up(rig)
            await settled(rig)
            latched = [axis for axis in AXES if (await rig.client.state(axis)).stop_latched]
            codes = await refused_motion(rig)

    said = [line for line in logs if "kept latches" in line["event"]]
    assert latched == list(AXES)
    assert codes == ["stop_latched"] * 3
    assert [line["log_level"] for line in said] == ["error"]
    assert str(path) in said[0]["reason"]
    assert "\n" not in said[0]["reason"]


async def test_what_was_latched_because_of_a_damaged_file_is_over_once_it_was_reset(tmp_path):
    (tmp_path / "latches.json").write_text("?")
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await up(rig)
        await settled(rig)
        await rig.client.command("x", Reset())
        await asyncio.sleep(0.5)
        await rig.kill()
    async with rig_on(chain, config) as rig:
        await up(rig)
        latched = [axis for axis in AXES if (await rig.client.state(axis)).stop_latched]

    assert latched == ["y", "z", "c"]


async def test_a_backup_of_before_a_stop_that_is_put_back_lets_no_axis_move(tmp_path):
    chain, kept = chain_of(), tmp_path / "state"
    config = keeping(kept)
    async with rig_on(chain, config) as rig:
        await up(rig)
        await settled(rig)
    await asyncio.to_thread(shutil.copytree, kept, tmp_path / "backup")
    async with rig_on(chain, config) as rig:
        await up(rig)
        before = await rig.client.state("x")
        await rig.client.stop()
    await asyncio.to_thread(time.sleep, DISK_TIME_S + 0.5)  # the disk has the clock of the machine
    await asyncio.to_thread(shutil.rmtree, kept)
    await asyncio.to_thread(shutil.copytree, tmp_path / "backup", kept)
    async with rig_on(chain, config) as rig:
        await up(rig)
        codes = await refused_motion(rig)

    assert not before.stop_latched
    assert codes == ["stop_latched"] * 3


async def test_without_a_place_for_it_the_answer_says_that_the_latch_ends_with_the_daemon(tmp_path):
    chain = chain_of()
    config = keeping(tmp_path).model_copy(update={"state_dir": None})
    async with rig_on(chain, config) as rig:
        await up(rig)
        reply = await rig.client.stop()
        await rig.kill()
    async with rig_on(chain, config) as rig:
        await up(rig)
        state = await rig.client.state("x")

    assert (set(reply.confirmed), reply.kept) == (set(AXES), ())
    assert not state.stop_latched


async def has_kept_room(disk: Path) -> None:
    """Wait until a thread of the daemon, which no clock of a test holds back, has kept room for the next latches."""
    draft = disk / f"{LATCHES}.new"
    while not draft.exists() or draft.stat().st_size < LATCH_ROOM_BYTES:
        await asyncio.to_thread(time.sleep, 0.01)


async def test_a_stop_on_a_full_disk_outlasts_a_killed_daemon(tmp_path):
    """Nothing else is kept there then; what is not is said in the health report."""
    with small_disk(tmp_path / "state", 256 * 1024) as disk:
        chain, config = chain_of(), keeping(disk)
        async with rig_on(chain, config) as rig:
            await jogging(rig)
            await has_kept_room(disk)
            fill(disk)
            replies = [await rig.client.stop(axis) for axis in ("x", "y")]
            await settled(rig)
            await rig.kill()
        async with rig_on(chain, config) as rig:
            await up(rig)
            latched = [await refused_motion(rig, axis) for axis in ("x", "y")]

    assert [(reply.kept, reply.warning) for reply in replies] == [(("x",), ""), (("y",), "")]
    assert latched == [["stop_latched"] * 3] * 2


@pytest.mark.long
async def test_a_disk_that_fails_delays_no_stop_and_the_answer_says_so(tmp_path, monkeypatch):
    def fails(path: Path, text: str) -> None:
        raise OSError(28, os.strerror(28))

    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await jogging(rig)
        monkeypatch.setattr(durable, "replace", fails)
        with capture_logs() as logs:
            reply = await rig.client.stop("x")
            await rig.client.stop("x")
        await asyncio.sleep(2.0)  # virtual: until the next report
        status, (report,) = describe(rig.daemon.rig), await survey(rig.session)
        monkeypatch.undo()
        await asyncio.sleep(20.0)  # virtual: it is tried again
        later = describe(rig.daemon.rig)
        await rig.kill()
    async with rig_on(chain, config) as rig:
        await up(rig)
        state = await rig.client.state("x")

    assert (reply.confirmed, reply.kept) == (("x",), ())
    assert len([line for line in logs if line["event"] == "not kept on disk" and line["file"] == "latches.json"]) == 1
    assert state.stop_latched
    told = "not kept over a restart, latches.json: No space left on device"
    assert [told in said for said in (status, " ".join(report.problems), later)] == [True, True, False]


async def test_a_disk_that_hangs_delays_the_answer_by_a_bounded_time_and_the_packet_by_none(tmp_path, monkeypatch):
    hangs = asyncio.Event()

    async def keep(*_args: object) -> None:
        await hangs.wait()

    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await jogging(rig)
        monkeypatch.setattr(kept_files.KeptFiles, "keep_latches", keep)
        stop = asyncio.create_task(rig.client.stop("x"))
        await asyncio.sleep(0.1)
        confirmed = not rig.daemon.rig.axes["x"].tracker.status.stop
        async with asyncio.timeout(1.0):
            reply = await stop
        hangs.set()

    assert confirmed
    assert (reply.confirmed, reply.kept) == (("x",), ())


async def test_an_axis_that_is_not_configured_for_a_while_is_latched_when_it_is_back(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    (bus,) = config.bus
    no_axis = ModuleConfig(address=4, model="pic-servo-v4")
    changes = {"axis": bus.axis[:3], "module": (no_axis,), "group": ()}
    fewer = config.model_copy(update={"bus": (bus.model_copy(update=changes),)})
    async with rig_on(chain, config) as rig:
        await up(rig)
        await rig.client.stop("c")
    async with rig_on(chain_of(), fewer) as rig:
        await up(rig)
        await rig.client.stop("x")
        await rig.client.command("x", Reset())
    async with rig_on(chain, config) as rig:
        await up(rig)
        latched = [axis for axis in AXES if (await rig.client.state(axis)).stop_latched]

    assert latched == ["c"]


def renamed(config: RigConfig, **names: str) -> RigConfig:
    """Return a configuration whose axes of the first line have other names."""
    line = config.bus[0]
    axes = tuple(axis.model_copy(update={"name": names.get(axis.name, axis.name)}) for axis in line.axis)
    groups = {"group": ()} if hasattr(line, "group") else {}
    return config.model_copy(update={"bus": (line.model_copy(update={"axis": axes, **groups}), *config.bus[1:])})


@pytest.mark.parametrize(
    ("names", "latched"), [({"x": "gantry"}, ["gantry"]), ({"x": "y", "y": "x"}, ["x", "y"])], ids=["new", "exchanged"]
)
@pytest.mark.sweep(1)
async def test_a_drive_that_has_another_name_by_now_is_latched(tmp_path, names, latched):
    """The file cannot say of it whether it was stopped: a name is not a drive."""
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await rig.client.stop("x")
    async with rig_on(chain, renamed(config, **names)) as rig:
        await up(rig, latched[0])
        found = [axis for axis in sorted(rig.daemon.rig.axes) if (await rig.client.state(axis)).stop_latched]
        for axis in latched:
            await rig.client.command(axis, Reset())
    async with rig_on(chain, renamed(config, **names)) as rig:
        await up(rig, latched[0])
        after = [axis for axis in sorted(rig.daemon.rig.axes) if (await rig.client.state(axis)).stop_latched]

    assert (found, after) == (latched, [])


async def test_a_stop_is_not_lost_on_the_way_to_a_line_of_its_own_and_back(tmp_path):
    """As INSTALL.md has it: one process for a line of the rig, then one for all of them again."""
    chain, config = chain_of(), keeping(tmp_path)
    alone = single_line(config, config.bus[0].name)
    latched = list[list[str]]()
    for daemon, stops in ((config, True), (alone, False), (alone, True), (config, False), (config, False)):
        async with rig_on(chain, daemon) as rig:
            await up(rig)
            latched.append([axis for axis in AXES if (await rig.client.state(axis)).stop_latched])
            for axis in latched[-1]:
                await rig.client.command(axis, Reset())
            if stops:
                await rig.client.stop("x")

    assert latched == [[], list(AXES), [], list(AXES), []]


async def test_a_stop_is_not_lost_on_the_way_back_from_a_line_of_its_own_whose_clock_was_behind(tmp_path):
    """A machine without a clock of its own begins where it was written down last."""
    chain, config = chain_of(), keeping(tmp_path)
    alone = single_line(config, config.bus[0].name)
    async with rig_on(chain, config) as rig:
        await up(rig)
    async with rig_on(chain, alone) as rig:
        await up(rig)
        for axis in AXES:
            await rig.client.command(axis, Reset())
        await rig.client.stop("x")
    kept = alone.state_dir / "latches.json"
    written = json.loads(kept.read_text())
    kept.write_text(json.dumps(written | {"on_disk": written["on_disk"] - 3600 * 10**9}))
    async with rig_on(chain, config) as rig:
        await up(rig)
        state = await rig.client.state("x")

    assert state.stop_latched


async def test_rigs_in_folders_of_each_other_do_not_latch_each_other(tmp_path):
    """As INSTALL.md lays them out: the file of the second is made from that of the first, and has its names."""
    lab = keeping(tmp_path).model_copy(update={"rig": "lab"})
    other = keeping(tmp_path / "two").model_copy(update={"rig": "lab_2"})
    latched = list[bool]()
    for config in (lab, other, lab, other):
        async with rig_on(chain_of(), config) as rig:
            await up(rig)
            latched.append((await rig.client.state("x")).stop_latched)
            await rig.client.stop("x")
            await settled(rig)
            await rig.client.command("x", Reset())

    assert latched == [False] * 4
