"""What `ldcnd top` shows of a whole daemon, on the jumping clock."""

import asyncio
from contextlib import asynccontextmanager

import pytest

from ldcnd.client.overview import overview
from ldcnd.contract.commands import Halt, MoveAbsolute
from ldcnd.contract.errors import TransportLost
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.contract.troubles import Severity
from ldcnd.lab.top.columns import as_text, headline
from ldcnd.lab.top.follow import follow
from ldcnd.lab.top.rig_view import RigView
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.rig import running_rig


@asynccontextmanager
async def followed(rig):
    """Yield what makes a glance of a rig that is followed."""
    loop = asyncio.get_running_loop()
    view = RigView(rig.client.rig, loop.time())
    following = asyncio.create_task(follow(rig.client, view), name="follow")
    try:
        yield lambda: view.glance(loop.time())
    finally:
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)


async def until(glance, wanted, within_s=30.0):
    """Return the first glance that is wanted."""
    async with asyncio.timeout(within_s):
        while not wanted(glance()):
            await asyncio.sleep(0.1)
    return glance()


async def test_every_axis_and_line_of_a_healthy_rig_is_shown_with_its_rates():
    async with running_rig() as rig, followed(rig) as glance:
        shown = await until(glance, lambda now: now.buses and now.buses[0].exchanges_per_s)

    assert [(row.axis, row.bus, row.unit) for row in shown.axes] == [
        ("x", "line0", "mm"),
        ("y", "line0", "mm"),
        ("z", "line0", "mm"),
        ("c", "line0", "deg"),
    ]
    assert {row.severity for row in (*shown.axes, *shown.buses)} == {Severity.FINE}
    assert [round(row.rate_hz) for row in shown.axes] == [round(row.rate_wanted_hz) for row in shown.axes]
    assert headline(shown).endswith("axes: 4, lines: 1  ·  nothing is wrong")


async def test_a_move_shows_where_it_goes_and_who_has_control():
    async with running_rig() as rig, followed(rig) as glance:
        await rig.power_on("x")
        await rig.client.command("x", MoveAbsolute(position=20.0))
        moving = await until(glance, lambda now: any(row.target is not None for row in now.axes))
        (x,) = [row for row in moving.axes if row.axis == "x"]

    assert (x.state, x.moving, x.target) == (AxisState.DISCRETE_MOTION, Moving.YES, 20.0)
    assert "20.000" in "\n".join(as_text(moving))


async def test_an_axis_without_trouble_shows_how_its_last_command_ended():
    async with running_rig() as rig, followed(rig) as glance:
        await rig.power_on("x")
        await rig.client.command("x", MoveAbsolute(position=20.0))
        await rig.client.command("x", Halt())
        shown = await until(glance, lambda now: now.axes and now.axes[0].trouble.startswith("move"))

    assert (shown.axes[0].axis, shown.axes[0].severity) == ("x", Severity.FINE)
    assert shown.axes[0].trouble == "move_absolute: aborted by halt"
    assert "nothing is wrong" in headline(shown)  # an ordinary end


async def test_a_drive_that_lost_power_comes_first_and_says_so():
    chain = build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))
    async with running_rig(chains={"line0": chain}) as rig, followed(rig) as glance:
        await until(glance, lambda now: now.axes and now.axes[2].state)
        chain.modules[3].power(on=False, at_s=asyncio.get_running_loop().time())
        shown = await until(glance, lambda now: now.axes[0].severity is Severity.WRONG)

    assert (shown.axes[0].axis, shown.axes[0].link, shown.axes[0].moving) == ("c", LinkState.DOWN, Moving.UNKNOWN)
    assert "the drive does not answer" in "\n".join(as_text(shown))
    assert headline(shown).endswith("not working: 1 axis")


async def test_while_a_line_is_down_ages_grow():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        rig.daemon.rig.buses[0].bus._opener = never
        rig.daemon.rig.buses[0].bus.drop("a plug that is pulled")
        await asyncio.sleep(20)
        async with followed(rig) as glance:
            shown = await until(glance, lambda now: now.axes and now.axes[0].age_s)

    assert shown.axes[0].age_s > 18
    assert all(row.age_s > 18 for row in shown.axes if row.age_s is not None)


async def never():
    raise TransportLost("no such port")


@pytest.mark.long
async def test_who_begins_to_look_later_sees_the_same_age():
    chain = build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))
    async with running_rig(chains={"line0": chain}) as rig:
        await rig.until("c", lambda state: state.link is LinkState.UP)
        chain.modules[3].power(on=False, at_s=asyncio.get_running_loop().time())
        await rig.until("c", lambda state: state.link is LinkState.DOWN)
        await asyncio.sleep(30)
        async with followed(rig) as glance:
            shown = await until(glance, lambda now: now.axes and now.axes[0].age_s)
            (listed,) = [now for now in await overview(rig.client) if now.info.axis == "c"]
            healthy = [row.age_s for row in shown.axes[1:]]

    assert (shown.axes[0].axis, listed.age_s > 29) == ("c", True)
    assert abs(shown.axes[0].age_s - listed.age_s) < 2
    assert f", {shown.axes[0].age_s:.0f} s old" in shown.axes[0].shown_position
    assert all(age_s < 2 for age_s in healthy)


async def test_a_daemon_that_ended_is_said_to_be_silent_and_nothing_is_said_to_stand():
    async with running_rig() as rig, followed(rig) as glance:
        await until(glance, lambda now: now.buses)
        rig.daemon.end()
        shown = await until(glance, lambda now: now.trouble)

    assert {row.moving for row in shown.axes} == {Moving.UNKNOWN}
    assert "what is shown is what it said last" in headline(shown)
