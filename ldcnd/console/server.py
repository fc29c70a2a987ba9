"""The console's process: sessions to the rigs on one side, the web server on the other, links in between."""

import asyncio
import json
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from urllib.parse import urlsplit

import click
import segno
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp

from ldcnd.certificate import first_to_end, watch_certificate
from ldcnd.client.network import check_settings
from ldcnd.console.commands import command_routes
from ldcnd.console.connections import HANDSHAKE_TIME_S, BoundedH11
from ldcnd.console.control import control_routes
from ldcnd.console.feed import Feed
from ldcnd.console.gate import RequestGate
from ldcnd.console.latest_values import LatestValues
from ldcnd.console.link_socket import GivenLink, giving_links, page_key
from ldcnd.console.page_files import page_file_routes
from ldcnd.console.pages import Pages
from ldcnd.console.reading import reading_routes
from ldcnd.console.replies import LinkReply
from ldcnd.console.rigs import Rigs
from ldcnd.console.sequences import Runs
from ldcnd.console.settings import ConsoleSettings
from ldcnd.console.visitors import LINK_S, Visitors
from ldcnd.contract.errors import ConfigError
from ldcnd.listen_address import ListenAddress
from ldcnd.log import get_logger
from ldcnd.parts import ENDS, on_end_of_input, on_signals
from ldcnd.systemd import Beside

log = get_logger("console")

RENEW = "put another in its place, and restart the console"
"""What to do about a certificate for pages; who made it is not known here."""
END_TIME_S = 1.0
"""Time for open pages to close when the console ends, seconds; then their connections are aborted."""
ABORT_TIME_S = 2
"""From then until uvicorn gives up what is left, whole seconds."""
SENT_BYTES = 64 * 1024
"""Size of the kernel's send buffer for a page: frames in it would be shown late."""
UNREAD_MS = 30_000
"""Time after which the kernel gives up a page that takes nothing, milliseconds."""
LONGEST_MESSAGE_BYTES = 1024
"""Maximum size of a page's message on its web sockets."""
PING_EACH_S = 1.0
PONG_TIME_S = 4.0
"""Time without answer after which a browser's pages are gone, seconds; a browser answers for hidden pages, too."""


MoreRoutes = Callable[[Rigs], Sequence[BaseRoute]]
"""What else a console serves behind its gate, such as the commissioning page."""


def build_app(
    settings: ConsoleSettings,
    rigs: Rigs,
    feed: Feed,
    visitors: Visitors,
    new_link: Callable[[], str],
    commissioning: MoreRoutes | None = None,
) -> ASGIApp:
    """Return the web application, behind its gate; `commissioning` adds the routes of that page."""

    async def link(_: Request) -> Response:
        return Response(LinkReply(link=new_link()).model_dump_json(), media_type="application/json")

    runs = Runs(rigs.show_run, time.time_ns)
    pages = Pages(rigs, runs)
    routes = [
        *reading_routes(rigs, feed, visitors, commissions=commissioning is not None),
        *control_routes(pages),
        Route("/api/link", link, methods=["POST"]),
        *command_routes(rigs, pages, runs),
        *(commissioning(rigs) if commissioning else ()),
        *page_file_routes(),
    ]
    return RequestGate(Starlette(routes=routes), visitors, settings.scheme, settings.known_hosts)


