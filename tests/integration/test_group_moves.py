"""Several axes moved by one request, each through its own queue and guards."""

import asyncio
import math

import pytest
from click.testing import CliRunner

from ldcnd.cli.rig import group
from ldcnd.contract.commands import MoveAbsolute, MoveRelative
from ldcnd.contract.errors import (
    CommandAborted,
    CommandIdReused,
    ErrorCode,
    LdcndError,
    MalformedRequest,
    NotSupported,
    PositionLimit,
    StopLatched,
    UnknownAxis,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.events import CommandStatus, ReadOutcome
from ldcnd.contract.rig_commands import AxisMove, LinePath, MoveTogether, PreviewTogether, SetSpeedOverride
from ldcnd.contract.samples import AxisState
from ldcnd.daemon.group_moves import move_together
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.received import StopMotor
from ldcnd.drives.ldcn.registers import FRACTION
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive, rig_on, simulated_config
from tests.support.command_line import virtual_rig

MODELS = ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")
GANTRY = simulated_config(group=[{"name": "gantry", "axes": ["x", "y"]}])


def chain_of():
    return build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS)))


async def together(rig, **targets):
    """Ask for a group move."""
    axes = rig.daemon.rig.axes
    moves = {name: MoveAbsolute(position=target) for name, target in targets.items()}
    reply = await move_together(rig.daemon.rig, moves, lambda name, share: axes[name].execute(share))
    return reply.replies


def loads(rig):
    return [packet for packet in rig.sent if packet.command is CommandCode.LOAD_TRAJECTORY]


def starts(rig):
    return [packet for packet in rig.sent if packet.command is CommandCode.START_MOTION]


async def test_axes_start_together_and_end_like_any_move():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")

        x, y = await together(rig, x=10.0, y=-10.0)
        under_way = [rig.daemon.rig.axes[name].tracker.status.state for name in ("x", "y")]
        ended = [await rig.client.wait_for_end(name, reply.command_id) for name, reply in (("x", x), ("y", y))]
        await asyncio.sleep(2)

    assert [packet.address for packet in starts(rig)] == [0x81]
    assert under_way == [AxisState.DISCRETE_MOTION] * 2
    assert [(state.state, state.last_error) for state in ended] == [(AxisState.STANDSTILL, None)] * 2
    assert (x.position, y.position) == (pytest.approx(10.0), pytest.approx(-10.0))
    assert abs(drive(chain, 1).loop.position - 10_000) <= 1
    assert abs(drive(chain, 2).loop.position + 10_000) <= 1


async def test_a_distance_counts_from_where_another_program_has_stopped_a_member():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        moves = AxisMove(axis="x", position=30.0), AxisMove(axis="y", position=-10.0)
        x, y = (await rig.client.ask(MoveTogether(moves=moves))).replies
        await asyncio.sleep(0.5)
        drive(chain, 1).execute(StopMotor(StopControl.AMP_ENABLE | StopControl.SMOOTH, None))
        for name, reply in (("x", x), ("y", y)):
            await rig.client.wait_for_end(name, reply.command_id)
        outcome_of_x = await rig.client.ask(ReadOutcome(command_id=x.command_id))
        await asyncio.sleep(1.0)
        stands = drive(chain, 1).loop.position
        reply = await rig.client.command("x", MoveRelative(distance=1.0))
        await rig.client.wait_for_end("x", reply.command_id)
        went = drive(chain, 1).loop.position - stands

    assert stands < 29_000
    assert outcome_of_x.status is CommandStatus.FAILED
    assert went == pytest.approx(1000, abs=20)


async def test_a_stop_of_one_member_before_the_start_keeps_all_at_rest():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")

        async with asyncio.TaskGroup() as group:
            move = group.create_task(outcome(together(rig, x=10.0, y=-10.0)), name="move")
            await asyncio.sleep(0.003)
            await rig.client.stop("y")

    assert isinstance(move.result(), StopLatched)
    assert starts(rig) == []
    assert [drive(chain, address).loop.position for address in (1, 2)] == [0, 0]


