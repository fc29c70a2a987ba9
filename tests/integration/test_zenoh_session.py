"""The session on real Zenoh: everything a session promises, and that nobody else can hold it up."""

import asyncio
import signal
import sys
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import zenoh

from ldcnd.contract.errors import ConfigError, SessionError
from ldcnd.net.hand_over import PENDING_QUERIES, Query
from ldcnd.net.session import Qos, Session
from ldcnd.net.zenoh_session import ZenohSettings, open_zenoh_session
from tests.support.query_facts import QueryFacts
from tests.support.session_facts import SampleFacts, TokenFacts
from tests.support.session_pair import JSON, KEYS, POSITION, Pair, echo, free_endpoint, served, subscribed, until

pytestmark = pytest.mark.real_time

CLIENT = """
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", '["' + sys.argv[1] + '"]')
config.insert_json5("transport/link/tx/lease", "60000")
session = zenoh.open(config)
subscriber = session.declare_subscriber("ldcn/**", zenoh.handlers.RingChannel(1))
asked = session.get("ldcn/bench1/@cmd/x/halt", payload=b"{}", timeout=60)
print("ready", flush=True)
sys.stdin.read()
session.close()
"""
"""A client that asks a question and reads samples, and whose silence is only noticed after a minute."""

DAEMON = """
import asyncio, sys
from ldcnd.net.session import Qos
from ldcnd.net.zenoh_session import ZenohSettings, open_zenoh_session
async def main():
    asked = asyncio.Queue()
    async with open_zenoh_session(ZenohSettings(listen=(sys.argv[1],))) as session:
        await session.serve("ldcn/bench1/@cmd/**", asked.put_nowait, complete=True)
        await session.subscribe("ldcn/**", lambda sample: None)
        await session.watch_tokens("ldcn/**", print)
        print("ready", flush=True)
        if len(sys.argv) > 2:
            query = await asked.get()
            print("asked", flush=True)
            await asyncio.to_thread(sys.stdin.readline)
            query.reply(bytes(2_000_000), "application/json")
            for _ in range(3000):
                session.publish("ldcn/x", bytes(4096), encoding="application/json", qos=Qos.EVENT)
        raise SystemExit(7)
asyncio.run(main())
"""
"""A session whose program fails, with an argument only once a client is stuck."""


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