async def serve(settings: ConsoleSettings, commissioning: MoreRoutes | None = None) -> None:
    """Serve until SIGTERM, SIGINT or the end of the terminal; SIGUSR1 prints another link, and so does `--link`.

    Args:
        settings: of the console.
        commissioning: the routes of the commissioning page, where it is served.

    Raises:
        ConfigError: the address, the certificate or what was said about Zenoh cannot be used.
    """
    for endpoint in settings.endpoints:
        check_settings(endpoint.settings)  # an error in it is raised now, not retried for ever
    loop = asyncio.get_running_loop()
    values = LatestValues()
    beside = Beside()

    def remark(problem: str | None, about: str = "login") -> None:
        (log.warning if problem else log.info)("certificate", about=about, problem=problem)
        beside.remarks(problem, about)

    rigs = Rigs(values, settings.rigs, beside.lacks, remark)
    visitors = Visitors(loop.time, settings.token, page_key())
    listening = _listen(settings.address)
    host, port = listening.getsockname()[:2]

    def new_link() -> str:
        return f"{settings.scheme}://{settings.shown_host}:{port}/?link={visitors.new_link()}"

    def give_link() -> GivenLink:
        return GivenLink(link=new_link(), minutes=None if settings.token else LINK_S / 60)

    async with (
        Feed(values, time.time_ns) as feed,
        giving_links(host, port, give_link),
        asyncio.TaskGroup() as group,
    ):
        server = _Server(_config(build_app(settings, rigs, feed, visitors, new_link, commissioning), settings))
        on_signals(server.end, *ENDS)
        if settings.with_input:
            on_end_of_input(server.end)
        on_signals(lambda: show_link(give_link(), as_json=settings.as_json), "SIGUSR1")
        watching = [
            group.create_task(rigs.run(endpoint), name=f"endpoint {endpoint.name}") for endpoint in settings.endpoints
        ]
        if settings.certificate:
            served = first_to_end(settings.certificate.read_text(encoding="ascii", errors="replace"))
            ending = watch_certificate(served, partial(remark, about="pages"), remedy=RENEW)
            watching.append(group.create_task(ending, name="end of the certificate for pages"))
        show_link(give_link(), as_json=settings.as_json)
        beside.serves(f"console on {settings.scheme}://{settings.shown_host}:{port}")
        await server.serve(sockets=[listening])
        for task in watching:
            task.cancel()


class _Server(uvicorn.Server):
    """A server that leaves signals to the program around it."""

    def end(self) -> None:
        """Serve no longer than `END_TIME_S` from now on."""
        self.should_exit = True

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen as uvicorn does, with a bound on the TLS handshake, for which it has no setting."""
        config, loop = self.config, asyncio.get_running_loop()

        def protocol() -> asyncio.Protocol:
            return BoundedH11(config, self.server_state, self.lifespan.state)

        await self.lifespan.startup()
        bound_s = HANDSHAKE_TIME_S if config.ssl else None
        self.servers = [
            await loop.create_server(protocol, sock=each, ssl=config.ssl, ssl_handshake_timeout=bound_s)
            for each in sockets or ()
        ]
        self.started = True

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End as uvicorn does, but a page that takes nothing is no error: uvicorn would log one with its traceback."""
        abort = asyncio.get_running_loop().call_later(END_TIME_S, self._abort)
        await super().shutdown(sockets)
        abort.cancel()

    def _abort(self) -> None:
        for connection in list(self.server_state.connections):
            connection.transport.abort()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield


def _config(app: ASGIApp, settings: ConsoleSettings) -> uvicorn.Config:
    config = uvicorn.Config(
        app,
        http=BoundedH11,
        ws="websockets-sansio",
        ws_max_size=LONGEST_MESSAGE_BYTES,
        ws_per_message_deflate=False,
        ws_ping_interval=PING_EACH_S,
        ws_ping_timeout=PONG_TIME_S,
        lifespan="off",
        log_config=None,
        access_log=False,
        proxy_headers=False,
        server_header=False,
        timeout_graceful_shutdown=int(END_TIME_S) + ABORT_TIME_S,
        ssl_certfile=settings.certificate,
        ssl_keyfile=settings.key,
    )
    try:
        config.load()
    except OSError as error:  # what ssl raises is an OSError
        raise ConfigError(f"{settings.certificate}, {settings.key}: cannot be used: {error}") from error
    return config


def _listen(address: ListenAddress) -> socket.socket:
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    listening = socket.socket(family)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # connections inherit these two
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SENT_BYTES)
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNREAD_MS)
        listening.bind((address.host, address.port))
        listening.listen()
    except OSError as error:
        listening.close()
        raise ConfigError(
            f"cannot listen on {address.in_url}:{address.port}: {error.strerror}",
            value=address.port,
            remedy="end the other program, or choose another port with --listen",
        ) from error
    return listening


def show_link(given: GivenLink, *, as_json: bool) -> None:
    """Print a link, for a phone as a picture too, where it leads anywhere from there."""
    if as_json:
        click.echo(json.dumps({"link": given.link}))
        return
    click.echo(f"console: {given.link}")
    if given.minutes:
        click.echo(f"The link lets one browser in, within {given.minutes:g} minutes.")
    loopback = (urlsplit(given.link).hostname or "").startswith(("localhost", "127.", "::1"))
    if not loopback and sys.stdout.isatty() and "utf" in (sys.stdout.encoding or "").lower():
        segno.make(given.link).terminal(compact=True)
