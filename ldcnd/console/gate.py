"""The gate before everything else: which hosts, origins and visitors get through, and what every answer says.

Only `/static/` is served without a visitor's cookie. What changes anything needs the cookie, a header that only the
console's own pages can set, and the console's own origin; a WebSocket needs cookie and origin, because browsers let any
page open one. What only brings axes to rest needs no cookie: a page that was let in keeps its header, whatever becomes
of the cookies of its browser and of the console's process, and may have axes under way.

Browsers keep one set of cookies for all ports of a host, so the names of these have the port that the browser sees.
"""

import re
from collections.abc import Iterable
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ldcnd.console.visitors import Visitor, Visitors, is_csrf_of
from ldcnd.contract.catalogue import BY_VERB
from ldcnd.contract.codec import error_reply
from ldcnd.contract.commands import About
from ldcnd.contract.errors import NotPermitted

SESSION_COOKIE = "ldcnd_session_"
CSRF_COOKIE = "ldcnd_csrf_"
"""Both are followed by the port in the console's address; by nothing where that is the usual one of its scheme."""
CSRF_HEADER = "x-ldcnd-csrf"
POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; frame-ancestors 'none'; base-uri 'none';"
    " form-action 'self'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
SAFE_METHODS = frozenset({"GET", "HEAD"})
_CALMING = {
    about: "|".join(verb for verb, command in BY_VERB[about].items() if command.may_take_energy_out())
    for about in (About.AXIS, About.RIG)
}
MAY_CALM = re.compile(
    rf"/api/(stop|rigs/[^/]+/(stop|run/stop|axes/[^/]+/({_CALMING[About.AXIS]})|rig/({_CALMING[About.RIG]})))"
)
"""What may take energy out: of power and of the speed override their values say whether it does."""
WEBSOCKET_POLICY_VIOLATION = 1008

STRANGER_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>ldcnd console</title>
<link rel="stylesheet" href="/static/style/base.css"><script src="/static/again.js"></script></head>
<body><main><h1>This browser is not let in yet</h1>
<p><strong>This page stops nothing</strong>: use <code>ldcnd stop</code>, a page that is open, or the emergency stop
of the machine.</p>
<p>Open the console with the link that <code>ldcnd console</code> prints when it starts. A link works once, within ten
minutes. For another one, press <i>Let another browser in</i> on a page that is open, or send the console's process the
signal USR1: it then prints one.</p>
<p>If you came here by a link just now, <a href="/">try once more</a>.</p></main></body></html>
"""
"""Its script asks once more: cookies that are strict do not come with a request that another site has led to."""


class RequestGate:
    """Wraps the application.

    Args:
        app: what is behind the gate; finds the `Visitor` in the scope's state.
        visitors: who was let in.
        scheme: http or https.
        hosts: names and addresses under which browsers may reach the console, without ports.
    """

    def __init__(self, app: ASGIApp, visitors: Visitors, scheme: str, hosts: Iterable[str]) -> None:
        self._app = app
        self._visitors = visitors
        self._scheme = scheme
        self._hosts = frozenset(host.lower() for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on what may pass, answer the rest."""
        path = scope["path"]

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(raw=message["headers"])
                headers.update(HEADERS)
                headers["Cache-Control"] = "no-cache" if path.startswith("/static/") else "no-store"
            await send(message)

        answer = self._answer(scope)
        if answer is None:
            await self._app(scope, receive, send_with_headers)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": WEBSOCKET_POLICY_VIOLATION})  # 403 before it is accepted
        else:
            await answer(scope, receive, send_with_headers)

    def _answer(self, scope: Scope) -> Response | None:
        """Return the answer to what does not get through.

        Of what does, note the visitor, and the answer to give unless it takes energy out.
        """
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        name, port = _parts(host)
        if name not in self._hosts:
            return _refusal(400, f"this console is not known as {host[:80]!r}")
        if scope["type"] == "http" and scope["path"].startswith("/static/"):
            return None
        visitor = self._visitors.find(HTTPConnection(scope).cookies.get(SESSION_COOKIE + port, ""))
        if scope["type"] == "http" and scope["path"] == "/" and scope["method"] == "GET":
            token = parse_qs(scope["query_string"].decode("latin-1")).get("link")
            if token:
                return self._let_in(token[-1], visitor, port)
        refusal = self._why_not(scope, visitor)
        if refusal and scope["type"] == "http" and scope["method"] == "POST" and MAY_CALM.fullmatch(scope["path"]):
            # whoever has only a page that was let in once ends motions with it, and does nothing else
            visitor = self._visitors.of_page(headers.get(CSRF_HEADER, ""))
            if visitor is None or self._why_not(scope, visitor):
                return refusal
        elif refusal:
            return refusal
        scope.setdefault("state", {}).update(visitor=visitor, refusal=refusal)
        return None

    def _why_not(self, scope: Scope, visitor: Visitor | None) -> Response | None:
        """Return the answer to who does not get through as this visitor; None where who asks does."""
        headers = Headers(scope=scope)
        if visitor is None:
            return _stranger(scope["path"])
        if scope["type"] == "websocket" or scope["method"] not in SAFE_METHODS:
            if headers.get("origin") != f"{self._scheme}://{headers.get('host', '')}":
                return _refusal(403, "this request is not from a page of this console (Origin)")
            if scope["type"] == "http" and not is_csrf_of(visitor, headers.get(CSRF_HEADER, "")):
                return _refusal(403, "this request is not from a page of this visitor (X-Ldcnd-Csrf)")
        return None

    def _let_in(self, token: str, known: Visitor | None, port: str) -> Response:
        """Let a browser in; one that is in remains who it is, because its pages may control axes."""
        visitor = self._visitors.enter(token, known)
        if visitor is None:
            return _stranger("/")
        response, secure = RedirectResponse("/", status_code=303), self._scheme == "https"
        session, csrf = SESSION_COOKIE + port, CSRF_COOKIE + port
        response.set_cookie(session, visitor.token, path="/", secure=secure, httponly=True, samesite="strict")
        response.set_cookie(csrf, visitor.csrf, path="/", secure=secure, samesite="strict")
        return response


def _stranger(path: str) -> Response:
    if path.startswith("/api/"):
        return _refusal(401, "this browser is not let in")
    return HTMLResponse(STRANGER_PAGE, 401)


def _refusal(status: int, message: str) -> Response:
    reply = error_reply(NotPermitted(message, remedy="open the console with the link that it prints"))
    return Response(reply.model_dump_json(), status, media_type="application/json")


def _parts(host: str) -> tuple[str, str]:
    """Return name and port, which is empty where none is said."""
    name, colon, port = host.rpartition(":")
    return (name.lower(), port) if colon and (not port or (port.isascii() and port.isdecimal())) else (host.lower(), "")