async def test_axes_that_are_no_group_or_do_not_exist_are_refused():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "z")
        before = loads(rig)

        with pytest.raises(NotSupported, match="not exactly the members"):
            await together(rig, x=1.0, z=1.0)
        with pytest.raises(UnknownAxis):
            await together(rig, x=1.0, nobody=1.0)

    assert (loads(rig), starts(rig)) == (before, [])


async def outcome(call):
    try:
        return await call
    except LdcndError as error:
        return error


async def test_a_query_of_the_rig_starts_a_group_once():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        request = MoveTogether(moves=(AxisMove(axis="x", position=5.0), AxisMove(axis="y", position=6.0)))

        reply = await rig.client.ask(request)

    assert [part.axis for part in reply.replies] == ["x", "y"]
    assert [packet.address for packet in starts(rig)] == [0x81]


async def test_a_group_move_that_is_sent_again_is_answered_alike_and_starts_once():
    async with rig_on(chain_of(), GANTRY) as rig:
        await rig.power_on("x", "y")
        request = MoveTogether(
            moves=(AxisMove(axis="x", position=5.0, command_id="1"), AxisMove(axis="y", position=6.0, command_id="2")),
            path=LinePath.LINEAR,
        )

        first = await rig.client.ask(request)
        again = await rig.client.ask(request)
        with pytest.raises(CommandIdReused):
            await rig.client.ask(request.model_copy(update={"path": LinePath.INDEPENDENT}))

    assert again == first
    assert first.deviation is not None
    assert len(starts(rig)) == 1


async def test_a_group_move_that_comes_twice_at_once_is_answered_alike_and_starts_once():
    async with rig_on(chain_of(), GANTRY) as rig:
        await rig.power_on("x", "y")
        moves = (AxisMove(axis="x", position=5.0, command_id="1"), AxisMove(axis="y", position=6.0, command_id="2"))
        request = MoveTogether(moves=moves, path=LinePath.LINEAR)

        # the second arrives before the ledger knows a share of the first
        first, second = await asyncio.gather(rig.client.ask(request), rig.client.ask(request))

    assert first == second
    assert first.deviation is not None
    assert len(starts(rig)) == 1


async def test_a_group_move_of_one_new_and_one_old_id_starts_nothing():
    async with rig_on(chain_of(), GANTRY) as rig:
        await rig.power_on("x", "y")
        x, y = (AxisMove(axis="x", position=5.0, command_id="1"), AxisMove(axis="y", position=6.0, command_id="2"))
        await rig.client.ask(MoveTogether(moves=(x, y)))
        for move in (x, y):
            await rig.client.wait_for_end(move.axis, move.command_id)

        with pytest.raises(WrongState):
            await rig.client.ask(MoveTogether(moves=(x.model_copy(update={"command_id": "3"}), y)))

    assert len(starts(rig)) == 1


async def test_an_axis_named_twice_is_refused():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        request = MoveTogether(moves=(AxisMove(axis="x", position=5.0), AxisMove(axis="x", position=6.0)))

        with pytest.raises(MalformedRequest):
            await rig.client.ask(request)

    assert starts(rig) == []


def commanded(chain, names="xy"):
    """Where the profile generators are, in mm."""
    now_s = asyncio.get_running_loop().time()
    for address in range(1, len(names) + 1):
        drive(chain, address).catch_up(now_s)
    return [drive(chain, address).loop.trajectory.position / FRACTION / 1000 for address in range(1, len(names) + 1)]