@asynccontextmanager
async def program(code: str, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a program and return once it has said a line."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", code, *arguments, cwd=Path(__file__).parents[2],
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        await said(process)
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


async def said(process: asyncio.subprocess.Process) -> None:
    assert process.stdout
    async with asyncio.timeout(10):
        assert await process.stdout.readline()


@asynccontextmanager
async def stuck_client(endpoint: str, server: Session) -> AsyncIterator[list[Query]]:
    """Freeze a client that reads samples and waits for an answer; yields its question."""
    asked: list[Query] = []
    await server.serve(
        KEYS.all_commands, lambda query: asked.append(query) if query.payload else echo(query), complete=True
    )

    async def has_asked() -> bool:
        return bool(asked)

    async with program(CLIENT, endpoint) as client:
        await until(has_asked)
        client.send_signal(signal.SIGSTOP)
        yield asked


class TestZenohSession(SampleFacts, QueryFacts, TokenFacts):
    """The shared facts, over TCP."""


def flood(session: Session) -> None:
    """Publish more than any buffer on the way to a frozen reader holds."""
    for _ in range(3000):
        session.publish(POSITION, bytes(4096), encoding=JSON, qos=Qos.TELEMETRY)


def own_threads() -> set[threading.Thread]:
    # those that Zenoh's runtime called back on stay known to Python as dummies
    return {thread for thread in threading.enumerate() if not isinstance(thread, threading._DummyThread)}


async def test_a_frozen_client_holds_up_neither_publishing_nor_stops_nor_closing(pair: Pair, endpoint: str) -> None:
    loop = asyncio.get_running_loop()
    for key in KEYS.all_stops:
        await pair.server.serve(key, echo, complete=True, urgent=True)
    await served(pair.client, KEYS.stop("x"))

    async with stuck_client(endpoint, pair.server) as asked:
        began_s = loop.time()
        flood(pair.server)
        published_s = loop.time() - began_s
        # more than its link takes, so that the workers wait for it
        for query in asked:
            query.reply(bytes(2_000_000), JSON)
        began_s = loop.time()
        answers = await pair.client.query(KEYS.stop("x"), urgent=True)
        stopped_s = loop.time() - began_s
        began_s = loop.time()
        await pair.server.close()
        closed_s = loop.time() - began_s

    assert published_s < 2
    assert (len(answers), stopped_s < 1) == (1, True)
    assert closed_s < 3


async def test_state_changes_of_a_whole_rig_at_once_all_arrive(pair: Pair) -> None:
    """A stop or a lost line changes the states and faults of all axes in one turn of the loop."""
    burst = [f"{KEYS.telemetry('x', 'state')}/{number}" for number in range(2 * 31)]
    samples = await subscribed(pair.server, pair.client)

    for key in burst:
        pair.server.publish(key, b"x" * 300, encoding=JSON, qos=Qos.EVENT)

    async with asyncio.timeout(10):
        arrived = [(await samples.get()).key for _ in burst]
    assert arrived == burst


async def test_a_subscriber_that_never_drains_does_not_delay_a_stop(pair: Pair, endpoint: str) -> None:
    for key in KEYS.all_stops:
        await pair.server.serve(key, echo, complete=True, urgent=True)
    await served(pair.client, KEYS.stop("x"))
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    other = await asyncio.to_thread(zenoh.open, config)
    undrained = other.declare_subscriber("ldcn/**", zenoh.handlers.FifoChannel(1))
    loop = asyncio.get_running_loop()

    try:
        flood(pair.server)
        began_s = loop.time()
        answers = await pair.client.query(KEYS.stop("x"), urgent=True)
        stopped_s = loop.time() - began_s
    finally:
        await pair.server.close()
        del undrained
        await asyncio.to_thread(other.close)

    assert (len(answers), stopped_s < 1) == (1, True)


async def test_answers_wait_for_no_client_that_takes_none(endpoint: str) -> None:
    released = threading.Event()
    async with (
        open_zenoh_session(ZenohSettings(listen=(endpoint,))) as server,
        open_zenoh_session(ZenohSettings(connect=(endpoint,), mode="client")) as client,
    ):
        await server.serve(KEYS.all_commands, echo, complete=True)
        for key in KEYS.all_stops:
            await server.serve(key, echo, complete=True, urgent=True)
        await served(client, KEYS.stop("x"))
        await served(client, KEYS.command("x", "halt"))

        # what answers to a client do that never reads
        for workers in (server._command_workers, server._urgent_workers, server._read_workers):
            for _ in range(PENDING_QUERIES // 2):
                workers.submit(lambda: released.wait(5) and None)
        commands = await client.query(KEYS.command("x", "halt"), timeout_s=1)
        stops = await client.query(KEYS.stop("x"), urgent=True, timeout_s=1)
        released.set()

    assert (len(commands), len(stops)) == (1, 1)


async def test_a_busy_port_is_explained(pair: Pair, endpoint: str) -> None:
    with pytest.raises(SessionError) as caught:
        async with open_zenoh_session(ZenohSettings(listen=(endpoint,))):
            pass

    assert caught.value.message == f"cannot listen on {endpoint}: the port is in use"
    assert caught.value.remedy is not None


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            ZenohSettings(listen=("tcp/192.0.2.1:7447",)),
            "cannot listen on tcp/192.0.2.1:7447: this machine has no such",
        ),
        (ZenohSettings(connect=("tcp/127.0.0.1:9",), mode="client"), "cannot connect to tcp/127.0.0.1:9"),
        (
            ZenohSettings(connect=("tcp/127.0.0.1:9", "tls/bench.invalid:7447"), mode="client"),
            "tls/bench.invalid:7447: the name bench.invalid does not resolve",
        ),
        (ZenohSettings(listen=("tcp/bench.invalid:7447",)), "tcp/bench.invalid:7447: its host name does not resolve"),
        (ZenohSettings(mode="client"), "none is configured"),
        (ZenohSettings(listen=("carrier/pigeon",)), "carrier"),
    ],
)
async def test_an_endpoint_that_cannot_be_used_is_named(settings: ZenohSettings, words: str) -> None:
    with pytest.raises(SessionError) as caught:
        async with open_zenoh_session(settings):
            pass

    assert words in caught.value.message
    assert ".rs:" not in caught.value.message


