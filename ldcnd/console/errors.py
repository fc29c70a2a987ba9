"""Errors on their way to pages: the public error reply, and the status that HTTP has for it."""

from collections.abc import Awaitable, Callable

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from ldcnd.contract.codec import error_reply
from ldcnd.contract.errors import (
    LdcndError,
    MalformedRequest,
    NotPermitted,
    OutcomeUnknown,
    PayloadTooLarge,
    SessionError,
    UnknownAxis,
    UnknownVerb,
)

STATUS: tuple[tuple[tuple[type[LdcndError], ...], int], ...] = (
    ((MalformedRequest, PayloadTooLarge), 400),
    ((NotPermitted,), 403),
    ((UnknownAxis, UnknownVerb), 404),
    ((SessionError,), 503),
    ((OutcomeUnknown,), 504),
)
REFUSED = 409
"""Everything else: the daemon has refused it."""

Answer = Callable[[Request], Awaitable[Response]]


def error_response(error: LdcndError, status: int | None = None) -> Response:
    """Return the answer that tells of an error, with its own status unless another one is given."""
    if status is None:
        status = next((status for kinds, status in STATUS if isinstance(error, kinds)), REFUSED)
    return Response(error_reply(error).model_dump_json(), status, media_type="application/json")


def answering_errors(answer: Answer) -> Answer:
    """Return an endpoint that answers with the error where the other one raises it."""

    async def answered(request: Request) -> Response:
        try:
            return await answer(request)
        except LdcndError as error:
            return error_response(error)
        except ClientDisconnect:
            return Response(status_code=400)  # the browser has gone: this answer has no reader

    return answered