@pytest.mark.promise("line-all-or-none")
@pytest.mark.parametrize("velocity", [1.0, 10.0, 20.0])
@pytest.mark.sweep(2)
async def test_axes_on_a_line_leave_it_by_no_more_than_was_said_before(velocity):
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        moves = tuple(AxisMove(axis=axis, position=to, velocity=velocity) for axis, to in (("x", 12.0), ("y", -5.0)))
        said = await rig.client.ask(PreviewTogether(moves=moves, path="linear"))
        reply = await rig.client.ask(MoveTogether(moves=moves, path="linear"))
        farthest, ended_s = 0.0, [math.inf, math.inf]
        began_s = asyncio.get_running_loop().time()
        while asyncio.get_running_loop().time() < began_s + said.duration_s + 0.5:
            await asyncio.sleep(0.003)
            x, y = commanded(chain)
            farthest = max(farthest, abs(5.0 * x + 12.0 * y) / 13.0)
            now_s = asyncio.get_running_loop().time()
            ended_s = [
                min(was, now_s) if at == to else was for was, at, to in zip(ended_s, (x, y), (12.0, -5.0), strict=True)
            ]

    assert reply.deviation == said.deviation
    assert farthest <= said.deviation
    assert said.deviation < 0.02
    assert abs(ended_s[0] - ended_s[1]) < 0.02
    assert [each.duration_s for each in reply.replies] == pytest.approx([said.duration_s] * 2, rel=0.01)
    assert max(abs(each.velocity) for each in reply.replies) <= velocity * 1.001


@pytest.mark.promise("line-all-or-none")
async def test_a_line_that_would_be_left_too_far_moves_nothing():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        moves = (AxisMove(axis="x", position=12.0), AxisMove(axis="y", position=-5.0))
        with pytest.raises(ValueOutOfRange, match="leave the line"):
            await rig.client.ask(MoveTogether(moves=moves, path="linear", max_deviation=1e-6))
        await asyncio.sleep(1)

    assert starts(rig) == []
    assert [drive(chain, address).loop.position for address in (1, 2)] == [0, 0]


@pytest.mark.promise("line-all-or-none")
@pytest.mark.parametrize("path", ["independent", "linear"])
async def test_a_member_beyond_its_limit_keeps_all_at_rest(path):
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        moves = (AxisMove(axis="x", position=12.0), AxisMove(axis="y", position=-1000.0))
        for request in (MoveTogether(moves=moves, path=path), PreviewTogether(moves=moves, path=path)):
            with pytest.raises(PositionLimit, match="axis y"):
                await rig.client.ask(request)
        await asyncio.sleep(1)
        states = [rig.daemon.rig.axes[name].tracker.status.state for name in ("x", "y")]

    assert starts(rig) == []
    assert states == [AxisState.STANDSTILL] * 2


async def test_a_start_that_takes_longer_than_members_wait_for_each_other_has_one_outcome(monkeypatch):
    monkeypatch.setattr("ldcnd.axis.procedures.group.MEETING_S", 0.01)  # as on a slow and busy line
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")

        replies = await together(rig, x=10.0, y=-10.0)
        for reply in replies:
            await rig.client.wait_for_end(reply.axis, reply.command_id)

        assert [drive(chain, at).shaft.position_counts for at in (1, 2)] == pytest.approx([10_000, -10_000], abs=60)


async def shafts(chain):
    return [drive(chain, at).shaft.position_counts for at in (1, 2)]


def test_a_dry_run_of_a_group_says_what_would_be_done_and_moves_nothing(monkeypatch):
    chain = chain_of()
    with virtual_rig(monkeypatch, GANTRY, {"line0": chain}) as rig:
        rig.wait(asyncio.sleep(1))
        rig.run("power on")
        straight = rig.run("group move x=12 y=-5 --straight --dry-run")
        apart = rig.run("group move x=12 y=-5 --dry-run")
        too_far = rig.run("group move x=12 y=-5 --straight --max-deviation 0.000001 --dry-run")
        rig.wait(asyncio.sleep(2))
        stood = rig.wait(shafts(chain))
        moved = rig.run("group move x=12 y=-5 --straight --wait")
        went = rig.wait(shafts(chain))

    assert (straight.code, apart.code, moved.code) == (0, 0, 0)
    assert straight.printed.splitlines()[0].startswith("x: to 12 at ")
    assert "from the line" in straight.printed
    assert "from the line" not in apart.printed
    assert too_far.code == 1
    assert "leave the line" in too_far.errors
    assert stood == pytest.approx([0, 0], abs=2)
    assert went == pytest.approx([12_000, -5_000], abs=60)


