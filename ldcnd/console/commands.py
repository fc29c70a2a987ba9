"""Commands of pages on their way to the daemons: each becomes one query, and is never repeated."""

import asyncio
import json
from dataclasses import dataclass
from functools import partial

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from ldcnd.client.rig_client import RigClient
from ldcnd.console.control import PAGE_HEADER, page_of
from ldcnd.console.errors import Answer, answering_errors
from ldcnd.console.pages import PageControl, Pages, control_needed, refuse_unwatched
from ldcnd.console.replies import StopsReply
from ldcnd.console.requests import body_of, json_reply
from ldcnd.console.rigs import Rigs
from ldcnd.console.sequences import PauseRequest, RunRequest, Runs
from ldcnd.contract.catalogue import BY_VERB
from ldcnd.contract.codec import Encoding, decode, error_reply, understand
from ldcnd.contract.commands import About, AxisCommand, Command, ErrorReply, StopReply
from ldcnd.contract.errors import LdcndError, UnknownVerb
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.leases import Acquire, Release, Renew
from ldcnd.contract.questions import Why
from ldcnd.contract.rig_commands import AxisMove, MoveTogether, SetIo, SetIoTimer, SetSpeedOverride, WalkPath

STOP_TIME_S = 3.0
LEASE_COMMANDS: frozenset[type[Command[Frozen]]] = frozenset({Acquire, Renew, Release})
"""A lease that no open page renews would let axes move unwatched; pages take control by `/api/rigs/RIG/control`."""


class StopScope(Frozen):
    """The axes that a page stops."""

    axis: str | None = None
    """One axis; None means the rig."""


@dataclass(frozen=True, slots=True)
class Envelope:
    """The fields that the console adds to every command.

    Attributes:
        client: who sends it, whatever the page says.
        instance: the run of the daemon that it is meant for unless the page says so: the one whose values it shows.
    """

    client: str
    instance: str | None

    def around(self, body: bytes, model: type[Frozen]) -> bytes:
        """Return a request with what its model has of this; what is no request is refused where it is decoded."""
        try:
            request = json.loads(body or b"{}")
        except (ValueError, RecursionError):
            return body
        if not isinstance(request, dict):
            return body
        moves = request.get("moves")
        if model is MoveTogether and isinstance(moves, list):
            request["moves"] = [self._on(move, AxisMove) if isinstance(move, dict) else move for move in moves]
        return json.dumps(self._on(request, model)).encode()

    def _on(self, request: dict[str, object], model: type[Frozen]) -> dict[str, object]:
        written = {"instance": self.instance, **request, "client": self.client}
        return {name: value for name, value in written.items() if name in request or name in model.model_fields}


async def _axis_command(rigs: Rigs, pages: Pages, runs: Runs, request: Request) -> Response:
    """Send a command of an axis; what takes energy out whatever is wrong with the request, or with its page.

    That ends a sequence that uses the axis, too, whether the axis moves then or not.
    """
    rig, axis, verb = (request.path_params[name] for name in ("rig", "axis", "verb"))
    client = rigs.client(rig)
    kind = _class_of(About.AXIS, verb)
    page, gone = _page_or_why_not(request, pages)
    body, unread = await _body_of(request)
    envelope = Envelope(page.client if page else request.state.visitor.client, rigs.instance(rig))
    try:
        command, wrong = understand(kind, envelope.around(body, kind), Encoding.JSON)
    except LdcndError as error:
        raise unread or error from None
    if command.takes_energy_out and isinstance(command, AxisCommand):
        named = command.model_copy(update={"client": envelope.client})
        runs.cancel(rig, axis)
        reply = await client.command(axis, named)
        if complaint := unread or wrong:
            raise complaint.although(f"axis {axis[:64]}: {verb} was carried out, but")
        return json_reply(reply)
    if stranger := _stranger(request):
        return stranger
    if refusal := unread or gone:
        raise refusal
    if not isinstance(command, AxisCommand):
        if isinstance(command, Why) and page:
            command = command.model_copy(update={"lease": page.lease(rig, axis)})
        return json_reply(await client.ask(command, axis))
    if page:
        return json_reply(await page.command(rig, axis, command))
    refuse_unwatched(axis, command)
    return json_reply(await client.command(axis, command))


