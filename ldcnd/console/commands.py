"""Commands of pages on their way to the daemons: each becomes one query, and is never repeated."""

import asyncio
import json
from collections.abc import Mapping
from types import MappingProxyType

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from ldcnd.client.rig_client import RigClient
from ldcnd.console.errors import answering_errors
from ldcnd.console.replies import StopsReply
from ldcnd.console.rigs import Rigs
from ldcnd.errors import LdcndError, MalformedRequest, PayloadTooLarge, UnknownVerb
from ldcnd.messaging.codec import MAX_PAYLOAD_BYTES, Encoding, decode, error_reply
from ldcnd.model.errors import ErrorReply
from ldcnd.model.frozen import Frozen
from ldcnd.model.replies import StopReply
from ldcnd.model.requests import REQUEST_MODELS, Verb
from ldcnd.model.verbs import AXIS_QUESTIONS, MOVE_TOGETHER, RIG_VERBS, VerbModels

BODY_TIME_S = 5.0
"""A page has so long to send what it asks."""
ANSWER_TIME_S = 5.0
SLOW_VERBS_S: Mapping[str, float] = MappingProxyType(
    {
        Verb.TRACE: 30.0,
        Verb.TRACE_ABORT: 10.0,
        Verb.READ_PARAMETER: 60.0,
        Verb.READ_ALL_PARAMETERS: 60.0,
        Verb.WRITE_PARAMETER: 60.0,
        Verb.CLEAR_COUNTER: 60.0,
        Verb.READ_ALARMS: 60.0,
    }
)
"""What takes many words with a slow drive."""
STOP_TIME_S = 3.0


class StopScope(Frozen):
    """What a page wants stopped."""

    axis: str | None = None
    """One axis; None means the rig."""


def command_routes(rigs: Rigs) -> list[Route]:
    """Return what pages may POST."""

    async def axis_command(request: Request) -> Response:
        client, axis = rigs.client(request.path_params["rig"]), request.path_params["axis"]
        verb = request.path_params["verb"]
        body = await _body(request)
        if verb in AXIS_QUESTIONS:
            asked = decode(AXIS_QUESTIONS[verb].request, body, Encoding.JSON)
            return _json(await client.axis_question(axis, verb, asked, AXIS_QUESTIONS[verb].reply))
        if verb not in set(Verb):
            raise _unknown(verb)
        meant = decode(REQUEST_MODELS[Verb(verb)], _signed(body, request.state.visitor.client), Encoding.JSON)
        return _json(await client.command(axis, Verb(verb), meant, SLOW_VERBS_S.get(verb, ANSWER_TIME_S)))

    async def rig_command(request: Request) -> Response:
        client = rigs.client(request.path_params["rig"])
        verb = request.path_params["verb"]
        if verb not in RIG_VERBS:
            raise _unknown(verb)
        models: VerbModels = RIG_VERBS[verb]
        body = await _body(request)
        if verb == MOVE_TOGETHER:
            body = _each_signed(body, request.state.visitor.client)
        elif "client" in models.request.model_fields:
            body = _signed(body, request.state.visitor.client)
        return _json(await client.rig_command(verb, decode(models.request, body, Encoding.JSON), models.reply))

    async def stop(request: Request) -> Response:
        client = rigs.client(request.path_params["rig"])
        return _json(await client.stop(decode(StopScope, await _body(request), Encoding.JSON).axis, STOP_TIME_S))

    async def stop_all(_: Request) -> Response:
        async with asyncio.TaskGroup() as group:
            stops = {rig: group.create_task(_stopped(rigs.client(rig)), name=f"stop {rig}") for rig in rigs.names}
        return _json(StopsReply(rigs={rig: task.result() for rig, task in stops.items()}))

    routes = {
        "/api/stop": stop_all,
        "/api/rigs/{rig}/stop": stop,
        "/api/rigs/{rig}/rig/{verb}": rig_command,
        "/api/rigs/{rig}/axes/{axis}/{verb}": axis_command,
    }
    return [Route(path, answering_errors(answer), methods=["POST"]) for path, answer in routes.items()]


async def _stopped(client: RigClient) -> StopReply | ErrorReply:
    try:
        return await client.stop(timeout_s=STOP_TIME_S)
    except LdcndError as error:
        return error_reply(error)


async def _body(request: Request) -> bytes:
    """Return what a page has sent.

    Raises:
        PayloadTooLarge: it is longer than any request.
        MalformedRequest: it did not come in time.
    """
    body = b""
    try:
        async with asyncio.timeout(BODY_TIME_S):
            async for part in request.stream():
                body += part
                if len(body) > MAX_PAYLOAD_BYTES:
                    raise PayloadTooLarge(
                        f"the request has more than {MAX_PAYLOAD_BYTES} bytes", limit=MAX_PAYLOAD_BYTES
                    )
    except TimeoutError:
        raise MalformedRequest(f"the request did not come within {BODY_TIME_S:g} s") from None
    return body


def _signed(body: bytes, client: str) -> bytes:
    """Return a request with the name of whoever sends it, whatever it said."""
    request = _object(body)
    return body if request is None else json.dumps(request | {"client": client}).encode()


def _each_signed(body: bytes, client: str) -> bytes:
    """Return a request of several moves, each with the name of whoever sends it."""
    request = _object(body)
    moves = request and request.get("moves")
    if not isinstance(moves, list) or not all(isinstance(move, dict) for move in moves):
        return body
    return json.dumps({**(request or {}), "moves": [move | {"client": client} for move in moves]}).encode()


def _object(body: bytes) -> dict[str, object] | None:
    """Return a JSON object; None for what is none: that is refused where it is decoded, in the usual words."""
    try:
        request = json.loads(body or b"{}")
    except (ValueError, RecursionError):
        return None
    return request if isinstance(request, dict) else None


def _unknown(verb: str) -> UnknownVerb:
    return UnknownVerb(f"there is no command {verb[:40]!r}", value=verb[:40], remedy="see `commands` of the rig")


def _json(reply: Frozen) -> Response:
    return Response(reply.model_dump_json(), media_type="application/json")
