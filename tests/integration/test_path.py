"""Several PIC-SERVO SC on one polyline: how near they stay, and that whatever ends one of them ends all."""

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from itertools import count, pairwise
from types import MappingProxyType
from typing import Any

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import (
    BufferMode,
    Direction,
    Halt,
    MoveAbsolute,
    MoveRelative,
    Power,
    Reset,
    Stop,
)
from ldcnd.contract.errors import (
    CommandAborted,
    CommandExpired,
    CommandIdReused,
    NotSupported,
    PositionLimit,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.leases import Acquire, Release
from ldcnd.contract.rig_commands import AxisPath, PathReply, SetSpeedOverride, WalkPath
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.drives.driver import PathStatus, StopMode
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain, model
from ldcnd.sim.plant import MotorPlant
from tests.support.chain_rig import ChainRig, drive, rig_on, simulated_config
from tests.support.command_line import virtual_rig
from tests.support.rig import EPOCH_NS

NAMES = ("z", "c")
GAINS = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "cl": 0, "el": 4000, "sr": 1, "deadband": 0}
AXIS = {
    "gains": GAINS,
    "unit": "mm",
    "counts_per_unit": 1000,
    "velocity": 30.0,
    "acceleration": 100.0,
    "limits": {"position_min": -50.0, "position_max": 50.0, "velocity": 60.0, "acceleration": 200.0},
    "reference": "at_reset",
    "model": "pic-servo-sc",
}
TRIANGLE = {"z": (20.0, 20.0, 0.0), "c": (0.0, 15.0, 0.0)}
CIRCLE = {
    "z": tuple(10.0 - 10.0 * math.cos(math.tau * at / 72) for at in range(1, 73)),
    "c": tuple(10.0 * math.sin(math.tau * at / 72) for at in range(1, 73)),
}


def sc_chain() -> Chain:
    return build_chain(ChainSpec(tuple(ModuleSpec("picservo-sc") for _ in range(2))))


def plane(
    *,
    leased: bool = False,
    turning: float | None = None,
    baud: int = 115_200,
    axis: Mapping[str, object] = MappingProxyType({}),
    **group: object,
) -> RigConfig:
    """Return the configuration of two PIC-SERVO SC of one group; `turning` is the modulo of the second."""
    config = simulated_config(group=[{"name": "plane", "axes": list(NAMES), **group}])
    document = config.model_dump(mode="json", exclude_unset=True)
    table = document["bus"][0]
    table["baud"] = baud
    table["axis"] = [{"name": name, "address": at + 1, **AXIS, **axis} for at, name in enumerate(NAMES)]
    if turning:
        table["axis"][1] |= {"modulo": turning, "limits": {}}
    for key in ("module", "simulate", "fault"):
        table.pop(key, None)
    document["authority"] = "leased" if leased else "open"
    return type(config).model_validate(document)


@asynccontextmanager
async def two_sc(chain: Chain, *, leased: bool = False, **settings: Any) -> AsyncIterator[ChainRig]:
    """Run a daemon on such a plane, with closed loops."""
    config = plane(leased=leased, **settings)
    async with rig_on(chain, config) as rig:
        lease = await rig.client.ask(Acquire(client="set-up", axes=NAMES, lease_s=30.0)) if leased else None
        for name in NAMES:
            await rig.until(name, lambda state: state.link is LinkState.UP)
            await rig.client.command(name, Power(on=True, lease=lease.lease if lease else None))
        if lease:
            await rig.client.ask(Release(lease=lease.lease))
        yield rig


def path(corners: dict[str, tuple[float, ...]] = TRIANGLE, **values: object) -> WalkPath:
    moves = tuple(AxisPath(axis=name, via=each[:-1], position=each[-1]) for name, each in corners.items())
    return WalkPath(moves=moves, **values)


