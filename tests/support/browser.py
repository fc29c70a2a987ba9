"""Browsers that say to a console exactly what a test wants said."""

import asyncio
import contextlib
import json
import socket
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import msgpack
from websockets.asyncio.client import ClientConnection, connect

from tests.support.process import ROOT, process

JsonObject = dict[str, "JsonValue"]
JsonValue = JsonObject | list["JsonValue"] | str | int | float | bool | None
ASK_TIME_S = 30.0
LINK_TIME_S = 60.0
"""A console prints its link within this time on a machine that has very much else to do."""


@dataclass(frozen=True, slots=True)
class WebAnswer:
    """What a console has answered."""

    status: int
    headers: Mapping[str, str]
    cookies: Mapping[str, str]
    body: bytes

    @property
    def document(self) -> JsonObject:
        """The body as JSON."""
        document = json.loads(self.body)
        assert isinstance(document, dict)
        return document


@dataclass(frozen=True, slots=True)
class WebQuestion:
    """What a browser asks."""

    method: str
    path: str
    headers: Mapping[str, str]
    body: bytes = b""


Ask = Callable[[WebQuestion], Awaitable[WebAnswer]]


@dataclass(frozen=True, slots=True)
class Browser:
    """Speaks to one console; what it says can be forged.

    Attributes:
        origin: of the console's pages.
        cookies: as given on entering.
        extra: headers to send beside the usual ones, or in their place; an empty one is left out.
    """

    ask: Ask
    origin: str
    cookies: Mapping[str, str] = field(default_factory=dict)
    extra: Mapping[str, str] = field(default_factory=dict)

    @property
    def session(self) -> str:
        """What proves who it is."""
        return self._cookie("ldcnd_session_")

    @property
    def csrf(self) -> str:
        """What proves that its pages send a command."""
        return self._cookie("ldcnd_csrf_")

    def _cookie(self, name: str) -> str:
        """Return one of the cookies; its name has the port as a browser sees it."""
        port = urlsplit(self.origin).port
        return self.cookies.get(f"{name}{port or ''}", "")

    def forging(self, **headers: str) -> "Browser":
        """Return one that sends other headers; underscores stand for hyphens."""
        return replace(self, extra={**self.extra, **{name.replace("_", "-"): text for name, text in headers.items()}})

    def without_cookies(self) -> "Browser":
        """Return a stranger."""
        return replace(self, cookies={})

    async def enter(self, link: str) -> "Browser":
        """Return one that was let in."""
        answer = await self.get(path_of(link))
        assert answer.status == 303, answer
        return replace(self, cookies=answer.cookies)

    async def get(self, path: str) -> WebAnswer:
        """GET."""
        return await self.ask(WebQuestion("GET", path, self.headers()))

    async def post(self, path: str, body: JsonObject | bytes | None = None) -> WebAnswer:
        """POST as the console's own pages do."""
        payload = body if isinstance(body, bytes) else json.dumps(body or {}).encode()
        usual = {"origin": self.origin, "x-ldcnd-csrf": self.csrf}
        return await self.ask(WebQuestion("POST", path, self.headers(usual), payload))

    def headers(self, usual: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return the headers of a question."""
        cookies = "; ".join(f"{name}={text}" for name, text in self.cookies.items())
        said = {"host": urlsplit(self.origin).netloc, "cookie": cookies, **(usual or {}), **self.extra}
        return {name: text for name, text in said.items() if text}


def path_of(link: str) -> str:
    """Return path and query of a link."""
    parts = urlsplit(link)
    return f"{parts.path}?{parts.query}" if parts.query else parts.path


async def ask_over_tcp(host: str, port: int, question: WebQuestion, tls: ssl.SSLContext | None = None) -> WebAnswer:
    """Ask a console in another process, on a connection of its own."""
    async with asyncio.timeout(ASK_TIME_S):
        reader, writer = await asyncio.open_connection(host, port, ssl=tls)
        try:
            lines = [f"{question.method} {question.path} HTTP/1.1", "connection: close"]
            lines += [f"{name}: {text}" for name, text in question.headers.items()]
            if question.body:
                lines.append(f"content-length: {len(question.body)}")
            writer.write("\r\n".join([*lines, "", ""]).encode() + question.body)
            head, _, body = (await reader.read()).partition(b"\r\n\r\n")
        finally:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
    first, *rest = head.decode().split("\r\n")
    headers = [line.split(": ", 1) for line in rest]
    return web_answer(int(first.split()[1]), [(name, text) for name, text in headers], body)


def web_answer(status: int, headers: list[tuple[str, str]], body: bytes) -> WebAnswer:
    """Return an answer from what came."""
    cookies = [text.partition(";")[0].partition("=") for name, text in headers if name.lower() == "set-cookie"]
    given = {name: text for name, _, text in cookies}
    return WebAnswer(status, {name.lower(): text for name, text in headers}, given, body)


@dataclass(frozen=True, slots=True)
class ConsoleProcess:
    """A console in a process of its own.

    Attributes:
        link: as it was printed.
        process: the process.
        stranger: a browser that was not let in.
    """

    link: str
    process: asyncio.subprocess.Process
    stranger: Browser

    async def printed_link(self) -> str:
        """Return the next link that it prints."""
        assert self.process.stdout
        async with asyncio.timeout(LINK_TIME_S):
            link = json.loads(await self.process.stdout.readline())["link"]
        assert isinstance(link, str)
        return link


@asynccontextmanager
async def console(
    *arguments: str, tls: ssl.SSLContext | None = None, tree: Path = ROOT
) -> AsyncIterator[ConsoleProcess]:
    """Run `ldcnd console ARGUMENTS` of a source tree on a free port until the context ends."""
    async with process("console", "--json", "--listen", "127.0.0.1:0", *arguments, tree=tree) as running:
        assert running.stdout
        async with asyncio.timeout(LINK_TIME_S):
            link = json.loads(await running.stdout.readline())["link"]
        at = urlsplit(link)
        assert at.hostname
        assert at.port
        ask = partial(ask_over_tcp, at.hostname, at.port, tls=tls)
        yield ConsoleProcess(link, running, Browser(ask, f"{at.scheme}://{at.netloc}"))


@asynccontextmanager
async def feed(browser: Browser, query: str = "") -> AsyncIterator[ClientConnection]:
    """Open a page's WebSocket."""
    at = urlsplit(browser.origin)
    headers = browser.headers({"origin": browser.origin})
    del headers["host"]
    uri = f"ws://{at.netloc}/api/feed{query}"
    # what the test has not read stands in the way of a goodbye
    async with connect(uri, additional_headers=headers, compression=None, close_timeout=0.2) as page:
        yield page


def hanging_page(browser: Browser) -> socket.socket:
    """Open a page's WebSocket that nobody will ever read from."""
    at = urlsplit(browser.origin)
    hanging = socket.socket()
    hanging.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    hanging.connect((at.hostname, at.port))
    usual = {"origin": browser.origin, "upgrade": "websocket", "connection": "Upgrade"}
    usual |= {"sec-websocket-key": "AAAAAAAAAAAAAAAAAAAAAA==", "sec-websocket-version": "13"}
    lines = [f"{name}: {text}" for name, text in browser.headers(usual).items()]
    hanging.sendall("\r\n".join(["GET /api/feed?rate=60 HTTP/1.1", *lines, "", ""]).encode())
    return hanging


async def entries(page: ClientConnection) -> list[tuple[str, str, JsonObject | None]]:
    """Return what the next frame tells."""
    async with asyncio.timeout(ASK_TIME_S):
        frame = await page.recv(decode=False)
    _sent_ns, _dropped, told = msgpack.unpackb(frame)
    return [(rig, topic, sample) for rig, topic, sample in told]