@pytest.mark.parametrize("text", [None, "{", "{modee: 'peer'}"])
async def test_a_configuration_file_that_cannot_be_used_is_named(tmp_path: Path, text: str | None) -> None:
    file = tmp_path / "zenoh.json5"
    if text is not None:
        file.write_text(text)

    with pytest.raises(ConfigError) as caught:
        async with open_zenoh_session(ZenohSettings(config_file=file)):
            pass

    assert str(file) in caught.value.message
    assert ".rs:" not in caught.value.message


async def test_a_socket_whose_folder_is_missing_is_a_configuration_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"there is no folder {tmp_path}/run$"):
        async with open_zenoh_session(ZenohSettings(listen=(f"unixsock-stream/{tmp_path}/run/operator.sock",))):
            pass


async def test_a_malformed_endpoint_is_a_configuration_error() -> None:
    with pytest.raises(ConfigError, match="nonsense"):
        async with open_zenoh_session(ZenohSettings(listen=("nonsense",))):
            pass


async def test_a_configuration_file_keeps_its_endpoints(tmp_path: Path, endpoint: str) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(f'{{listen: {{endpoints: ["{endpoint}"]}}}}')

    async with (
        open_zenoh_session(ZenohSettings(config_file=file)) as server,
        open_zenoh_session(ZenohSettings(connect=(endpoint,), mode="client")) as client,
    ):
        await server.serve(KEYS.all_telemetry, echo, complete=False)
        await served(client, POSITION)


async def test_a_session_leaves_no_thread_behind(endpoint: str) -> None:
    before = own_threads()

    async with open_zenoh_session(ZenohSettings(listen=(endpoint,))) as session:
        await session.subscribe("ldcn/**", print)
        await session.serve(KEYS.all_commands, echo, complete=True)
        session.publish("other/key", b"1", encoding=JSON, qos=Qos.BULK)
        during = own_threads()

    async def gone() -> bool:
        return own_threads() <= before

    await until(gone)
    # threads of an earlier session may end meanwhile
    assert during - before


@pytest.mark.long
async def test_the_interpreter_exits_when_the_program_fails_inside_a_session(endpoint: str) -> None:
    async with program(DAEMON, endpoint) as daemon, asyncio.timeout(5):
        assert await daemon.wait() == 7


@pytest.mark.long
async def test_the_interpreter_exits_although_a_client_is_stuck(endpoint: str) -> None:
    async with program(DAEMON, endpoint, "stuck") as daemon, program(CLIENT, endpoint) as client:
        await said(daemon)
        client.send_signal(signal.SIGSTOP)
        assert daemon.stdin
        daemon.stdin.write(b"go\n")

        async with asyncio.timeout(5):
            assert await daemon.wait() == 7


async def test_a_query_that_names_no_link_of_the_daemon_has_no_login(pair: Pair) -> None:
    logins: list[str | None] = []

    def take(query: Query) -> None:
        logins.append(query.login)
        echo(query)

    await pair.server.serve(KEYS.all_commands, take, complete=True)
    await served(pair.client, KEYS.command("x", "halt"))  # over a link without a certificate

    assert set(logins) == {None}


async def test_what_a_link_shows_of_its_login_is_kept_until_it_goes(endpoint: str) -> None:
    def take(query: Query) -> None:
        assert query.login is None
        echo(query)

    async with open_zenoh_session(ZenohSettings(listen=(endpoint,))) as server:
        await server.serve(KEYS.all_commands, take, complete=True)
        async with open_zenoh_session(ZenohSettings(connect=(endpoint,), mode="client")) as client:
            await served(client, KEYS.command("x", "halt"))

            assert set(server._logins.values()) == {None}

        async def forgotten() -> bool:
            return not server._logins

        await until(forgotten)


@pytest.mark.long
async def test_queries_in_order_do_not_overtake_each_other(pair: Pair):
    """Commands are numbered: one that is overtaken is refused."""
    came: list[bytes] = []

    def answer(query: Query) -> None:
        came.append(query.payload)
        query.reply(b"", JSON)

    sent, key = [str(number).encode() for number in range(600)], KEYS.command("x", "jog")
    await pair.server.serve(KEYS.all_commands, answer, complete=True)
    await served(pair.client, key)
    came.clear()
    for at in range(0, len(sent), 12):
        await asyncio.gather(*(pair.client.query(key, each, in_order=True) for each in sent[at : at + 12]))

    assert came == sent