def test_a_group_of_one_is_refused_in_words():
    said = CliRunner().invoke(group, ["move", "x=5", "--connect", "tcp/127.0.0.1:1"])
    assert said.exit_code == 2
    assert "moves: takes at least 2, and 1 came" in said.output


@pytest.mark.parametrize("corners", [("z=1,5", "c=2,5"), ("z=1,5mm", "c=0.5,1"), ("z=-20,0", "c=0,15")])
def test_places_of_a_path_that_can_be_one_number_are_refused(corners):
    said = CliRunner().invoke(group, ["path", *corners, "--connect", "tcp/127.0.0.1:1"])

    assert said.exit_code == 2
    first = corners[0].removeprefix("z=")
    assert f"type z={first.replace(',', '.')} or z={first.replace(',', '.0,')}" in " ".join(said.output.split())


SHARES = tuple(AxisMove(axis=name, position=10.0) for name in ("x", "y"))


@pytest.mark.promise("override-0")
async def test_a_group_that_was_about_to_start_at_0_percent_does_not_start_once_that_is_raised():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")

        async with asyncio.TaskGroup() as group:
            move = group.create_task(outcome(rig.client.ask(MoveTogether(moves=SHARES))), name="move")
            await asyncio.sleep(0.003)
            for percent in (0, 100):
                await rig.client.ask(SetSpeedOverride(percent=percent))
        await asyncio.sleep(2)

        assert isinstance(move.result(), CommandAborted)
        assert [drive(chain, address).loop.position for address in (1, 2)] == [0, 0]


async def test_a_group_never_begins_faster_than_the_override_allows_when_it_does():
    """Lowered at any instant of its start, it is refused, slower, or under way: then it keeps its speed."""
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        position, refused, begun_when_lowered = 0.0, 0, 0

        def lowered(_before, _after):
            nonlocal begun_when_lowered
            begun_when_lowered = len(starts(rig))

        rig.daemon.rig.axes["x"].tracker.watch(lowered, "speed_share")
        for after_ms in range(1, 25):
            before, position = position, 1.0 - position
            moves = tuple(AxisMove(axis=name, position=position) for name in ("x", "y"))
            begun = len(starts(rig))
            move = asyncio.create_task(outcome(rig.client.ask(MoveTogether(moves=moves))), name="move")
            await asyncio.sleep(after_ms / 1000)
            await rig.client.ask(SetSpeedOverride(percent=25))
            under_way = begun_when_lowered > begun
            said = await move
            await asyncio.sleep(2)
            await rig.client.ask(SetSpeedOverride(percent=100))
            if isinstance(said, LdcndError):
                assert (said.code, under_way) == (ErrorCode.WRONG_STATE, False)
                position, refused = before, refused + 1
            elif not under_way:
                full = [rig.daemon.rig.axes[name].config.velocity for name in ("x", "y")]
                assert [reply.velocity for reply in said.replies] == pytest.approx(
                    [each / 4 for each in full], rel=0.01
                )
            here = [drive(chain, address).loop.position for address in (1, 2)]
            assert here == [pytest.approx(position * 1000, abs=20)] * 2, f"{after_ms} ms"

        assert refused


