"""The blocking client over real Zenoh: results, errors, iterators and contexts as those of the asyncio client."""

import asyncio
import inspect
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from ldcnd.client import blocking
from ldcnd.client.connecting import at
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import load_config
from ldcnd.daemon.process.assembly import build_daemon
from ldcnd.errors import LeaseHeld, SessionError, UnknownAxis
from ldcnd.messaging.zenoh_session import open_zenoh_session
from ldcnd.messaging.zenoh_settings import ZenohSettings
from ldcnd.model.commands import MoveAbsolute, Power
from ldcnd.model.samples import AxisState, PositionSample, TelemetryItem
from tests.support.rig import SIMULATED
from tests.support.session_pair import free_endpoint

NOT_FOR_ONE_CALL = {"samples", "published", "health", "command_events"}
"""Contexts, which have facades of their own or are for programs with an event loop."""
PARTS = {"rig_command", "axis_question", "trace_header", "trace_chunk"}
"""What other calls are made of."""


@asynccontextmanager
async def served() -> AsyncIterator[str]:
    """Serve the simulated rig; yields its endpoint."""
    endpoint = free_endpoint()
    async with open_zenoh_session(ZenohSettings(listen=(endpoint,))) as session, asyncio.TaskGroup() as group:
        daemon = build_daemon(load_config(SIMULATED), session, time.time_ns, "blocking")
        running = group.create_task(daemon.run(), name="daemon")
        try:
            async with asyncio.timeout(20):
                await daemon.wait_up()
            yield endpoint
        finally:
            daemon.end()
            await running


def test_no_call_of_the_asyncio_client_is_missing():
    calls = {name for name, call in inspect.getmembers(RigClient, callable) if not name.startswith("_")}

    assert calls - NOT_FOR_ONE_CALL - PARTS <= set(dir(blocking.Rig))
    assert blocking.Rig.axes.__doc__ == RigClient.axes.__doc__


@pytest.mark.real_time
async def test_a_program_without_a_loop_does_what_one_with_a_loop_does():
    def program(endpoint: str) -> None:
        with blocking.open_rig(at(endpoint)) as rig:
            assert [axis.axis for axis in rig.axes()] == ["x", "y", "z", "c"]
            assert isinstance(rig.last("x", TelemetryItem.POSITION), PositionSample)
            with pytest.raises(UnknownAxis):
                rig.command("nowhere", Power(on=True))
            with rig.events() as events, rig.control("ann", "x", lease_s=0.5) as held:
                with pytest.raises(LeaseHeld), rig.control("bob", "x"):
                    pass
                held.command("x", Power(on=True))
                move = held.command("x", MoveAbsolute(position=3.0, velocity=2.0))
                with rig.follow(move) as motion:
                    steps = list(motion)
                end = rig.wait_for_end("x", move.command_id)
                told = [next(events).verb for _ in range(2)]
            with rig.samples("y", "position") as samples:
                axis, _ = next(samples)
        assert steps[0].left >= steps[-1].left
        assert (end.state, end.last_error, axis) == (AxisState.STANDSTILL, None, "y")
        assert told == ["power", "power"]
        (seen,) = blocking.fleet(at(endpoint))
        assert seen.rig == "sim"

    async with served() as endpoint:
        await asyncio.to_thread(program, endpoint)

    assert "ldcnd client" not in {thread.name for thread in threading.enumerate()}


@pytest.mark.real_time
def test_what_cannot_be_opened_is_an_error_and_leaves_no_thread():
    with pytest.raises(SessionError), blocking.open_rig(at(free_endpoint())):
        pass

    assert "ldcnd client" not in {thread.name for thread in threading.enumerate()}


@pytest.mark.real_time
async def test_the_error_of_the_program_itself_ends_everything_in_order():
    def program(endpoint: str) -> None:
        with blocking.open_rig(at(endpoint)) as rig, rig.control("ann", "x"), rig.samples():
            raise ZeroDivisionError

    async with served() as endpoint:
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(program, endpoint)

    assert "ldcnd client" not in {thread.name for thread in threading.enumerate()}
