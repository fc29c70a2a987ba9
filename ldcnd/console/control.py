"""How pages take control: a web socket for as long as they are open, and the requests to take and to release axes."""

import asyncio
from collections.abc import Iterable
from contextlib import suppress

from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from ldcnd.console.errors import answering_errors, error_response
from ldcnd.console.pages import FromPage, PageControl, Pages, ToPage
from ldcnd.console.reading import NOTHING_TO_SAY, SEND_TIME_S
from ldcnd.console.requests import body_of, json_reply
from ldcnd.contract.codec import Encoding, decode
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.frozen import Frozen

PAGE_HEADER = "x-ldcnd-page"
MOST_AXES = 256
"""Maximum number of axes in one request: eight full lines."""
WAITING_MESSAGES = 256
"""Maximum number of messages that wait for a page; one that does not read them is closed."""


class ControlRequest(Frozen):
    """Take control of axes."""

    axes: tuple[str, ...] = Field(min_length=1, max_length=MOST_AXES)
    """Axes to take."""
    force: bool = False
    """Take them from their holders, too."""


class ReleaseRequest(Frozen):
    """Give up control of axes; those that move are halted first."""

    axes: tuple[str, ...] = Field(min_length=1, max_length=MOST_AXES)
    """Which; those that the page does not control are passed over."""


class ControlReply(Frozen):
    """The axes that a page controls, or has given up."""

    client: str
    """The name under which it controls them."""
    axes: tuple[str, ...]
    """As requested."""


def control_routes(pages: Pages) -> list[BaseRoute]:
    """Return the web socket of pages, and what they may POST to take and to release axes."""

    async def take(request: Request) -> Response:
        page = page_of(request, pages)
        wanted = decode(ControlRequest, await body_of(request), Encoding.JSON)
        rig, taken = request.path_params["rig"], list[str]()
        try:
            for axis in wanted.axes:
                await page.take(rig, axis, force=wanted.force)
                taken.append(axis)
        except LdcndError:  # all of them or none
            await _release_all(page, rig, taken)
            raise
        return json_reply(ControlReply(client=page.client, axes=wanted.axes))

    async def release(request: Request) -> Response:
        page = page_of(request, pages)
        wanted = decode(ReleaseRequest, await body_of(request), Encoding.JSON)
        await _release_all(page, request.path_params["rig"], wanted.axes)
        return json_reply(ControlReply(client=page.client, axes=wanted.axes))

    async def page_socket(socket: WebSocket) -> None:
        waiting: asyncio.Queue[ToPage] = asyncio.Queue(WAITING_MESSAGES)
        try:
            async with pages.open(socket.state.visitor, waiting.put_nowait) as page:
                await socket.accept()
                waiting.put_nowait(ToPage(page=page.token, client=page.client))
                await _serve(socket, page, waiting)
        except* LdcndError as errors:
            refused = errors.exceptions[0]
            if isinstance(refused, LdcndError):
                await socket.send_denial_response(error_response(refused))

    return [
        WebSocketRoute("/api/page", page_socket),
        Route("/api/rigs/{rig}/control", answering_errors(take), methods=["POST"]),
        Route("/api/rigs/{rig}/release", answering_errors(release), methods=["POST"]),
    ]


def page_of(request: Request, pages: Pages) -> PageControl:
    """Return the page that sends a request.

    Raises:
        LeaseExpired: it says none, or one that is not open.
    """
    return pages.of(request.headers.get(PAGE_HEADER, ""), request.state.visitor)


async def _release_all(page: PageControl, rig: str, axes: Iterable[str]) -> None:
    async with asyncio.TaskGroup() as group:
        for axis in axes:
            group.create_task(page.release(rig, axis), name=f"release {axis}")


async def _serve(socket: WebSocket, page: PageControl, waiting: asyncio.Queue[ToPage]) -> None:
    """Speak with the page until its web socket closes, by it, by the keep-alive's time-out or for nonsense."""
    async with asyncio.TaskGroup() as group:
        telling = group.create_task(_tell(socket, waiting), name="send to page")
        hearing = group.create_task(_hear(socket, page), name="receive from page")
        telling.add_done_callback(lambda _: hearing.cancel())
        hearing.add_done_callback(lambda _: telling.cancel())
    if not hearing.cancelled() and not hearing.result():
        await socket.close(NOTHING_TO_SAY)


async def _hear(socket: WebSocket, page: PageControl) -> bool:
    """Hand over what the page says; returns whether the page has closed its socket, rather than said nonsense."""
    while (message := await socket.receive())["type"] == "websocket.receive":
        try:
            page.heard(decode(FromPage, (message.get("text") or "").encode(), Encoding.JSON))
        except LdcndError:
            return False
    return True


async def _tell(socket: WebSocket, waiting: asyncio.Queue[ToPage]) -> None:
    with suppress(WebSocketDisconnect, TimeoutError):
        while True:
            message = await waiting.get()
            async with asyncio.timeout(SEND_TIME_S):
                await socket.send_text(message.model_dump_json(exclude_none=True))