def from_polyline(point: tuple[float, float], corners: list[tuple[float, float]]) -> float:
    nearest = math.inf
    for (ax, ay), (bx, by) in pairwise(corners):
        length = math.hypot(bx - ax, by - ay)
        share = ((point[0] - ax) * (bx - ax) + (point[1] - ay) * (by - ay)) / length**2
        share = min(1.0, max(0.0, share))
        nearest = min(nearest, math.dist(point, (ax + share * (bx - ax), ay + share * (by - ay))))
    return nearest


def places(chain: Chain) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return where the drives command their motors to be, and where those are, mm."""
    drives = [drive(chain, 1), drive(chain, 2)]
    z, c = (each.loop.trajectory.position / 65536 / 1000 for each in drives)
    at_z, at_c = (each.shaft.position_counts / 1000 for each in drives)
    return (z, c), (at_z, at_c)


async def rests(chain: Chain, for_s: float = 0.5) -> bool:
    _, before = places(chain)
    await asyncio.sleep(for_s)
    return math.dist(before, places(chain)[1]) < 0.02


async def test_a_path_goes_through_however_long_the_proof_takes_that_its_drives_have_begun(monkeypatch):
    chain = sc_chain()
    async with two_sc(chain) as rig:
        network = rig.line.network
        start = network.start_path

        async def start_and_prove(*given: Any) -> None:
            await start(*given)
            await asyncio.sleep(0.2)  # as with lost replies, or with many members on a slow line

        monkeypatch.setattr(network, "start_path", start_and_prove)
        said = await rig.client.ask(path(speed=8.0))
        states = [await rig.client.wait_for_end(each.axis, each.command_id) for each in said.replies]

    assert [state.last_error for state in states] == [None, None]


@pytest.mark.parametrize("side", [1, -1])
async def test_a_path_does_not_lead_beyond_the_counter_of_a_drive(side, monkeypatch):
    """A rotary axis turns on for ever; its drive counts to 2,147,483,647, here to 15,000."""
    monkeypatch.setattr("ldcnd.drives.ldcn.servo.LARGEST_COUNT", 15_000)
    chain = sc_chain()
    async with two_sc(chain, turning=10.0) as rig:
        for distance in (9.0, 3.0):
            moved = await rig.client.command("c", MoveRelative(distance=side * distance))
            await rig.client.wait_for_end("c", moved.command_id)
        said = await rig.client.ask(path({"z": (3.0, 5.0), "c": (side * 6.0, side * 9.0)}, speed=8.0))
        states = [await rig.client.wait_for_end(each.axis, each.command_id) for each in said.replies]
        one = drive(chain, 2)

    assert [(state.last_error, state.referenced) for state in states] == [(None, True)] * 2
    assert one.shaft.position_counts == pytest.approx(side * 19_000.0, abs=60.0)
    assert abs(one.loop.position) < 15_000


@pytest.mark.parametrize("from_mm", [1.0, 9.0], ids=["behind its place", "ahead of it"])
async def test_a_path_leads_onto_a_switch_and_away_from_one_on_whichever_side_friction_holds_the_shaft(from_mm):
    plant = MotorPlant(friction_nm=0.05, forward_limit_counts=19_000)
    settings = model("picservo-sc")[1]
    chain = build_chain(ChainSpec(tuple(ModuleSpec("picservo-sc", plant, settings) for _ in range(2))))
    stiff = {"limit_switches": "stop", "gains": GAINS | {"ki": 0, "il": 0}}
    async with two_sc(chain, axis=stiff) as rig:
        for place in (from_mm, 5.0):
            moved = [await rig.client.command(name, MoveAbsolute(position=place)) for name in NAMES]
            for name, each in zip(NAMES, moved, strict=True):
                await rig.client.wait_for_end(name, each.command_id)
        (commanded, _), (stands, _) = places(chain)
        drive(chain, 2).shaft.reverse_stuck = True
        said = await rig.client.ask(path({"z": (18.0, 20.0), "c": (6.0, 7.0)}, speed=8.0))
        states = [await rig.client.wait_for_end(each.axis, each.command_id) for each in said.replies]

    assert (commanded > stands) is (from_mm < 5.0)
    assert [state.last_error for state in states] == [None, None]


@pytest.mark.parametrize(("speed", "corners"), [(8.0, TRIANGLE), (15.0, TRIANGLE), (40.0, TRIANGLE), (15.0, CIRCLE)])
@pytest.mark.sweep(2)
async def test_axes_on_a_path_stay_as_near_to_it_as_was_said_before(speed, corners):
    chain = sc_chain()
    async with two_sc(chain) as rig:
        said = await rig.client.ask(path(corners, speed=speed))
        assert isinstance(said, PathReply)
        loop = asyncio.get_running_loop()
        until_s, line = loop.time() + said.duration_s, [(0.0, 0.0), *zip(corners["z"], corners["c"], strict=True)]
        commanded = moved = 0.0
        while loop.time() < until_s:
            await asyncio.sleep(0.02)
            wanted, shafts = places(chain)
            commanded, moved = max(commanded, from_polyline(wanted, line)), max(moved, from_polyline(shafts, line))
        states = [await rig.client.wait_for_end(each.axis, each.command_id) for each in said.replies]

    print(f"{speed} mm/s: {said.duration_s:.2f} s, {said.deviation:.4f}, {commanded:.4f}, {moved:.4f} mm")
    assert commanded <= said.deviation + 0.001
    assert [state.last_error for state in states] == [None, None]
    assert [state.state for state in states] == [AxisState.STANDSTILL] * 2
    assert math.dist(places(chain)[1], (corners["z"][-1], corners["c"][-1])) < 0.05


@pytest.mark.parametrize("leader", NAMES)
@pytest.mark.sweep(2)
async def test_a_group_whose_leader_answers_for_it_walks_a_path_too(leader):
    chain = sc_chain()
    async with two_sc(chain, leader=leader) as rig:
        said = await rig.client.ask(path(speed=15.0))
        states = [await rig.client.wait_for_end(each.axis, each.command_id) for each in said.replies]

    assert [state.last_error for state in states] == [None, None]
    assert math.dist(places(chain)[1], (TRIANGLE["z"][-1], TRIANGLE["c"][-1])) < 0.05


async def test_the_speed_override_scales_the_speed_along_a_path():
    chain = sc_chain()
    async with two_sc(chain) as rig:
        await rig.client.ask(SetSpeedOverride(percent=25.0))
        slowed = await rig.client.ask(path(speed=8.0))
        for each in slowed.replies:
            await rig.client.wait_for_end(each.axis, each.command_id)
        await rig.client.ask(SetSpeedOverride(percent=100.0))
        asked = await rig.client.ask(path(speed=2.0))

    assert slowed.duration_s == pytest.approx(asked.duration_s, rel=0.05)


@pytest.mark.promise("path-checked-whole")
async def test_a_path_beyond_a_limit_or_too_far_from_its_line_moves_nothing():
    chain = sc_chain()
    async with two_sc(chain) as rig:
        with pytest.raises(PositionLimit):
            await rig.client.ask(path({"z": (20.0, 60.0, 0.0), "c": (0.0, 5.0, 0.0)}))
        with pytest.raises(ValueOutOfRange):
            await rig.client.ask(path(max_deviation=1e-4))
        assert await rests(chain)
        assert places(chain)[1] == pytest.approx((0.0, 0.0), abs=0.02)
        for name in NAMES:
            state = await rig.client.state(name)
            assert state is not None
            assert state.state is AxisState.STANDSTILL


async def test_a_path_that_is_sent_again_is_answered_alike_and_walked_once():
    chain, ids = sc_chain(), {"z": "one", "c": "two"}
    async with two_sc(chain) as rig:
        request = path(speed=30.0)
        request = request.model_copy(
            update={"moves": tuple(move.model_copy(update={"command_id": ids[move.axis]}) for move in request.moves)}
        )
        first = await rig.client.ask(request)
        again = await rig.client.ask(request)
        with pytest.raises(CommandIdReused):
            await rig.client.ask(request.model_copy(update={"speed": 10.0}))
        ended = [await rig.client.wait_for_end(name, command_id) for name, command_id in ids.items()]
        late = await rig.client.ask(request)
        rested = await rests(chain)

    assert again == late == first
    assert [state.last_error for state in ended] == [None, None]
    assert rested


async def halt_one(rig: ChainRig, _chain: Chain) -> None:
    await rig.client.command("c", Halt())


async def stop_one(rig: ChainRig, _chain: Chain) -> None:
    await rig.client.command("z", Stop())


async def trip(_rig: ChainRig, chain: Chain) -> None:
    drive(chain, 2).loop.open()


async def underrun(_rig: ChainRig, chain: Chain) -> None:
    drive(chain, 1).loop.trajectory.path._points.clear()


@pytest.mark.promise("path-checked-whole")
@pytest.mark.parametrize("what", [halt_one, stop_one, trip, underrun])
@pytest.mark.parametrize("after_s", [0.3, 1.7])
@pytest.mark.sweep(2)
async def test_whatever_ends_one_axis_of_a_path_ends_all(what: Callable[[ChainRig, Chain], Awaitable[None]], after_s):
    chain = sc_chain()
    async with two_sc(chain) as rig:
        await rig.client.ask(path(speed=15.0))
        await asyncio.sleep(after_s)

        await what(rig, chain)
        await asyncio.sleep(1.0)
        still = await rests(chain)
        states = [await rig.client.state(name) for name in NAMES]

    assert still
    assert what is not trip or not drive(chain, 2).loop.servo_on
    assert math.dist(places(chain)[1], (0.0, 0.0)) > 0.1
    assert all(state is not None and state.command is None for state in states)


def stands_still(monkeypatch: pytest.MonkeyPatch, behind: int, for_s: float) -> None:
    """Have the machine stand still behind one reply that shows what a drive holds of a path, while the drives walk."""
    look, number, loop = LdcnAxis.path_status, count(), asyncio.get_running_loop()

    async def look_late(axis: LdcnAxis) -> PathStatus:
        status = await look(axis)
        if next(number) == behind:
            loop.hold_up(for_s)  # type: ignore[attr-defined] # of a jumping loop
        return status

    monkeypatch.setattr(LdcnAxis, "path_status", look_late)


@pytest.mark.parametrize("behind", range(0, 12, 2))
@pytest.mark.sweep(2)
async def test_a_path_goes_on_behind_a_pause_in_which_its_drives_had_points_enough(behind, monkeypatch):
    """What they held before it was compared with what they were to hold behind it."""
    async with two_sc(sc_chain()) as rig:
        said = await rig.client.ask(path(speed=15.0))
        await asyncio.sleep(0.3)
        stands_still(monkeypatch, behind, 0.2)
        states = [await rig.client.wait_for_end(each.axis, each.command_id) for each in said.replies]

    assert [state.last_error for state in states] == [None, None]


@pytest.mark.parametrize("behind", [None, 0, 1, 4, 5])
@pytest.mark.sweep(2)
async def test_a_path_that_ran_dry_in_a_pause_leaves_no_points_to_drives_that_keep_them(behind, monkeypatch):
    """They were sent some more before anybody looked, and no path begins behind those until the drive is restarted."""
    module = ModuleSpec("picservo-sc", adjust=lambda each: each.model_copy(update={"path_cleared_by_stop": False}))
    async with two_sc(build_chain(ChainSpec((module, module)))) as rig:
        said = await rig.client.ask(path(speed=15.0))
        await asyncio.sleep(0.3)
        if behind is None:
            asyncio.get_running_loop().hold_up(1.5)
        else:
            stands_still(monkeypatch, behind, 1.5)
        for each in said.replies:
            await rig.client.wait_for_end(each.axis, each.command_id)
        for name in NAMES:
            await rig.until(name, lambda state: state.state is AxisState.STANDSTILL)
        said = await rig.client.ask(path(speed=15.0))
        states = [await rig.client.wait_for_end(each.axis, each.command_id) for each in said.replies]

    assert [state.last_error for state in states] == [None, None]


async def test_a_drive_is_fed_no_more_behind_the_stop_of_its_path(monkeypatch):
    """Its status was read when the other tripped, and shows nothing of that; points behind a stop stay in a drive."""
    chain, look, stop, stopped = sc_chain(), LdcnAxis.path_status, LdcnAxis.stop, asyncio.Event()
    add, fed = LdcnAxis.add_points, list[str]()
    seen: list[PathStatus] = []

    async def look_while_the_other_trips(axis: LdcnAxis) -> PathStatus:
        status = await look(axis)
        if axis.spec.name == "z" and not seen:
            seen.append(status)
            await stopped.wait()
        elif axis.spec.name == "c" and seen:
            return replace(status, enabled=False)
        return status

    async def feed(axis: LdcnAxis, steps: Sequence[int]) -> PathStatus:
        status = await add(axis, steps)
        if stopped.is_set():
            fed.append(axis.spec.name)
        return status

    async def stop_and_tell(axis: LdcnAxis, mode: StopMode) -> StopMode:
        done = await stop(axis, mode)
        if axis.spec.name == "z":
            stopped.set()
        return done

    async with two_sc(chain) as rig:
        said = await rig.client.ask(path(speed=15.0))
        await asyncio.sleep(0.3)
        monkeypatch.setattr(LdcnAxis, "path_status", look_while_the_other_trips)
        monkeypatch.setattr(LdcnAxis, "add_points", feed)
        monkeypatch.setattr(LdcnAxis, "stop", stop_and_tell)
        for each in said.replies:
            await rig.client.wait_for_end(each.axis, each.command_id)

    assert seen
    assert not fed


@pytest.mark.parametrize("after_s", [0.31, 0.5, 0.97])
@pytest.mark.sweep(2)
async def test_a_move_that_aborts_a_path_begins_where_its_axis_has_come_to_rest(after_s):
    chain = sc_chain()
    async with two_sc(chain) as rig:
        await rig.client.ask(path(speed=15.0))
        await asyncio.sleep(after_s)
        walker = drive(chain, 1).loop.trajectory
        aborting = asyncio.create_task(
            rig.client.command("z", MoveRelative(distance=2.0, buffer_mode=BufferMode.ABORTING))
        )
        while walker.path.running:
            await asyncio.sleep(0.0002)
            drive(chain, 1)  # with its servo cycles up to now
        ended_at = walker.position / 65536
        await rig.client.wait_for_end("z", (await aborting).command_id)
        await asyncio.sleep(0.5)

        assert walker.position / 65536 == pytest.approx(ended_at + 2000, abs=40)  # the shaft settles
        assert await rests(chain)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("after_s", [0.31, 0.5, 0.97])
@pytest.mark.sweep(2)
async def test_the_stop_of_a_path_does_not_stop_the_move_that_has_aborted_it(name, after_s):
    chain = sc_chain()
    async with two_sc(chain) as rig:
        await rig.client.ask(path(speed=15.0))
        await asyncio.sleep(after_s)
        reply = await rig.client.command(name, MoveAbsolute(position=-9.0, buffer_mode=BufferMode.ABORTING))
        await rig.client.wait_for_end(name, reply.command_id)

        assert drive(chain, 1 + NAMES.index(name)).shaft.position_counts == pytest.approx(-9000, abs=30)
        assert await rests(chain)


@pytest.mark.promise("path-ends-with-daemon")
async def test_if_the_daemon_dies_the_axes_stand_at_the_end_of_their_buffers():
    chain = sc_chain()
    async with two_sc(chain) as rig:
        said = await rig.client.ask(path(speed=10.0))
        await asyncio.sleep(1.0)
        await rig.kill()
        await asyncio.sleep(said.ahead_s + 0.1)
        still = await rests(chain)
        wanted, shafts = places(chain)

    assert still
    assert math.dist(wanted, shafts) < 0.02
    assert from_polyline(wanted, [(0.0, 0.0), *zip(TRIANGLE["z"], TRIANGLE["c"], strict=True)]) < said.deviation + 0.001


@pytest.mark.promise("path-checked-whole")
@pytest.mark.parametrize("by_force", [False, True])
@pytest.mark.sweep(2)
async def test_a_path_whose_sender_has_lost_one_axis_is_fed_no_further(by_force):
    chain = sc_chain()
    async with two_sc(chain, leased=True) as rig:
        lease = await rig.client.ask(Acquire(client="walker", axes=NAMES, lease_s=30.0 if by_force else 1.0))
        walked = path(speed=10.0)
        moves = tuple(move.model_copy(update={"lease": lease.lease}) for move in walked.moves)
        await rig.client.ask(walked.model_copy(update={"moves": moves}))
        await asyncio.sleep(0.5)
        if by_force:
            await rig.client.ask(Acquire(client="other", axes=("c",), force=True))
        await asyncio.sleep(1.5)
        still = await rests(chain)
        before = len(rig.sent)
        await asyncio.sleep(1.0)
        later = [packet.command for packet in rig.sent[before:]]

    assert still
    assert math.dist(places(chain)[1], (0.0, 0.0)) < 20.0
    assert CommandCode.ADD_PATH_POINTS not in later


@pytest.mark.promise("path-checked-whole")
@pytest.mark.long
async def test_a_stop_at_any_instant_of_a_path_is_the_last_that_moves():
    for tenth in range(1, 12):
        chain = sc_chain()
        async with two_sc(chain) as rig:
            walking = asyncio.create_task(rig.client.ask(path(speed=15.0)))
            await asyncio.sleep(0.02 * tenth)
            await rig.client.command("z", Stop())
            await rig.client.command("c", Stop())
            await asyncio.wait([walking])
            walking.exception()
            await asyncio.sleep(1.0)
            assert await rests(chain), f"stopped after {0.02 * tenth:.2f} s"
            assert not any(module.loop.trajectory.path.running for module in (drive(chain, 1), drive(chain, 2)))
            for name in NAMES:
                await rig.client.command(name, Reset())
                await rig.client.command(name, Power(on=True))
            await rig.client.ask(path(speed=15.0))  # nothing of the earlier one is left in a drive


@pytest.mark.long
async def test_a_path_that_one_axis_leaves_before_it_starts_leaves_no_points_in_the_other_drive():
    left_at = set()
    for hundredth in range(1, 12):
        chain = sc_chain()
        async with two_sc(chain) as rig:
            walking = asyncio.create_task(rig.client.ask(path(speed=15.0)))
            await asyncio.sleep(0.01 * hundredth)
            left_at.add(drive(chain, 2).loop.trajectory.path.points_left)
            await rig.client.command("z", Stop())
            await asyncio.wait([walking])
            walking.exception()
            assert await rests(chain), f"stopped after {0.01 * hundredth:.2f} s"
            assert drive(chain, 2).loop.trajectory.path.points_left == 0, f"stopped after {0.01 * hundredth:.2f} s"

    print(f"points when stopped: {sorted(left_at)}")
    assert len(left_at) > 5


@pytest.mark.long
async def test_an_axis_that_walks_more_slowly_is_not_ended_by_one_that_has_arrived(monkeypatch):
    monkeypatch.setitem(AXIS, "settle", {"window": 1.0, "time_s": 0.0})
    monkeypatch.setitem(AXIS, "rates", {"position": 50, "state": 50})
    chain = sc_chain()
    async with two_sc(chain) as rig:
        said = await rig.client.ask(path(speed=15.0))
        await asyncio.sleep(said.duration_s - 0.3)
        drive(chain, 2).loop.trajectory.path.add([0, 0, 0])
        states = [await rig.client.wait_for_end(each.axis, each.command_id) for each in said.replies]

    assert [state.last_error for state in states] == [None, None]


async def test_a_path_that_is_refused_in_its_turn_leaves_the_axes_at_standstill_at_once(monkeypatch):
    chain = sc_chain()
    async with two_sc(chain) as rig:
        announced = []

        async def refuse(names: frozenset[str], _still_wanted: Callable[[], None]) -> None:
            await asyncio.sleep(0.05)
            announced.extend([(await rig.client.state(name)).state for name in sorted(names)])
            raise WrongState("refused in its turn")

        monkeypatch.setattr(rig.line.network, "start_path", refuse)
        with pytest.raises(WrongState, match="in its turn"):
            await rig.client.ask(path())
        states = [await rig.client.state(name) for name in NAMES]

    assert announced == [AxisState.DISCRETE_MOTION] * 2
    assert [(state.state, state.command) for state in states] == [(AxisState.STANDSTILL, None)] * 2


async def test_polls_go_on_while_a_path_is_fed():
    chain = sc_chain()
    async with two_sc(chain) as rig:
        await rig.client.ask(path(speed=10.0))
        loop = asyncio.get_running_loop()
        since_s = loop.time()
        await asyncio.sleep(2.0)
        records = [each for each in rig.line.bus.wire_log.records() if each.at_s >= since_s]
        reads_s = [each.at_s for each in records if each.event is WireEvent.SENT and each.data[1:3] == bytes((1, 0x13))]
        states = [await rig.client.state(name) for name in NAMES]

    assert all(state is not None and state.link is LinkState.UP for state in states)
    assert max(after - before for before, after in pairwise(reads_s)) < 0.15


async def test_drives_without_path_mode_refuse():
    chain = build_chain(ChainSpec(tuple(ModuleSpec(m) for m in ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4"))))
    async with rig_on(
        chain, simulated_config({"reference": "at_reset"}, group=[{"name": "plane", "axes": ["x", "y"]}])
    ) as rig:
        await rig.power_on("x", "y")
        with pytest.raises(NotSupported, match="path mode"):
            await rig.client.ask(path({"x": (1.0,), "y": (2.0,)}))


@pytest.mark.parametrize(
    ("via", "end", "direction", "ends_at"),
    [(2.0, 9.0, None, 29.0), (2.0, 1.0, None, 31.0), (2.0, 1.0, Direction.POSITIVE, 41.0), (9.5, 0.5, None, 30.5)],
)
@pytest.mark.sweep(2)
async def test_a_turning_axis_goes_the_short_way_from_corner_to_corner_or_as_it_is_asked(via, end, direction, ends_at):
    chain = sc_chain()
    async with two_sc(chain, turning=10.0) as rig:
        reply = await rig.client.command("c", MoveRelative(distance=31.0))  # three turns lie behind it
        await rig.client.wait_for_end("c", reply.command_id)

        moves = (
            AxisPath(axis="z", via=(1.0,), position=3.0),
            AxisPath(axis="c", via=(via,), position=end, direction=direction),
        )
        reply = await rig.client.ask(WalkPath(moves=moves))
        await rig.client.wait_for_end("c", reply.replies[1].command_id)

        assert drive(chain, 2).shaft.position_counts == pytest.approx(1000 * ends_at, abs=30)


@pytest.mark.parametrize("allowed_s", [0.05, 0.12, 0.2, 0.3, 2.0])
@pytest.mark.sweep(2)
async def test_a_path_begins_in_time_or_not_at_all_however_long_its_drives_are_fed(allowed_s):
    chain = sc_chain()
    async with two_sc(chain, baud=19_200) as rig:
        loop = asyncio.get_running_loop()
        latest_s = loop.time() + allowed_s
        not_after = EPOCH_NS + round(latest_s * 1e9)
        moves = tuple(AxisPath(axis=name, via=(2.0,), position=4.0, not_after=not_after) for name in NAMES)
        asked = asyncio.create_task(rig.client.ask(WalkPath(moves=moves)))
        began_s = None
        while began_s is None and not asked.done():
            await asyncio.sleep(0.001)
            if any(drive(chain, at).loop.trajectory.path.running for at in (1, 2)):
                began_s = loop.time()

        if began_s is None:
            with pytest.raises(CommandExpired):
                await asked
            await asyncio.sleep(1.0)
            assert [drive(chain, at).shaft.position_counts for at in (1, 2)] == pytest.approx([0, 0], abs=30)
        else:
            await asked
            assert began_s <= latest_s + 0.01
        assert began_s is not None or allowed_s < 2.0


@pytest.mark.promise("override-0")
async def test_a_path_that_was_being_fed_at_0_percent_does_not_begin_once_that_is_raised():
    chain = sc_chain()
    async with two_sc(chain) as rig:

        async def interfere() -> None:
            await asyncio.sleep(0.05)
            for percent in (0, 100):
                await rig.client.ask(SetSpeedOverride(percent=percent))

        interfering = asyncio.create_task(interfere(), name="interfere")
        with pytest.raises(CommandAborted):
            await rig.client.ask(path())
        await interfering
        assert await rests(chain, 2.0)


@pytest.mark.parametrize("after_s", [0.02, 0.1, 0.2])
async def test_a_path_that_is_fed_while_the_override_is_lowered_does_not_begin_at_the_speed_of_before(after_s):
    chain = sc_chain()
    async with two_sc(chain, baud=19_200) as rig:
        asked = asyncio.create_task(rig.client.ask(path()), name="path")
        while not any(packet.command is CommandCode.ADD_PATH_POINTS for packet in rig.sent):
            await asyncio.sleep(0.001)
        await asyncio.sleep(after_s)
        assert not any(drive(chain, at).loop.trajectory.path.running for at in (1, 2))
        await rig.client.ask(SetSpeedOverride(percent=5.0))

        with pytest.raises(WrongState, match="lowered to 5 %"):
            await asked
        assert await rests(chain, 1.0)
        slowed = await rig.client.ask(path())
        states = [await rig.client.wait_for_end(each.axis, each.command_id) for each in slowed.replies]

    assert [state.last_error for state in states] == [None, None]
    assert math.dist(places(chain)[1], (TRIANGLE["z"][-1], TRIANGLE["c"][-1])) < 0.05


@pytest.mark.parametrize("mode", [BufferMode.BUFFERED, BufferMode.ABORTING])
async def test_a_path_may_wait_for_the_motion_of_a_member_or_halt_it(mode):
    chain = sc_chain()
    async with two_sc(chain) as rig:
        await rig.client.command("c", MoveAbsolute(position=5.0))
        await asyncio.sleep(0.1)
        request = path()
        moves = tuple(move.model_copy(update={"buffer_mode": mode}) for move in request.moves)
        reply = await rig.client.ask(request.model_copy(update={"moves": moves}))
        for each in reply.replies:
            await rig.client.wait_for_end(each.axis, each.command_id)
        assert places(chain)[1] == pytest.approx((0.0, 0.0), abs=0.05)


def test_a_speed_that_is_another_one_for_each_axis_is_refused_whichever_is_named_first(monkeypatch):
    line = plane().bus[0]
    axes = (line.axis[0].model_copy(update={"velocity_unit": "mm/min"}), *line.axis[1:])
    config = plane().model_copy(update={"bus": (line.model_copy(update={"axis": axes}),)})
    chain = sc_chain()
    with virtual_rig(monkeypatch, config, {"line0": chain}) as here:
        here.power_on(*NAMES)
        refused = [here.run(f"group path {order} --speed 15") for order in ("z=20,20,0 c=0,15,0", "c=0,15,0 z=20,20,0")]
        stands = here.wait(rests(chain, 1.0))

    assert [each.code for each in refused] == [2, 2]
    said = [" ".join(each.errors.split()) for each in refused]
    assert all("0.25 for z" in each and "15 for c" in each for each in said)
    assert stands
