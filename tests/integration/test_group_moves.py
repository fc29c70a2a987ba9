"""Several axes moved by one request, each through its own queue and guards."""

import asyncio

import pytest

from ldcnd.daemon.command.dispatch import move_together
from ldcnd.drivers.ldcn.packet import Command
from ldcnd.errors import MalformedRequest, NotSupported, PositionLimit, StopLatched, UnknownAxis
from ldcnd.model.commands import MoveAbsolute, Power
from ldcnd.model.rig_commands import AxisMove, MoveTogether
from ldcnd.model.samples import AxisState, LinkState
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive, rig_on, simulated_config

MODELS = ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")
GANTRY = simulated_config(group=[{"name": "gantry", "axes": ["x", "y"]}])


def chain_of():
    return build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS)))


async def powered(rig, *names):
    for name in names:
        await rig.until(name, lambda state: state.link is LinkState.UP)
        await rig.client.command(name, Power(on=True))


async def together(rig, **targets):
    """Ask for a group move."""
    axes = rig.daemon.rig.axes
    moves = {name: MoveAbsolute(position=target) for name, target in targets.items()}
    return await move_together(rig.daemon.rig, moves, lambda name, share: axes[name].execute(share))


def starts(rig):
    return [packet for packet in rig.sent if packet.command is Command.START_MOTION]


async def test_axes_start_together_and_end_like_any_move():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await powered(rig, "x", "y")

        x, y = await together(rig, x=10.0, y=-10.0)
        under_way = [rig.daemon.rig.axes[name].tracker.state for name in ("x", "y")]
        ended = [await rig.client.wait_for_end(name, reply.command_id) for name, reply in (("x", x), ("y", y))]
        await asyncio.sleep(2)

    assert [packet.address for packet in starts(rig)] == [0x81]
    assert under_way == [AxisState.DISCRETE_MOTION] * 2
    assert [(state.state, state.last_error) for state in ended] == [(AxisState.STANDSTILL, None)] * 2
    assert (x.position, y.position) == (pytest.approx(10.0), pytest.approx(-10.0))
    assert abs(drive(chain, 1).loop.position - 10_000) <= 1
    assert abs(drive(chain, 2).loop.position + 10_000) <= 1


async def test_a_member_beyond_its_limit_keeps_all_at_rest():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await powered(rig, "x", "y")

        with pytest.raises(PositionLimit, match="axis y"):
            await together(rig, x=10.0, y=-1000.0)
        await asyncio.sleep(1)
        states = [rig.daemon.rig.axes[name].tracker.state for name in ("x", "y")]

    assert starts(rig) == []
    assert states == [AxisState.STANDSTILL] * 2


async def test_a_stop_of_one_member_before_the_start_keeps_all_at_rest():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await powered(rig, "x", "y")

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
        await powered(rig, "x", "z")

        with pytest.raises(NotSupported, match="not exactly the members"):
            await together(rig, x=1.0, z=1.0)
        with pytest.raises(UnknownAxis):
            await together(rig, x=1.0, nobody=1.0)

    assert starts(rig) == []


async def outcome(call):
    try:
        return await call
    except StopLatched as error:
        return error


async def test_a_query_of_the_rig_starts_a_group_once():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await powered(rig, "x", "y")
        request = MoveTogether(moves=(AxisMove(axis="x", position=5.0), AxisMove(axis="y", position=6.0)))

        reply = await rig.client.ask(request)

    assert [part.axis for part in reply.replies] == ["x", "y"]
    assert [packet.address for packet in starts(rig)] == [0x81]


async def test_an_axis_named_twice_is_refused():
    chain = chain_of()
    async with rig_on(chain, GANTRY) as rig:
        await powered(rig, "x", "y")
        request = MoveTogether(moves=(AxisMove(axis="x", position=5.0), AxisMove(axis="x", position=6.0)))

        with pytest.raises(MalformedRequest):
            await rig.client.ask(request)

    assert starts(rig) == []
