"""Traps of Zenoh that nothing else walks into."""

import asyncio
import gc
import json
import signal
import sys
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import load_config
from ldcnd.contract.codec import decode
from ldcnd.contract.commands import ErrorReply
from ldcnd.contract.errors import ErrorCode, ValueOutOfRange
from ldcnd.contract.keys import Keys
from ldcnd.contract.questions import ReportShadow, Why
from ldcnd.contract.samples import StateSample
from ldcnd.daemon.assembly import build_daemon
from ldcnd.net.hand_over import Query
from ldcnd.net.session import Qos, Session
from ldcnd.net.zenoh_config import endpoints, zenoh_config
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import LEASE_MS, ZenohSettings
from tests.support.rig import SIMULATED
from tests.support.router import router
from tests.support.session_pair import JSON, KEYS, POSITION, Pair, echo, free_endpoint, served, subscribed, until

pytestmark = pytest.mark.real_time

HOLDER = """
import asyncio, sys
from ldcnd.net.zenoh_session import ZenohSettings, open_zenoh_session
async def main():
    async with open_zenoh_session(ZenohSettings(connect=(sys.argv[1],), mode="client")) as session:
        await session.declare_token("ldcn/bench1/alive/frozen")
        await asyncio.to_thread(sys.stdin.read)
asyncio.run(main())
"""


@asynccontextmanager
async def serving_daemon(session: Session, instance: str) -> AsyncIterator[None]:
    """Serve the simulated rig over a session."""
    async with asyncio.TaskGroup() as group:
        daemon = build_daemon(load_config(SIMULATED), session, time.time_ns, instance)
        running = group.create_task(daemon.run(), name=f"daemon {instance}")
        try:
            async with asyncio.timeout(20):
                await daemon.wait_up()
            yield
        finally:
            daemon.end()
            await running


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
async def pair(endpoint: str) -> AsyncIterator[Pair]:
    async with (
        open_zenoh_session(ZenohSettings(listen=(endpoint,))) as server,
        open_zenoh_session(ZenohSettings(connect=(endpoint,), mode="client")) as client,
    ):
        yield Pair(server, client)


def test_nothing_is_scouted_for_or_listened_on_unless_it_is_said():
    config = zenoh_config(ZenohSettings(listen=("tcp/127.0.0.1:1",)))

    assert endpoints(config, "listen") == ("tcp/127.0.0.1:1",)
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    assert json.loads(config.get_json("scouting/gossip/enabled")) is False


def test_what_keeps_hardware_safe_holds_whatever_the_file_says(tmp_path: Path):
    file = tmp_path / "careless.json5"
    file.write_text("""{
        timestamping: { enabled: false },
        listen: { exit_on_failure: false },
        transport: {
            shared_memory: { enabled: true },
            link: { tx: { lease: 60000 } },
            unicast: { lowlatency: true, qos: { enabled: false } },
        },
    }""")

    config = zenoh_config(ZenohSettings(config_file=file))

    assert json.loads(config.get_json("transport/shared_memory/enabled")) is False
    assert json.loads(config.get_json("transport/unicast/lowlatency")) is False
    assert json.loads(config.get_json("timestamping/enabled")) is True
    assert json.loads(config.get_json("listen/exit_on_failure")) is True
    assert json.loads(config.get_json("transport/link/tx/lease")) == LEASE_MS


async def test_what_is_declared_outlives_its_reference(pair: Pair):
    await pair.server.declare_token(KEYS.alive("kept"))
    await pair.server.serve(KEYS.all_commands, echo, complete=True)

    gc.collect()

    await served(pair.client, KEYS.command("x", "halt"))
    seen: list[str] = []
    await pair.client.watch_tokens(KEYS.all_alive, lambda key, _alive: seen.append(key))

    async def shown() -> bool:
        return seen == [KEYS.alive("kept")]

    await until(shown)


async def test_declarations_and_queries_take_no_threads_of_their_own(pair: Pair):
    await pair.server.serve(KEYS.all_commands, echo, complete=True)
    await served(pair.client, KEYS.command("x", "halt"))
    before = own_threads()

    for number in range(50):
        await pair.client.subscribe(KEYS.telemetry("x", f"item{number}"), print)
        await pair.server.serve(KEYS.schema(f"s{number}"), echo, complete=True)
    async with asyncio.TaskGroup() as group:
        for _ in range(50):
            group.create_task(pair.client.query(KEYS.command("x", "halt")), name="ask")

    assert own_threads() <= before


@pytest.mark.parametrize("timeout_s", [0.0, -1.0])
async def test_a_query_without_time_is_refused_instead_of_taking_zenohs_default(pair: Pair, timeout_s: float):
    with pytest.raises(ValueOutOfRange):
        await pair.client.query(POSITION, timeout_s=timeout_s)


