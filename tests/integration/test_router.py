"""Behind a router: it may come late, die and come back; nothing is carried out twice, and telemetry resumes."""

import asyncio
import time
from asyncio.subprocess import PIPE, STDOUT, create_subprocess_exec
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import TypeVar

import pytest

from ldcnd.client.rig_client import RigClient, Samples, find_rigs
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import CommandReply, MoveRelative, Power
from ldcnd.contract.errors import LdcndError, OutcomeUnknown, SessionError
from ldcnd.contract.samples import AxisState, PositionSample, StateSample
from ldcnd.daemon.assembly import build_daemon
from ldcnd.net.session import Session
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.support.process import LDCND, free_port
from tests.support.rig import SIMULATED
from tests.support.router import router

pytestmark = pytest.mark.real_time

AnswerT = TypeVar("AnswerT")
MOVES = 12
STEP = 0.25


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@asynccontextmanager
async def daemon_behind(endpoint: str) -> AsyncIterator[None]:
    """Serve the simulated rig over a router that need not be there."""
    settings = ZenohSettings(connect=(endpoint,))
    async with open_zenoh_session(settings) as session, asyncio.TaskGroup() as group:
        daemon = build_daemon(load_config(SIMULATED), session, time.time_ns, "routed")
        running = group.create_task(daemon.run(), name="daemon")
        try:
            async with asyncio.timeout(20):
                await daemon.wait_up()
            yield
        finally:
            daemon.end()
            await running


@asynccontextmanager
async def connected(endpoint: str) -> AsyncIterator[Session]:
    async with open_zenoh_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
        yield session


async def found(session: Session) -> RigClient:
    """Wait until the rig is seen."""
    async with asyncio.timeout(10):
        # nothing tells that a router has heard of a daemon
        while not (rigs := await find_rigs(session)):
            await asyncio.sleep(0.05)
    return RigClient(session, rigs[0].rig)


async def position_after(positions: Samples, seq: int) -> PositionSample:
    """Wait for a position that was published after another one."""
    async with asyncio.timeout(15):
        while True:
            _, sample = await anext(positions)
            assert isinstance(sample, PositionSample)
            if sample.seq > seq:
                return sample


async def ready(client: RigClient) -> None:
    """Close the loop of x."""
    await client.command("x", Power(on=True))
    async with client.samples("x", "state") as states:
        while True:
            _, state = await anext(states)
            if isinstance(state, StateSample) and state.state is AxisState.STANDSTILL:
                return


async def insist(ask: Callable[[], Awaitable[AnswerT]]) -> AnswerT:
    """Ask until there is an answer."""
    while True:
        try:
            return await ask()
        except (OutcomeUnknown, SessionError):
            await asyncio.sleep(0.05)  # the router is away


async def move(client: RigClient, number: int) -> CommandReply:
    """Send one move, under one id, until it is answered, and wait for its end; what a careful client does."""
    request = MoveRelative(distance=STEP, command_id=f"move-{number}", instance="routed")
    reply = await insist(lambda: client.command("x", request, timeout_s=0.5))
    await insist(lambda: client.wait_for_end("x", reply.command_id))
    return reply


async def test_a_router_that_comes_late_is_found(endpoint: str) -> None:
    async with daemon_behind(endpoint):
        with pytest.raises(LdcndError, match="cannot connect"):
            async with connected(endpoint):
                pass

        async with router(endpoint), connected(endpoint) as session:
            client = await found(session)
            async with client.samples("x", "position") as positions:
                sample = await position_after(positions, 0)

    assert sample.unit == "mm"


@pytest.mark.long
async def test_a_router_killed_under_load_makes_no_move_happen_twice_and_telemetry_resumes(endpoint: str) -> None:
    async with daemon_behind(endpoint), asyncio.TaskGroup() as group:
        async with router(endpoint) as first, connected(endpoint) as session:
            client = await found(session)
            await ready(client)
            async with client.samples("x", "position") as positions:
                before = await position_after(positions, 0)

                async def all_moves() -> list[CommandReply]:
                    return [await move(client, number) for number in range(MOVES)]

                moves = group.create_task(all_moves(), name="moves")
                await position_after(positions, before.seq + 2)
                first.kill()
                await first.wait()
                assert not moves.done()
                async with router(endpoint):
                    await position_after(positions, before.seq + 20)
                    replies = await moves
                    end = await client.wait_for_end("x", replies[-1].command_id)
                    async with client.samples("x", "position") as fresh:
                        reached = await position_after(fresh, before.seq + 20)

    targets = [reply.position for reply in replies]
    assert targets == pytest.approx([STEP * number for number in range(1, MOVES + 1)])
    assert end.state is AxisState.STANDSTILL
    assert reached.value == pytest.approx(STEP * MOVES, abs=0.05)


async def ended(*words: str) -> tuple[int | None, str]:
    """Run a command that fails and return its exit code and what it printed."""
    process = await create_subprocess_exec(*LDCND, *words, stdout=PIPE, stderr=STDOUT)
    async with asyncio.timeout(20):
        printed, _ = await process.communicate()
    return process.returncode, printed.decode()


@pytest.mark.long
async def test_a_daemon_whose_port_is_busy_says_so_and_ends(endpoint: str) -> None:
    async with router(endpoint):
        code, printed = await ended("run", "--config", str(SIMULATED), "--listen", endpoint)

    assert code == 3
    assert f"cannot listen on {endpoint}: the port is in use" in printed
    assert "another ldcnd or a Zenoh router" in printed


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("tcp/192.0.2.1:7447", "cannot listen on tcp/192.0.2.1:7447: this machine has no such address"),
        ("127.0.0.1:7447", "127.0.0.1:7447"),
        ("tpc/127.0.0.1:7447", "cannot use tpc/127.0.0.1:7447"),
    ],
)
@pytest.mark.sweep(3)
async def test_a_daemon_with_a_wrong_endpoint_names_it_and_ends(wrong: str, words: str) -> None:
    code, printed = await ended("run", "--config", str(SIMULATED), "--listen", wrong)

    assert code in (3, 78)
    assert words in printed
    assert "Traceback" not in printed
