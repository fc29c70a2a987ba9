"""Who gets through to the console, and who does not; each refusal leaves the rig alone."""

from itertools import product

import pytest

from ldcnd.console.visitors import LINK_S
from tests.support.browser import Browser, path_of
from tests.support.console_rig import ORIGIN, PageSocket, RunningConsole, page, running_console

POWER = "/api/rigs/sim/axes/x/power"
OVERRIDE = "/api/rigs/sim/rig/set_speed_override"
ON = {"on": True}


@pytest.fixture
async def console():
    async with running_console() as running:
        yield running


async def untouched(console: RunningConsole) -> bool:
    """Tell whether nothing was asked of the axis."""
    state = await console.rig.client.state("x")
    return not state.enabled and not (await console.rig.client.state("y")).stop_latched


async def refused(console: RunningConsole, browser: Browser) -> PageSocket:
    async with page(console.app, browser) as socket:
        return socket


async def test_what_visitors_may_do_works(console):
    assert (await console.browser.get("/api/rigs")).status == 200
    assert (await console.browser.post(POWER, ON)).status == 200
    async with page(console.app, console.browser) as socket:
        assert await socket.frame()


async def test_strangers_read_nothing(console):
    for path in ("/api/rigs", "/api/rigs/sim/axes/x/trace", "/", "/faults/overcurrent", "/anything"):
        answer = await console.browser.without_cookies().get(path)

        assert answer.status == 401, path
        assert b"link" in answer.body
        assert b"LS-182AP" not in answer.body


async def test_strangers_command_nothing(console):
    for path in (POWER, "/api/stop", "/api/rigs/sim/stop", "/api/rigs/sim/rig/acquire", "/api/link"):
        answer = await console.browser.without_cookies().post(path, ON)

        assert answer.status == 401, path
        assert answer.document["code"] == "not_permitted"
        assert answer.document["remedy"] not in answer.document["message"]
    assert await untouched(console)


@pytest.mark.parametrize(
    "cookie", ["ldcnd_session_8470=guess", "ldcnd_session_8470=", "ldcnd_session_8470=\xe9", "nonsense"]
)
async def test_a_wrong_cookie_is_a_stranger_s(console, cookie):
    answer = await console.browser.forging(cookie=cookie).post(POWER, ON)

    assert answer.status == 401
    assert await untouched(console)


@pytest.mark.parametrize(
    "origin",
    ["", "null", "http://evil.example", "https://127.0.0.1:8470", "http://127.0.0.1:8471", f"{ORIGIN}.evil.example"],
)
@pytest.mark.sweep(2)
async def test_a_command_from_another_origin_is_refused(console, origin):
    for path in (POWER, "/api/stop", "/api/link"):
        answer = await console.browser.forging(origin=origin).post(path, ON)

        assert answer.status == 403, path
        assert answer.document["code"] == "not_permitted"
    assert await untouched(console)


@pytest.mark.parametrize("token", ["", "guess"])
async def test_a_command_without_the_token_of_its_visitor_is_refused(console, token):
    answer = await console.browser.forging(x_ldcnd_csrf=token).post(POWER, ON)

    assert answer.status == 403
    assert await untouched(console)


async def test_the_token_of_another_visitor_does_not_help(console):
    other = await console.enter()

    answer = await console.browser.forging(x_ldcnd_csrf=other.csrf).post(POWER, ON)

    assert answer.status == 403
    assert await untouched(console)


@pytest.mark.parametrize(
    "host", ["", "evil.example", "evil.example:8470", "127.0.0.1.evil.example:8470", "[::2]:8470", "127.0.0.1:8470:1"]
)
@pytest.mark.sweep(2)
async def test_a_name_that_is_not_the_console_s_is_refused(console, host):
    """An evil page whose name is made to mean this machine comes with its own name."""
    read = await console.browser.forging(host=host).get("/api/rigs")
    written = await console.browser.forging(host=host, origin=f"http://{host}").post(POWER, ON)

    assert (read.status, written.status) == (400, 400)
    assert await untouched(console)


@pytest.mark.parametrize("host", ["localhost:8470", "[::1]:8470", "LOCALHOST:9000", "127.0.0.1:9000"])
@pytest.mark.sweep(2)
async def test_a_tunnel_may_come_through_any_port_of_this_machine(console, host):
    """`ssh -L 9000:127.0.0.1:8470` changes the port that the browser sees."""
    origin = f"http://{host}"
    stranger = Browser(console.browser.ask, origin)
    browser = await stranger.enter(f"{origin}/?link={console.visitors.new_link()}")

    assert (await browser.post(POWER, ON)).status == 200