async def test_of_two_queryables_behind_one_router_one_is_asked(endpoint: str):
    executed: list[str] = []

    def executing(name: str, query: Query) -> None:
        if query.payload:
            executed.append(name)
        echo(query)

    async with (
        router(endpoint),
        open_zenoh_session(ZenohSettings(connect=(endpoint,))) as one,
        open_zenoh_session(ZenohSettings(connect=(endpoint,))) as two,
        open_zenoh_session(ZenohSettings(connect=(endpoint,), mode="client")) as client,
    ):
        await one.serve(KEYS.all_commands, lambda query: executing("one", query), complete=True)
        await two.serve(KEYS.all_commands, lambda query: executing("two", query), complete=True)
        await served(client, KEYS.command("x", "halt"))

        answers = await client.query(KEYS.command("x", "halt"), b"{}")

    assert (len(answers), len(executed)) == (1, 1)


async def test_two_daemons_that_are_both_asked_both_refuse(pair: Pair, endpoint: str):
    # one listens and the other connects to it: Zenoh then asks both, whatever they declare
    async with (
        open_zenoh_session(ZenohSettings(connect=(endpoint,))) as second,
        serving_daemon(pair.server, "first"),
        serving_daemon(second, "second"),
    ):
        power = Keys("sim").command("x", "power")
        codes: list[ErrorCode] = []

        async def both() -> bool:
            answers = await pair.client.query(power, b'{"on": true}')
            codes[:] = [decode(ErrorReply, one.payload, one.encoding).code for one in answers if one.is_error]
            return len(answers) == 2

        await until(both)
        rig = RigClient(pair.client, "sim")

        states: list[StateSample] = []

        async def known() -> bool:  # the queryables of a daemon reach the client one after another
            states[:] = [state] if (state := await rig.state("x")) else []
            return bool(states)

        await until(known)

    assert codes == [ErrorCode.DUPLICATE_DAEMON] * 2
    assert [state.enabled for state in states] == [False]


async def test_answers_are_kept_although_they_have_one_key(pair: Pair, endpoint: str):
    async with open_zenoh_session(ZenohSettings(connect=(endpoint,), mode="client")) as other:
        for session in (pair.server, other):
            await session.serve(KEYS.all_telemetry, lambda query: query.reply(b"1", JSON), complete=False)

        async def both() -> bool:
            return len(await pair.client.query(POSITION)) == 2

        await until(both)


@pytest.mark.parametrize("at_ns", [-1, 2**32 * 10**9, 2**63 - 1])
async def test_an_instant_that_zenoh_cannot_stamp_ends_neither_daemon_nor_reads(pair: Pair, at_ns: int):
    """Its time stamps end in 2106 and begin in 1970; elsewhere it raises, or panics, where none may be caught."""

    def at_that_instant(query: Query) -> Iterator[None]:
        query.reply(b"1", JSON, key=POSITION, measured_at_ns=at_ns)
        query.finish()
        yield

    await pair.server.serve_reads(POSITION, at_that_instant, complete=False)
    await served(pair.client, POSITION)
    samples = await subscribed(pair.server, pair.client)
    pair.server.publisher(POSITION, encoding=JSON, qos=Qos.TELEMETRY)(b"2", at_ns)
    async with asyncio.timeout(2):
        assert (await samples.get()).payload == b"2"

    async with serving_daemon(pair.server, "one"):
        report = ReportShadow(t=max(at_ns, 0), learning=True, judged=0)
        assert await RigClient(pair.client, "sim").ask(report, "x")
        assert await RigClient(pair.client, "sim").ask(Why(), "x")


async def test_the_token_of_a_frozen_program_vanishes_within_its_lease(pair: Pair, endpoint: str):
    loop = asyncio.get_running_loop()
    changes: asyncio.Queue[bool] = asyncio.Queue()
    await pair.server.watch_tokens(KEYS.all_alive, lambda _, alive: changes.put_nowait(alive))
    holder = await asyncio.create_subprocess_exec(
        sys.executable, "-c", HOLDER, endpoint, cwd=Path(__file__).parents[2], stdin=asyncio.subprocess.PIPE
    )
    try:
        async with asyncio.timeout(10):
            assert await changes.get() is True
        holder.send_signal(signal.SIGSTOP)
        began_s = loop.time()
        async with asyncio.timeout(10):
            assert await changes.get() is False
        vanished_s = loop.time() - began_s
    finally:
        holder.kill()
        await holder.communicate()

    assert vanished_s < LEASE_MS / 1000 + 1


def own_threads() -> set[str]:
    # those that Zenoh's runtime called back on stay known to Python as dummies
    return {thread.name for thread in threading.enumerate() if not isinstance(thread, threading._DummyThread)}
