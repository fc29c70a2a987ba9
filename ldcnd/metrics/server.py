"""Metrics over HTTP, for scrapers: GET only, one request a connection, bounded in number and time.

The server of prometheus_client has a thread for each connection and waits for a slow one for ever.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder

MOST_CONNECTIONS = 32
"""One more is closed at once."""
CONNECTION_TIME_S = 5.0
"""From the connection until the answer has been taken."""
HEAD_BYTES = 8192
PATHS = frozenset({"/", "/metrics"})


@asynccontextmanager
async def metrics_server(registry: CollectorRegistry, host: str, port: int) -> AsyncIterator[int]:
    """Serve the metrics of a registry for the time of the context; yields the port.

    Raises:
        OSError: the address cannot be listened on.
    """
    open_now = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal open_now
        open_now += 1
        try:
            if open_now <= MOST_CONNECTIONS:
                async with asyncio.timeout(CONNECTION_TIME_S):
                    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
                    writer.write(_answer(registry, head))
                    await writer.drain()
                    writer.write_eof()
                    await reader.read()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the client gets no answer
        finally:
            open_now -= 1
            writer.transport.abort()

    server = await asyncio.start_server(serve, host, port, limit=HEAD_BYTES)
    async with server:
        yield server.sockets[0].getsockname()[1]


def _answer(registry: CollectorRegistry, head: str) -> bytes:
    request, *fields = head.split("\r\n")
    method, _, rest = request.partition(" ")
    if method not in {"GET", "HEAD"}:
        return _response("405 Method Not Allowed", "text/plain", b"")
    if rest.partition(" ")[0].partition("?")[0] not in PATHS:
        return _response("404 Not Found", "text/plain", b"see /metrics\n")
    names = dict(field.lower().split(":", 1) for field in fields if ":" in field)
    encode, kind = choose_encoder(names.get("accept", "").strip())
    return _response("200 OK", kind, b"" if method == "HEAD" else encode(registry))


def _response(status: str, kind: str, body: bytes) -> bytes:
    lines = (f"HTTP/1.1 {status}", f"Content-Type: {kind}", f"Content-Length: {len(body)}", "Connection: close", "", "")
    return "\r\n".join(lines).encode() + body
