"""Reads a page's request whole within a time and a size, and builds the answer as JSON."""

import asyncio

from starlette.requests import Request
from starlette.responses import Response

from ldcnd.contract.codec import MAX_PAYLOAD_BYTES
from ldcnd.contract.errors import MalformedRequest, PayloadTooLarge
from ldcnd.contract.frozen import Frozen

BODY_TIME_S = 5.0
"""Maximum time to receive the body of a request, seconds."""


async def body_of(request: Request) -> bytes:
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


def json_reply(reply: Frozen) -> Response:
    """Return a model as the answer."""
    return Response(reply.model_dump_json(), media_type="application/json")
