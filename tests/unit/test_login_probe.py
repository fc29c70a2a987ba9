"""Why a connection was refused, as far as an endpoint tells without Zenoh."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from ldcnd.net.login_probe import refusals
from tests.support.process import free_port

pytestmark = pytest.mark.real_time


class Listener:
    """Takes one connection and hangs up."""

    def __init__(self) -> None:
        self._met: asyncio.Queue[asyncio.StreamWriter] = asyncio.Queue()

    def hang_up(self, _reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.close()
        self._met.put_nowait(writer)

    async def gone(self) -> None:
        """Wait until the connection is closed on this side, too."""
        async with asyncio.timeout(5):
            writer = await self._met.get()
            with contextlib.suppress(OSError):
                await writer.wait_closed()


@asynccontextmanager
async def listening(host: str) -> AsyncIterator[int]:
    listener = Listener()
    async with await asyncio.start_server(listener.hang_up, host, 0) as server:
        port: int = server.sockets[0].getsockname()[1]
        yield port
        await listener.gone()


async def test_where_nobody_listens_nobody_refuses(tmp_path: Path) -> None:
    endpoints = [
        f"tcp/127.0.0.1:{free_port()}",
        f"tls/127.0.0.1:{free_port()}",
        f"unixsock-stream/{tmp_path}/none",
        "tcp/no-port",
        "carrier/pigeon",
    ]

    assert await refusals(endpoints, None) == []


@pytest.mark.parametrize("suffix", ["", "?rel=1", "#iface=lo"])
async def test_who_answers_over_tcp_has_refused(suffix: str) -> None:
    async with listening("127.0.0.1") as port:
        (told,) = await refusals([f"tcp/127.0.0.1:{port}{suffix}"], None)

    assert f"127.0.0.1:{port}" in told
    assert "refuses this login" in told


async def test_an_ipv6_endpoint_is_understood() -> None:
    async with listening("::1") as port:
        (told,) = await refusals([f"tcp/[::1]:{port}"], None)

    assert "refuses this login" in told


async def test_who_hangs_up_on_tls_does_not_speak_it_or_is_silent() -> None:
    async with listening("127.0.0.1") as port:
        told = await refusals([f"tls/127.0.0.1:{port}"], None)

    assert told in ([], [f"tls/127.0.0.1:{port} answers but does not speak TLS"])


async def test_who_answers_on_a_socket_has_refused(tmp_path: Path) -> None:
    path = tmp_path / "s"
    listener = Listener()
    async with await asyncio.start_unix_server(listener.hang_up, path):
        (told,) = await refusals([f"unixsock-stream/{path}"], None)
        await listener.gone()

    assert told == f"unixsock-stream/{path} answers but refuses this login"
