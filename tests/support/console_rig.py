"""A console in this process, in front of a daemon in this process: no HTTP, no Zenoh, on the jumping clock."""

import asyncio
import json
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from urllib.parse import urlsplit

import msgpack
from starlette.types import ASGIApp, Message, Scope

from ldcnd.config.rig import RigConfig
from ldcnd.console.feed import Feed
from ldcnd.console.latest_values import LatestValues
from ldcnd.console.rigs import Endpoint, Rigs
from ldcnd.console.server import MoreRoutes, build_app
from ldcnd.console.settings import ConsoleSettings
from ldcnd.console.visitors import Visitors
from ldcnd.listen_address import ListenAddress
from ldcnd.net.session import Session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.support.browser import Browser, JsonObject, WebAnswer, WebQuestion, web_answer
from tests.support.rig import EPOCH_NS, RunningRig, running_rig

ORIGIN = "http://127.0.0.1:8470"
ENDPOINT = Endpoint("memory", ZenohSettings())
PATIENCE_S = 120.0


@dataclass(frozen=True, slots=True)
class RunningConsole:
    """A console, who looks at it, and what is behind it."""

    app: ASGIApp
    browser: Browser
    visitors: Visitors
    rigs: Rigs
    rig: RunningRig
    values: LatestValues

    def told_of_rig(self, rig: str, topic: str) -> JsonObject | None:
        """Return what pages are told last on a topic of the console's own."""
        name = f"{rig}/{topic}"
        if not self.values.names(lambda each: each == name):
            return None
        *_, told = msgpack.unpackb(self.values.entry(name))
        assert isinstance(told, dict)
        return told

    async def enter(self) -> Browser:
        """Return one more browser that was let in."""
        stranger = Browser(self.browser.ask, ORIGIN)
        return await stranger.enter(f"{ORIGIN}/?link={self.visitors.new_link()}")


class PageSocket:
    """A page's WebSocket.

    Attributes:
        status: of the answer where it was not let in.
        closed: the code with which the console has closed it.
    """

    def __init__(self) -> None:
        self.status: int | None = None
        self.closed: int | None = None
        self._to_app: asyncio.Queue[Message] = asyncio.Queue()
        self._frames: asyncio.Queue[bytes] = asyncio.Queue()
        self._reads = asyncio.Event()
        self._reads.set()
        self._answered = asyncio.Event()
        self._to_app.put_nowait({"type": "websocket.connect"})

    async def frame(self) -> bytes:
        """Return the next frame."""
        async with asyncio.timeout(PATIENCE_S):
            return await self._frames.get()

    def say(self, text: str) -> None:
        """Say something."""
        self._to_app.put_nowait({"type": "websocket.receive", "text": text})

    def stop_reading(self) -> None:
        """Take no more frames."""
        self._reads.clear()

    def leave(self) -> None:
        """Close it."""
        self._reads.set()
        self._to_app.put_nowait({"type": "websocket.disconnect", "code": 1001})

    async def answered(self) -> None:
        """Wait until it was let in or not."""
        async with asyncio.timeout(PATIENCE_S):
            await self._answered.wait()

    async def receive(self) -> Message:
        """Hand over what the page says; for the application."""
        return await self._to_app.get()

    async def send(self, message: Message) -> None:
        """Take what the application says."""
        match message["type"]:
            case "websocket.accept":
                self._answered.set()
            case "websocket.send":
                await self._reads.wait()
                self._frames.put_nowait(message.get("bytes") or message["text"].encode())
            case "websocket.http.response.start":
                self.status = message["status"]
            case "websocket.http.response.body":
                self._answered.set()
            case "websocket.close":
                self.closed = message["code"]
                self._answered.set()


@asynccontextmanager
async def page(app: ASGIApp, browser: Browser, query: str = "", path: str = "/api/feed") -> AsyncIterator[PageSocket]:
    """Open a page's WebSocket; returns once it was let in or not."""
    socket = PageSocket()
    headers = browser.headers({"origin": browser.origin})
    scope = {
        **_scope("websocket", f"{path}{query}", headers),
        "subprotocols": [],
        "extensions": {"websocket.http.response": {}},
    }
    async with asyncio.TaskGroup() as group:
        group.create_task(_call(app, scope, socket), name="page")
        await socket.answered()
        yield socket
        socket.leave()


