"""Why a connection was refused: Zenoh says "cannot connect" to everything, so its endpoints are tried without it.

Only used after Zenoh has failed. It checks whether there is a listener, and with TLS whether the other side is who it
should be; if both are well, it was this program's login that was refused.
"""

import asyncio
import contextlib
import ssl
from collections.abc import AsyncIterator, Sequence

PROBE_TIME_S = 1.0
INTERNET = frozenset({"tcp", "tls", "udp", "quic", "ws"})
"""Protocols whose endpoints name a host."""


async def refusals(endpoints: Sequence[str], root: str | None) -> list[str]:
    """Return one sentence for each endpoint that answers and did not let this program in.

    Args:
        endpoints: where Zenoh could not connect to.
        root: the certificates that are trusted, in PEM, if there are any.
    """
    found = [await _refusal(endpoint, root) for endpoint in endpoints]
    return [sentence for sentence in found if sentence]


async def unresolved(endpoints: Sequence[str]) -> list[str]:
    """Return the names of hosts among these endpoints that no name server and no file of this machine knows."""
    hosts = dict.fromkeys(_host_of(each) for each in endpoints if each.partition("/")[0] in INTERNET)
    return [host for host in hosts if await _is_unknown(host)]


def _host_of(endpoint: str) -> str:
    address = endpoint.partition("#")[0].partition("?")[0].partition("/")[2]
    return address.rpartition(":")[0].strip("[]")


async def _is_unknown(host: str) -> bool:
    try:
        async with asyncio.timeout(PROBE_TIME_S):
            await asyncio.get_running_loop().getaddrinfo(host, None)
    except TimeoutError:  # an OSError as well
        return False
    except (OSError, UnicodeError):
        return True
    return False


async def _refusal(endpoint: str, root: str | None) -> str | None:
    """Return why; None when there is no answer at that address."""
    protocol, _, address = endpoint.partition("#")[0].partition("?")[0].partition("/")
    try:
        async with asyncio.timeout(PROBE_TIME_S):
            match protocol:
                case "tcp":
                    return await _tcp_refusal(endpoint, address)
                case "tls":
                    return await _tls_refusal(endpoint, address, root)
                case "unixsock-stream":
                    return await _socket_refusal(endpoint, address)
    except (OSError, ValueError, TimeoutError):
        pass
    return None


async def _tcp_refusal(endpoint: str, address: str) -> str:
    async with _connected(address, None):
        return f"{endpoint} answers but refuses this login: a wrong user or password, or it wants TLS"


async def _tls_refusal(endpoint: str, address: str, root: str | None) -> str:
    context = ssl.create_default_context(cadata=root)
    try:
        # in TLS 1.3 a client's handshake is over before the server has judged its certificate (RFC 8446, 2)
        async with _connected(address, context):
            return (
                f"{endpoint} answers but refuses this login: no certificate, one that has ended,"
                " or one of another authority"
            )
    except ssl.SSLCertVerificationError as error:
        return f"{endpoint} answers but is not who it should be: {error.verify_message}"
    except ssl.SSLError:
        return f"{endpoint} answers but does not speak TLS"


async def _socket_refusal(endpoint: str, address: str) -> str:
    try:
        _, writer = await asyncio.open_unix_connection(address)
    except PermissionError:
        return f"{endpoint} is there but this user may not use it: its group may"
    await _hang_up(writer)
    return f"{endpoint} answers but refuses this login"


@contextlib.asynccontextmanager
async def _connected(address: str, context: ssl.SSLContext | None) -> AsyncIterator[None]:
    host, _, port = address.rpartition(":")
    _, writer = await asyncio.open_connection(host.strip("[]"), int(port), ssl=context)
    try:
        yield
    finally:
        await _hang_up(writer)


async def _hang_up(writer: asyncio.StreamWriter) -> None:
    writer.close()
    # the other side may well have closed it
    with contextlib.suppress(OSError):
        await writer.wait_closed()
