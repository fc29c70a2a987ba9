"""Read access of pages: the rigs, traces, explanations of faults, and telemetry."""

import asyncio
from collections.abc import Callable
from functools import partial
from html import escape

from markdown_it import MarkdownIt
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from ldcnd.client.traces import Trace, fetch_trace, trace_as_csv, trace_as_json
from ldcnd.console.errors import Answer, answering_errors, error_response
from ldcnd.console.feed import Feed, Page, parse_subscription
from ldcnd.console.replies import RigsReply
from ldcnd.console.rigs import Rigs
from ldcnd.console.visitors import Visitors
from ldcnd.contract.errors import DriveFault, LdcndError, WrongState
from ldcnd.contract.fault_pages import page_text
from ldcnd.version import version

SEND_TIME_S = 30.0
"""Time after which a page that takes nothing is given up, seconds."""
NOTHING_TO_SAY = 1008

_FAULT_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{code} - ldcnd</title><link rel="stylesheet" href="/static/style/base.css"></head>
<body><main class="fault-page">{text}</main></body></html>
"""


def reading_routes(rigs: Rigs, feed: Feed, visitors: Visitors, *, commissions: bool = False) -> list[BaseRoute]:
    """Return what pages may GET, and the WebSocket."""

    async def all_rigs(request: Request) -> Response:
        reply = RigsReply(
            version=version(),
            client=request.state.visitor.client,
            endpoints=rigs.endpoints,
            rigs=await rigs.described(),
            commissions=commissions,
        )
        return Response(reply.model_dump_json(), media_type="application/json")

    async def last_trace(request: Request) -> Trace:
        client, axis = rigs.client(request.path_params["rig"]), request.path_params["axis"]
        return await fetch_trace(client, axis)

    async def trace(request: Request) -> Response:
        return Response(trace_as_json(await last_trace(request)), media_type="application/json")

    async def trace_table(request: Request) -> Response:
        name = f"{request.path_params['rig']}-{request.path_params['axis']}.csv"
        return Response(
            trace_as_csv(await last_trace(request)),
            media_type="text/csv",
            headers={"Content-Disposition": f'attachment; filename="{name}"'},
        )

    async def telemetry(socket: WebSocket) -> None:
        query = socket.query_params
        try:
            subscription = parse_subscription(query.get("rigs", ""), query.get("rate", ""), query.get("stream", ""))
            with feed.open_page(subscription) as page:
                await socket.accept()
                await _serve(socket, page, partial(visitors.see, socket.state.visitor))
        except LdcndError as error:
            await socket.send_denial_response(error_response(error))

    traces = "/api/rigs/{rig}/axes/{axis}/trace"
    return [
        Route("/api/rigs", answering_errors(all_rigs)),
        Route(traces, _or_no_trace(trace)),
        Route(f"{traces}.csv", _or_no_trace(trace_table)),
        Route("/faults/{code}", fault_page),
        WebSocketRoute("/api/feed", telemetry),
    ]


async def fault_page(request: Request) -> Response:
    """Answer with what a fault or an error means and what to do about it."""
    code = request.path_params["code"]
    text = page_text(code)
    if text is None:
        return PlainTextResponse(f"There is no page about {code[:64]!r}.", 404)
    return HTMLResponse(_FAULT_PAGE.format(code=escape(code), text=as_html(text)))


def as_html(text: str) -> str:
    """Return CommonMark as HTML; what looks like HTML in it stays text."""
    html: str = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
    return html


def _or_no_trace(answer: Answer) -> Answer:
    """Return an endpoint that answers 404 where there is no complete trace."""

    async def answered(request: Request) -> Response:
        try:
            return await answer(request)
        except (WrongState, DriveFault) as error:
            return error_response(error, 404)

    return answering_errors(answered)


async def _serve(socket: WebSocket, page: Page, seen: Callable[[], None]) -> None:
    """Send frames until the page goes, takes nothing, or says anything: there is nothing that it may say here."""
    async with asyncio.TaskGroup() as group:
        listening = group.create_task(socket.receive(), name="page listens")
        sending = group.create_task(_send(socket, page, seen), name="send to page")
        listening.add_done_callback(lambda _: sending.cancel())
        sending.add_done_callback(lambda _: listening.cancel())
    if not listening.cancelled() and listening.result()["type"] == "websocket.receive":
        await socket.close(NOTHING_TO_SAY)


async def _send(socket: WebSocket, page: Page, seen: Callable[[], None]) -> None:
    try:
        async for frame in page.frames():
            async with asyncio.timeout(SEND_TIME_S):
                await socket.send_bytes(frame)
            seen()
    except (WebSocketDisconnect, TimeoutError):
        return
