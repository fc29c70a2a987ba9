"""What a survey of several rigs tells: all of them, and what is wrong with each."""

import asyncio
import signal
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

import pytest

from ldcnd.cli.looking import rig_table
from ldcnd.client.fleet import survey
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import MalformedRequest
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import LinkState
from ldcnd.daemon.assembly import build_daemon
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.process import LDCND
from tests.support.rig import EPOCH_NS, SIMULATED
from tests.support.session_pair import free_endpoint


def named(rig: str) -> RigConfig:
    return load_config(SIMULATED).model_copy(update={"rig": rig})


@asynccontextmanager
async def fleet(*rigs: tuple[str, str]) -> AsyncIterator[tuple[MemoryBroker, list]]:
    """Run a daemon for each rig and instance on one network."""
    loop = asyncio.get_running_loop()
    broker = MemoryBroker()
    async with AsyncExitStack() as sessions, asyncio.TaskGroup() as group:
        daemons, running = [], []
        for rig, instance in rigs:
            session = await sessions.enter_async_context(broker.session())
            daemon = build_daemon(named(rig), session, lambda: EPOCH_NS + round(loop.time() * 1e9), instance)
            daemons.append(daemon)
            running.append(group.create_task(daemon.run(), name=f"daemon {instance}"))
        try:
            async with asyncio.timeout(60):
                for daemon in daemons:
                    await daemon.wait_up()
            await asyncio.sleep(2.5)  # reports come once a second
            yield broker, daemons
        finally:
            for daemon in daemons:
                daemon.end()
            async with asyncio.timeout(60):
                for task in running:
                    await task


async def test_every_rig_is_listed_with_its_axes_and_is_well():
    async with fleet(("mill", "m1"), ("lathe", "l1")) as (broker, _), broker.session() as session:
        views = await survey(session)
        only = await survey(session, "mill")

    assert [(view.rig, view.instance, view.problems) for view in views] == [("lathe", "l1", ()), ("mill", "m1", ())]
    assert [view.rig for view in only] == ["mill"]
    for view in views:
        assert view.daemon
        assert view.health
        assert [axis.info.axis for axis in view.axes] == ["x", "y", "z", "c"]
        assert all(axis.state and axis.state.link is LinkState.UP for axis in view.axes)
        text = "\n".join(rig_table(view))
        assert text.startswith(f"{view.rig}  ldcnd {view.daemon.version}  run {view.instance}  well")
        assert "\n  x  ls-182ap " in text


async def test_a_daemon_that_is_alive_and_answers_nothing_is_told():
    async with fleet(("mill", "m1")) as (broker, _), broker.session() as frozen, broker.session() as session:
        await frozen.declare_token(Keys("lathe").alive("l9"))

        views = await survey(session)

    assert [(view.rig, view.instance) for view in views] == [("lathe", "l9"), ("mill", "m1")]
    assert "does not answer" in views[0].problems[0]
    assert "! is alive and does not answer" in "\n".join(rig_table(views[0]))
    assert views[1].problems == ()


async def test_a_frozen_daemon_keeps_nobody_waiting_for_ever():
    async with fleet(("mill", "m1")) as (broker, _), broker.session() as frozen, broker.session() as session:
        kept = []
        await frozen.declare_token(Keys("lathe").alive("l9"))
        await frozen.serve(Keys("lathe").all_meta, kept.append, complete=True)

        async with asyncio.timeout(10):
            views = await survey(session)
        for query in kept:
            query.finish()

    assert [view.rig for view in views] == ["lathe", "mill"]
    assert len(views[1].axes) == 4


async def test_two_daemons_on_one_rig_are_told():
    async with fleet(("mill", "m1"), ("mill", "m2")) as (broker, _), broker.session() as session:
        views = await survey(session)

    assert [view.instance for view in views] == ["m1", "m2"]
    assert all("another daemon serves this rig" in view.problems[0] for view in views)


async def test_a_line_that_is_lost_is_told_once_and_not_for_each_of_its_axes():
    async with fleet(("mill", "m1")) as (broker, (daemon,)), broker.session() as session:
        (bus,) = daemon.rig.buses
        bus.report = None
        await asyncio.sleep(1.5)

        (view,) = await survey(session)

    assert view.problems == ("line0: the line is not up",)


async def test_what_is_wrong_with_an_axis_is_told_in_words():
    async with fleet(("mill", "m1")) as (broker, _), broker.session() as session:
        await RigClient(session, "mill").stop("x")

        (view,) = await survey(session)

    assert view.problems == ("x: a stop is latched: nothing moves before reset",)


async def test_nobody_there_is_an_empty_list():
    broker = MemoryBroker()
    async with broker.session() as session:
        assert await survey(session) == ()


@pytest.mark.parametrize("key", ["", "ldcn", "ldcn/", "ldcn/x", "other/x/meta", "ldcn/X/meta", "ldcn/*/meta"])
def test_a_key_of_no_rig_is_refused(key):
    with pytest.raises(MalformedRequest):
        Keys.of(key)


@pytest.mark.real_time
@pytest.mark.long
async def test_the_fleet_is_shown_again_and_again_until_it_is_enough():
    endpoint = free_endpoint()
    async with open_zenoh_session(ZenohSettings(listen=(endpoint,))):
        words = (*LDCND, "fleet", "--watch", "0.5", "--connect", endpoint)
        watching = await asyncio.create_subprocess_exec(*words, stdout=DEVNULL, stderr=PIPE)
        try:
            assert watching.stderr
            async with asyncio.timeout(40):
                told = [await watching.stderr.readline() for _ in range(2)]
        finally:
            watching.send_signal(signal.SIGTERM)
            await watching.communicate()

    assert told == [b"no rig answers\n"] * 2
    assert watching.returncode == -signal.SIGTERM
