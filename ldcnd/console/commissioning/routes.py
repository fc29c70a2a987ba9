"""What a console that may commission adds to its routes: an overview, a report, and the web sockets of pages.

All of it is behind the console's gate, like everything else. A web socket is bound to the page that opens it: there is
one for each axis, and one for the search for drives; a second page learns who has it.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from ldcnd.bench.commissioning import record as records
from ldcnd.bench.commissioning.checklist import STEPS, axis_of, open_steps
from ldcnd.bench.commissioning.gains import GainsStep
from ldcnd.bench.commissioning.report import html_of
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.console.commissioning.axis_conversation import AxisConversation
from ldcnd.console.commissioning.conversation import Conversation
from ldcnd.console.commissioning.messages import FromCommissioningPage, ToCommissioningPage
from ldcnd.console.commissioning.scan_conversation import ScanConversation
from ldcnd.console.errors import answering_errors
from ldcnd.console.reading import NOTHING_TO_SAY, SEND_TIME_S
from ldcnd.console.replies import RigReply
from ldcnd.console.requests import json_reply
from ldcnd.console.rigs import Rigs
from ldcnd.console.visitors import Visitor
from ldcnd.contract.codec import Encoding, decode, error_reply
from ldcnd.contract.errors import ConfigError, LdcndError, LeaseHeld, TooManyRequests
from ldcnd.contract.frozen import Frozen
from ldcnd.version import version

SCANNING = "the search for drives"
MOST_MESSAGES_PER_S = 40.0
"""A page that says more than that for long is closed: one that holds its button says ten."""
BURST = 200.0


class AxisOverview(Frozen):
    """One axis of the configuration."""

    axis: str
    """Its name."""
    model: str
    """Its drive."""
    open: tuple[str, ...]
    """Titles of the steps that are open, or have failed."""
    tuned: bool
    """Its gains are settled."""
    page: str | None
    """Which page has its checklist now."""


class Overview(Frozen):
    """`GET /api/commissioning`."""

    file: str
    """The configuration."""
    rig: str | None
    """Its rig; null before there is a file."""
    problem: str | None
    """Why the file is no configuration."""
    connected: bool
    """A daemon serves the rig."""
    command: str
    """Starts the daemon."""
    numpy: bool
    """Tuning is installed."""
    axes: tuple[AxisOverview, ...]
    """In the order of the file."""


class Commissioning:
    """The pages that commission, and what they share.

    Args:
        rigs: of the console.
        config: the configuration of the rig, which need not be there yet.
        command: starts its daemon.
    """

    def __init__(self, rigs: Rigs, config: Path, command: str) -> None:
        self._rigs = rigs
        self._config = config
        self._command = command
        self._pages: dict[str, str] = {}
        self._count = 0

    def routes(self) -> list[BaseRoute]:
        """Return what they GET, and their web sockets."""

        async def overview(_: Request) -> Response:
            return json_reply(await self._overview())

        async def report(request: Request) -> Response:
            return self._report(request.path_params["axis"])

        async def axis(socket: WebSocket) -> None:
            name, visitor = socket.path_params["axis"], _visitor(socket)
            new = partial(AxisConversation, self._rigs, self._config, name, visitor.client)
            await self._serve(socket, f"axis {name}", partial(self._checked, name, new))

        async def scan(socket: WebSocket) -> None:
            await self._serve(socket, SCANNING, partial(ScanConversation, self._rigs, self._config))

        return [
            Route("/api/commissioning", answering_errors(overview)),
            Route("/api/commissioning/axes/{axis}/report", answering_errors(report)),
            WebSocketRoute("/api/commissioning/axes/{axis}", axis),
            WebSocketRoute("/api/commissioning/scan", scan),
        ]

    def _checked(self, axis: str, new: Callable[[], Conversation]) -> Conversation:
        axis_of(load_config(self._config), axis)
        return new()

    async def _serve(self, socket: WebSocket, what: str, new: Callable[[], Conversation]) -> None:
        """Let a page have part in something until its web socket closes; whatever it has begun is over then."""
        await socket.accept()
        try:
            if what in self._pages:
                raise LeaseHeld(
                    f"{what[:80]}: {self._pages[what]} has it on another page",
                    remedy="go on there, or close that page: what is settled stays",
                )
            conversation = new()
        except LdcndError as error:
            await socket.send_text(ToCommissioningPage(refused=error_reply(error)).model_dump_json(exclude_none=True))
            await socket.close(NOTHING_TO_SAY)
            return
        self._count += 1
        self._pages[what] = f"{_visitor(socket).client}, page {self._count},"
        try:
            closed_by_page = await _speak(socket, conversation)
        finally:
            del self._pages[what]
        if not closed_by_page:
            await socket.close(NOTHING_TO_SAY)

    async def _overview(self) -> Overview:
        config, problem = None, None
        if self._config.exists():
            try:
                config = load_config(self._config)
            except ConfigError as error:
                problem = error.message
        described = {each.name: each for each in await self._rigs.described()}
        return Overview(
            file=str(self._config),
            rig=config.rig if config else None,
            problem=problem,
            connected=bool(config and config.rig in described and described[config.rig].connected),
            command=self._command,
            numpy=find_spec("numpy") is not None,
            axes=tuple(self._axes(config, described.get(config.rig))) if config else (),
        )

    def _axes(self, config: RigConfig, rig: RigReply | None) -> list[AxisOverview]:
        found, infos = [], {info.axis: info for info in rig.axes} if rig else {}
        for each in (axis for bus in config.bus for axis in bus.axis):
            record = records.read(records.file_of(self._config, config.rig, each.name), config.rig, each.name)
            still = open_steps(record, each, infos.get(each.name))
            found.append(
                AxisOverview(
                    axis=each.name,
                    model=each.model,
                    open=tuple(STEPS[name].title for name in still),
                    tuned=GainsStep.name not in still,
                    page=self._pages.get(f"axis {each.name}"),
                )
            )
        return found

    def _report(self, axis: str) -> Response:
        config = load_config(self._config)
        axis_of(config, axis)
        record = records.read(records.file_of(self._config, config.rig, axis), config.rig, axis)
        at = datetime.now(UTC).isoformat(timespec="seconds")
        text = html_of(record, STEPS, self._config.read_text(encoding="utf-8"), version(), at)
        name = f"commissioning-{config.rig}-{axis}.html"
        return HTMLResponse(text, headers={"Content-Disposition": f'attachment; filename="{name}"'})


def _visitor(socket: WebSocket) -> Visitor:
    visitor: Visitor = socket.state.visitor
    return visitor


async def _speak(socket: WebSocket, conversation: Conversation) -> bool:
    """Speak with a page until it goes, takes nothing, or says nonsense; tell whether it has gone by itself."""
    async with asyncio.TaskGroup() as group:
        working = group.create_task(conversation.run(), name="commissioning")
        telling = group.create_task(_tell(socket, conversation), name="send to page")
        hearing = group.create_task(_hear(socket, conversation), name="receive from page")

        def end(_: object) -> None:
            for each in (working, telling, hearing):
                each.cancel()

        telling.add_done_callback(end)
        hearing.add_done_callback(end)
    return hearing.cancelled() or hearing.result()


async def _hear(socket: WebSocket, conversation: Conversation) -> bool:
    """Hand over what the page says; returns whether it has closed its socket, rather than said nonsense or too much."""
    loop = asyncio.get_running_loop()
    left, at_s = BURST, loop.time()
    while (message := await socket.receive())["type"] == "websocket.receive":
        left = min(BURST, left + MOST_MESSAGES_PER_S * (loop.time() - at_s)) - 1
        at_s = loop.time()
        try:
            if left < 0:
                raise TooManyRequests("this page says too much", limit=MOST_MESSAGES_PER_S)
            conversation.heard(decode(FromCommissioningPage, (message.get("text") or "").encode(), Encoding.JSON))
        except LdcndError:
            return False
    return True


async def _tell(socket: WebSocket, conversation: Conversation) -> None:
    with suppress(WebSocketDisconnect, TimeoutError):
        while True:
            view = await conversation.view()
            async with asyncio.timeout(SEND_TIME_S):
                await socket.send_text(ToCommissioningPage(view=view).model_dump_json(exclude_none=True))
