"""Connections that send half a request, or none, keep nobody from the console's stop and from the metrics."""

import asyncio
import itertools
import re
import resource
import socket
from contextlib import ExitStack

import pytest
from prometheus_client import CollectorRegistry
from uvicorn import Config
from uvicorn.server import ServerState

from ldcnd.console import connections
from ldcnd.lab import metrics
from ldcnd.lab.metrics import metrics_server
from tests.support.browser import console
from tests.support.process import free_port

pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(120)]

HALF = b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: "
ALLOWANCE_S = 10.0
"""A busy machine may take so much longer."""
DESCRIPTORS = 200
"""Of the console in the test; a service has 1024, which takes more connections and no more skill."""


def half_sent(stack, port, count):
    """Open connections that never finish their request."""
    for _ in range(count):
        slow = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
        slow.sendall(HALF)


async def test_a_stop_gets_through_past_hundreds_of_half_sent_requests():
    async with console("-e", f"tcp/127.0.0.1:{free_port()}") as running:
        _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.prlimit(running.process.pid, resource.RLIMIT_NOFILE, (DESCRIPTORS, hard))
        browser = await running.stranger.enter(running.link)
        port = int(re.search(r":(\d+)/", running.link)[1])
        with ExitStack() as stack:
            await asyncio.to_thread(half_sent, stack, port, 2 * DESCRIPTORS)
            async with asyncio.timeout(10):
                stopped = await browser.post("/api/stop")
                again = await browser.post("/api/stop")

    assert (stopped.status, again.status) == (200, 200)


async def test_a_half_sent_request_is_given_up(monkeypatch):
    monkeypatch.setattr(metrics, "CONNECTION_TIME_S", 0.2)
    async with metrics_server(CollectorRegistry(), "127.0.0.1", 0) as port:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(HALF)
        async with asyncio.timeout(10):
            assert await reader.read() == b""
        writer.close()


async def test_metrics_come_once_the_slow_ones_are_gone_and_nothing_else_is_served(monkeypatch):
    monkeypatch.setattr(metrics, "CONNECTION_TIME_S", 1.0)
    async with metrics_server(CollectorRegistry(), "127.0.0.1", 0) as port:
        with ExitStack() as stack:
            await asyncio.to_thread(half_sent, stack, port, 2 * metrics.MOST_CONNECTIONS)
            async with asyncio.timeout(20):
                answer = b""
                while not answer.startswith(b"HTTP/1.1 200"):
                    answer = await asked(port, b"GET /metrics HTTP/1.1\r\nAccept: text/plain\r\n\r\n")
        refused = [await asked(port, line) for line in (b"POST / HTTP/1.1\r\n\r\n", b"GET /etc HTTP/1.1\r\n\r\n")]

    assert b"Content-Type: text/plain" in answer
    assert [line.split()[1] for line in refused] == [b"405", b"404"]


async def asked(port, request):
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(request)
        writer.write_eof()
        return await reader.read()
    except ConnectionError:
        return b""
    finally:
        writer.transport.abort()


class Wire(asyncio.Transport):
    """A connection as a protocol sees it."""

    def __init__(self):
        super().__init__()
        self.closed = False
        self.written = b""

    def write(self, data):
        self.written += data

    def is_closing(self):
        return self.closed

    def close(self):
        self.closed = True

    abort = close


async def test_the_console_gives_up_a_request_that_trickles(monkeypatch):
    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    monkeypatch.setattr(connections, "HEAD_TIME_S", 0.3)
    config = Config(app, lifespan="off", log_config=None, access_log=False)
    config.load()
    wire = Wire()
    protocol = connections.BoundedH11(config, ServerState(), {})
    protocol.connection_made(wire)
    protocol.data_received(b"GET / HTTP/1.1\r\nhost: a\r\n\r\n")
    async with asyncio.timeout(10):
        while not wire.written.endswith(b"\r\n\r\n"):
            await asyncio.sleep(0.01)
        for byte in itertools.chain(HALF, itertools.repeat(ord("x"))):
            if wire.closed:
                break
            protocol.data_received(bytes([byte]))
            await asyncio.sleep(0.02)
    protocol.connection_lost(None)


async def test_a_page_whose_browser_does_not_answer_is_gone_after_five_seconds():
    async with console("-e", f"tcp/127.0.0.1:{free_port()}") as running:
        browser = await running.stranger.enter(running.link)
        port = int(re.search(r":(\d+)/", running.link)[1])
        usual = {"origin": browser.origin, "upgrade": "websocket", "connection": "Upgrade"}
        usual |= {"sec-websocket-key": "AAAAAAAAAAAAAAAAAAAAAA==", "sec-websocket-version": "13"}
        lines = [f"{name}: {text}" for name, text in browser.headers(usual).items()]
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write("\r\n".join(["GET /api/page HTTP/1.1", *lines, "", ""]).encode())
        loop = asyncio.get_running_loop()
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 101")
        opened_at_s = loop.time()
        async with asyncio.timeout(60):
            while await reader.read(4096):  # greeting and pings; no pong is ever sent
                pass
        lasted_s = loop.time() - opened_at_s
        writer.close()

    assert 4 < lasted_s < 5 + ALLOWANCE_S