async def test_a_group_that_began_in_time_goes_on_whenever_its_last_answer_comes():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        clock, target = rig.daemon.rig.axes["x"]._clock, 0.0
        refused = 0
        for after_ms in range(1, 41):
            target, before = 1.0 - target, target
            until = clock.now_ns() + after_ms * 1_000_000
            moves = tuple(AxisMove(axis=name, position=target, not_after=until) for name in ("x", "y"))
            said = await outcome(rig.client.ask(MoveTogether(moves=moves)))
            await asyncio.sleep(2)
            if isinstance(said, LdcndError):
                assert said.code is ErrorCode.COMMAND_EXPIRED
                target, refused = before, refused + 1
            here = [drive(chain, address).loop.position for address in (1, 2)]
            assert here == [pytest.approx(target * 1000, abs=20)] * 2, f"{after_ms} ms"

        assert 0 < refused < 40


async def test_a_group_begins_at_the_speed_that_was_set_while_its_members_met():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        await rig.client.command("y", MoveAbsolute(position=10.0, velocity=10.0))
        moves = tuple(move.model_copy(update={"position": 20.0, "buffer_mode": "buffered"}) for move in SHARES)

        async with asyncio.TaskGroup() as group:
            move = group.create_task(rig.client.ask(MoveTogether(moves=moves)), name="move")
            await asyncio.sleep(0.3)
            await rig.client.ask(SetSpeedOverride(percent=25))

        full = [rig.daemon.rig.axes[name].config.velocity for name in ("x", "y")]
        begun = [reply.velocity for reply in move.result().replies]
        assert begun == pytest.approx([0.25 * each for each in full], rel=0.01)


@pytest.mark.parametrize("module", ["ls182ap", "picservo-sc"])
async def test_a_group_move_halts_what_a_member_does_if_it_says_so(module):
    profile = {"ls182ap": "ls-182ap", "picservo-sc": "pic-servo-sc"}[module]
    document = GANTRY.model_dump(mode="json", exclude_unset=True)
    document["bus"][0]["axis"] = document["bus"][0]["axis"][:2]
    for axis in document["bus"][0]["axis"]:
        axis["model"] = profile
    chain = build_chain(ChainSpec((ModuleSpec(module), ModuleSpec(module))))
    async with rig_on(chain, type(GANTRY).model_validate(document)) as rig:
        await rig.power_on("x", "y")
        await rig.client.command("y", MoveAbsolute(position=-10.0))
        await asyncio.sleep(0.2)
        moves = tuple(move.model_copy(update={"buffer_mode": "aborting"}) for move in SHARES)
        reply = await rig.client.ask(MoveTogether(moves=moves))
        for each in reply.replies:
            await rig.client.wait_for_end(each.axis, each.command_id)

        assert [drive(chain, at).shaft.position_counts for at in (1, 2)] == pytest.approx([10_000, 10_000], abs=60)


@pytest.mark.parametrize("after_ms", range(2, 40, 2))
@pytest.mark.sweep(3)
async def test_a_group_move_that_is_cut_short_leaves_no_axis_moving(after_ms):
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x", "y")
        move = asyncio.create_task(together(rig, x=10.0, y=-10.0), name="move")
        await asyncio.sleep(after_ms / 1000)
        if not move.done():
            move.cancel()
            await asyncio.wait([move])
            await asyncio.sleep(0.5)
            stood = [drive(chain, at).shaft.position_counts for at in (1, 2)]
            await asyncio.sleep(0.5)

            assert [drive(chain, at).shaft.position_counts for at in (1, 2)] == pytest.approx(stood, abs=5)
            for name in ("x", "y"):
                await rig.until(name, lambda state: state.command is None)


@pytest.mark.parametrize("after_ms", range(2, 20, 2))
@pytest.mark.sweep(3)
async def test_a_move_whose_caller_is_cut_short_ends_like_any_other(after_ms):
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await rig.power_on("x")
        move = asyncio.create_task(rig.daemon.rig.axes["x"].execute(MoveAbsolute(position=5.0)), name="move")
        await asyncio.sleep(after_ms / 1000)
        move.cancel()
        await asyncio.wait([move])
        await asyncio.sleep(1.0)
        state = await rig.until("x", lambda state: state.command is None)
        assert state.state is AxisState.STANDSTILL
        assert await rig.client.command("x", MoveAbsolute(position=1.0))