async def test_a_page_without_its_cookies_goes_on_ending_motions_and_does_nothing_else(console):
    page_of_old = console.browser.forging(cookie="ldcnd_session_8471=another", x_ldcnd_csrf=console.browser.csrf)

    ended = [await page_of_old.post(f"/api/rigs/sim/axes/x/{verb}") for verb in ("halt", "quick_stop")]
    ended.append(await page_of_old.post(POWER, {"on": False}))
    ended.append(await page_of_old.post(OVERRIDE, {"percent": 0}))
    ended += [
        await page_of_old.post(path, {}) for path in ("/api/rigs/sim/stop", "/api/stop", "/api/rigs/sim/run/stop")
    ]
    refused = [await page_of_old.post(path, ON) for path in (POWER, "/api/rigs/sim/axes/x/reset", "/api/link")]
    refused += [await page_of_old.post(OVERRIDE, {"percent": 50}), await page_of_old.post(POWER, {"on": "maybe"})]
    refused.append(await page_of_old.get("/api/rigs"))
    forged = await page_of_old.forging(origin="http://127.0.0.1:8471").post("/api/stop")

    assert [each.status for each in ended] == [200] * 7
    assert [each.status for each in refused] == [401, 401, 401, 401, 400, 401]
    assert forged.status == 401


async def test_a_browser_that_is_in_stays_who_it_is_with_another_link(console):
    """Its pages may control axes."""
    link = path_of((await console.browser.post("/api/link")).document["link"])

    again, late = await console.browser.get(link), await console.browser.without_cookies().get(link)

    assert (again.status, again.cookies) == (303, console.browser.cookies)
    assert late.status == 401


async def test_consoles_on_one_host_keep_their_logins_apart(console):
    """A browser hands all cookies of a host to each of its ports."""
    origin = "http://127.0.0.1:8471"
    other = await Browser(console.browser.ask, origin).enter(f"{origin}/?link={console.visitors.new_link()}")

    assert not console.browser.cookies.keys() & other.cookies.keys()


@pytest.mark.parametrize(
    "forged", [None, {"origin": ""}, {"origin": "http://evil.example"}, {"host": "evil.example"}], ids=str
)
async def test_a_websocket_of_a_stranger_or_from_elsewhere_is_refused_before_it_opens(console, forged):
    browser = console.browser.forging(**forged) if forged else console.browser.without_cookies()
    socket = await refused(console, browser)

    assert (socket.status, socket.closed) == (None, 1008)  # which the web server answers with 403


async def test_a_link_works_once(console):
    link = path_of((await console.browser.post("/api/link")).document["link"])
    stranger = console.browser.without_cookies()

    first, second = await stranger.get(link), await stranger.get(link)

    assert (first.status, second.status) == (303, 401)
    assert second.cookies == {}


async def test_a_link_works_for_ten_minutes(console, monkeypatch):
    late = path_of((await console.browser.post("/api/link")).document["link"])
    monkeypatch.setattr(console.visitors, "_now_s", lambda: LINK_S + 1e6)

    assert (await console.browser.without_cookies().get(late)).status == 401


async def test_cookies_are_for_this_site_only_and_the_session_is_not_for_scripts(console):
    link = path_of((await console.browser.post("/api/link")).document["link"])

    given = [text.lower() for name, text in (await raw_headers(console, link)) if name == "set-cookie"]

    session = next(text for text in given if text.startswith("ldcnd_session_="))
    csrf = next(text for text in given if text.startswith("ldcnd_csrf_="))
    assert "httponly" in session
    assert "httponly" not in csrf
    assert all("samesite=strict" in text and "path=/" in text for text in given)


async def raw_headers(console, path):
    seen = []

    async def send(message):
        seen.extend(message.get("headers", []))

    scope = {"type": "http", "method": "GET", "path": "/", "query_string": path.partition("?")[2].encode()}
    await console.app(scope | {"headers": [(b"host", b"localhost")]}, None, send)
    return [(name.decode().lower(), text.decode()) for name, text in seen]


async def test_every_answer_says_what_a_browser_may_do_with_it(console):
    known, stranger = console.browser, console.browser.without_cookies()
    for browser, path in product((known, stranger), ("/api/rigs", "/nothing", "/api/rigs/none/axes/x/trace")):
        headers = (await browser.get(path)).headers

        assert "default-src 'self'" in headers["content-security-policy"]
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["cache-control"] == "no-store"


async def test_a_command_is_not_a_get(console):
    answer = await console.browser.get("/api/stop")

    assert answer.status == 405
    assert await untouched(console)