async def _rig_command(rigs: Rigs, pages: Pages, request: Request) -> Response:
    """Send a command of the rig."""
    rig, verb = (request.path_params[name] for name in ("rig", "verb"))
    client = rigs.client(rig)
    kind = _class_of(About.RIG, verb)
    if kind in LEASE_COMMANDS or kind is WalkPath:  # a page controls no path
        raise _unknown(verb)
    page, gone = _page_or_why_not(request, pages)
    envelope = Envelope(page.client if page else request.state.visitor.client, rigs.instance(rig))
    asked = decode(kind, envelope.around(await body_of(request), kind), Encoding.JSON)
    if not asked.takes_energy_out and (stranger := _stranger(request)):
        return stranger
    if gone and not asked.takes_energy_out:
        raise gone
    if isinstance(asked, MoveTogether):
        if page is None:
            raise control_needed(asked.moves[0].axis)
        return json_reply(await page.move_together(rig, asked))
    if isinstance(asked, SetIo | SetIoTimer | SetSpeedOverride) and page and not asked.takes_energy_out:
        asked = asked.model_copy(update={"leases": page.leases(rig)})
        if isinstance(asked, SetIo | SetSpeedOverride):
            asked = asked.model_copy(update={"after_stops": page.behind_jogs(rig, asked.after_stops)})
    return json_reply(await client.ask(asked))


def _stranger(request: Request) -> Response | None:
    """Return the answer to who may only take energy out here; None to who may do more."""
    refusal: Response | None = request.state.refusal
    return refusal


async def _stop(rigs: Rigs, runs: Runs, request: Request) -> Response:
    """Stop an axis, or the rig where it cannot be read which axis is meant; a sequence that uses it ends, too."""
    client = rigs.client(request.path_params["rig"])
    body, complaint = await _body_of(request)
    try:
        scope = decode(StopScope, body, Encoding.JSON)
    except LdcndError as error:
        scope, complaint = StopScope(), complaint or error
    runs.cancel(client.rig, scope.axis)
    reply = await client.stop(scope.axis, STOP_TIME_S, request.state.visitor.client)
    if complaint:
        raise complaint.although("the whole rig was stopped, but which axis was meant cannot be read:")
    return json_reply(reply)


def _page_or_why_not(request: Request, pages: Pages) -> tuple[PageControl | None, LdcndError | None]:
    """Return the page that sends a request, and why there is none any more: what takes energy out needs none."""
    try:
        return page_of(request, pages) if PAGE_HEADER in request.headers else None, None
    except LdcndError as error:
        return None, error


def command_routes(rigs: Rigs, pages: Pages, runs: Runs) -> list[Route]:
    """Return what pages may POST."""

    async def stop_all(request: Request) -> Response:
        return json_reply(StopsReply(rigs=await _all_stopped(rigs, runs, request.state.visitor.client)))

    async def run(request: Request) -> Response:
        page = page_of(request, pages)
        wanted = decode(RunRequest, await body_of(request), Encoding.JSON)
        return json_reply(await page.run(request.path_params["rig"], wanted))

    async def pause(request: Request) -> Response:
        page = page_of(request, pages)
        wanted = decode(PauseRequest, await body_of(request), Encoding.JSON)
        return json_reply(page.pause(request.path_params["rig"], on=wanted.on))

    async def end_run(request: Request) -> Response:  # of any page, with control or without: it takes energy out
        await runs.stop(request.path_params["rig"])
        return Response("{}", media_type="application/json")

    routes: dict[str, Answer] = {
        "/api/rigs/{rig}/run": run,
        "/api/rigs/{rig}/run/pause": pause,
        "/api/rigs/{rig}/run/stop": end_run,
        "/api/stop": stop_all,
        "/api/rigs/{rig}/stop": partial(_stop, rigs, runs),
        "/api/rigs/{rig}/rig/{verb}": partial(_rig_command, rigs, pages),
        "/api/rigs/{rig}/axes/{axis}/{verb}": partial(_axis_command, rigs, pages, runs),
    }
    return [Route(path, answering_errors(answer), methods=["POST"]) for path, answer in routes.items()]


async def _body_of(request: Request) -> tuple[bytes, LdcndError | None]:
    """Return what a page has sent, or nothing and why: what takes energy out is sent all the same."""
    try:
        return await body_of(request), None
    except LdcndError as error:
        return b"", error


async def _all_stopped(rigs: Rigs, runs: Runs, who: str) -> dict[str, StopReply | ErrorReply]:
    """Stop every rig, also those that come while the others are stopped."""
    stopped: dict[str, StopReply | ErrorReply] = {}
    while came := [rig for rig in rigs.names if rig not in stopped]:
        for rig in came:
            runs.cancel(rig)
        async with asyncio.TaskGroup() as group:
            stops = {rig: group.create_task(_stopped(rigs.client(rig), who), name=f"stop {rig}") for rig in came}
        stopped |= {rig: task.result() for rig, task in stops.items()}
    return stopped


async def _stopped(client: RigClient, who: str) -> StopReply | ErrorReply:
    try:
        return await client.stop(timeout_s=STOP_TIME_S, client=who)
    except LdcndError as error:
        return error_reply(error)


def _class_of(about: About, verb: str) -> type[Command[Frozen]]:
    if command := BY_VERB[about].get(verb):
        return command
    raise _unknown(verb)


def _unknown(verb: str) -> UnknownVerb:
    return UnknownVerb(f"there is no command {verb[:40]!r}", value=verb[:40], remedy="see `commands` of the rig")