@dataclass(frozen=True, slots=True)
class OpenPage:
    """A page that can control axes.

    Attributes:
        name: what its commands carry.
        client: who it is to the daemon.
    """

    name: str
    client: str
    socket: PageSocket
    browser: Browser

    async def post(self, path: str, body: JsonObject | bytes | None = None) -> WebAnswer:
        """POST as this page."""
        return await self.browser.forging(x_ldcnd_page=self.name).post(path, body)

    async def take(self, rig: str, *axes: str) -> None:
        """Take control."""
        answer = await self.post(f"/api/rigs/{rig}/control", {"axes": list(axes)})
        assert answer.status == 200, answer.document

    def say(self, message: JsonObject) -> None:
        """Say something on its web socket."""
        self.socket.say(json.dumps(message))

    async def told(self) -> JsonObject:
        """Return the next message on its web socket."""
        message = json.loads(await self.socket.frame())
        assert isinstance(message, dict)
        return message


@asynccontextmanager
async def open_page(app: ASGIApp, browser: Browser) -> AsyncIterator[OpenPage]:
    """Open a page that can control axes; it has given up control when the context has ended."""
    async with page(app, browser, path="/api/page") as socket:
        hello = json.loads(await socket.frame())
        yield OpenPage(hello["page"], hello["client"], socket, browser)


@asynccontextmanager
async def running_console(config: RigConfig | None = None) -> AsyncIterator[RunningConsole]:
    """Run a console in front of a daemon until the context ends; the rig is connected when the context begins."""
    async with running_rig(config) as rig, rig.broker.session() as session, console_of(rig, session) as console:
        yield console


@asynccontextmanager
async def console_of(
    rig: RunningRig, session: Session, commissioning: MoreRoutes | None = None
) -> AsyncIterator[RunningConsole]:
    """Run a console over a session."""
    loop = asyncio.get_running_loop()
    values = LatestValues()
    rigs = Rigs(values)
    visitors = Visitors(loop.time)
    settings = ConsoleSettings((ENDPOINT,), (), ListenAddress("127.0.0.1", 8470))
    async with Feed(values, lambda: EPOCH_NS + round(loop.time() * 1e9)) as feed, asyncio.TaskGroup() as group:

        def new_link() -> str:
            return f"{ORIGIN}/?link={visitors.new_link()}"

        app = build_app(settings, rigs, feed, visitors, new_link, commissioning)

        async def ask(question: WebQuestion) -> WebAnswer:
            return await _asked(app, question)

        watching = group.create_task(rigs.watch(session, ENDPOINT), name="watching")
        stranger = Browser(ask, ORIGIN)
        browser = await stranger.enter(f"{ORIGIN}/?link={visitors.new_link()}")
        async with asyncio.timeout(PATIENCE_S):
            while not [each for each in await rigs.described() if each.connected]:
                await asyncio.sleep(0.1)
        yield RunningConsole(app, browser, visitors, rigs, rig, values)
        watching.cancel()


async def _asked(app: ASGIApp, question: WebQuestion) -> WebAnswer:
    said: list[Message] = []
    body = [{"type": "http.request", "body": question.body, "more_body": False}]

    async def receive() -> Message:
        return body.pop() if body else {"type": "http.disconnect"}

    async def send(message: Message) -> None:
        said.append(message)

    async with asyncio.timeout(PATIENCE_S):
        await app({**_scope("http", question.path, question.headers), "method": question.method}, receive, send)
    headers = [(name.decode(), text.decode()) for name, text in said[0]["headers"]]
    return web_answer(said[0]["status"], headers, b"".join(message.get("body", b"") for message in said[1:]))


def _scope(kind: str, target: str, headers: Mapping[str, str]) -> Scope:
    at = urlsplit(target)
    return {
        "type": kind,
        "asgi": {"version": "3.0", "spec_version": "2.4"},
        "http_version": "1.1",
        "scheme": "http",
        "path": at.path,
        "raw_path": at.path.encode(),
        "query_string": at.query.encode(),
        "root_path": "",
        "headers": [(name.lower().encode(), text.encode()) for name, text in headers.items()],
        "client": ("127.0.0.1", 50000),
        "server": ("127.0.0.1", 8470),
    }


async def _call(app: ASGIApp, scope: Scope, socket: PageSocket) -> None:
    await app(scope, socket.receive, socket.send)
