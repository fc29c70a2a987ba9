"""The console as a process: links, TLS, rigs that come and go, pages that hang, and the end."""

import asyncio
import datetime as dt
import shutil
import signal
import socket
import ssl
import sys
from asyncio.subprocess import PIPE
from contextlib import AsyncExitStack, asynccontextmanager
from urllib.parse import urlsplit

import msgpack
import pytest
from websockets.exceptions import InvalidStatus

from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.commands import StopReply
from ldcnd.contract.keys import Keys
from ldcnd.contract.meta import DaemonInfo
from ldcnd.net.session import Qos
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.ops.pki.certificates import issue_daemon, new_authority
from tests.support.browser import console, entries, feed, hanging_page, path_of
from tests.support.process import LDCND, ROOT, answering, free_port, process
from tests.support.router import router

pytestmark = [pytest.mark.real_time, pytest.mark.timeout(180)]

PATIENCE_S = 60.0
BULKY = msgpack.packb({"value": "x" * 12_000})
DAEMON = DaemonInfo(
    rig="sim", version="1", api=1, instance="i1", started=1, encoding="msgpack", axes=("x",), buses=()
)  # fmt: skip


@asynccontextmanager
async def bulky_rig():
    """Show a rig of one axis whose samples are large; yields its endpoint and what publishes one."""
    keys, endpoint = Keys("sim"), f"tcp/127.0.0.1:{free_port()}"
    async with open_zenoh_session(ZenohSettings(listen=(endpoint,))) as session:

        def describe(query):
            query.reply(*encode(DAEMON, Encoding.JSON), key=keys.daemon)
            query.finish()

        def stop(query):
            query.reply(*encode(StopReply(axes=("x",), confirmed=("x",)), Encoding.JSON))

        await session.serve(keys.daemon, describe, complete=True)
        await session.serve(keys.all_stops[0], stop, complete=True, urgent=True)
        await session.declare_token(keys.alive("i1"))
        position = keys.telemetry("x", "position")
        yield endpoint, lambda: session.publish(position, BULKY, encoding="application/msgpack", qos=Qos.TELEMETRY)


async def connected(page, rig, *, wanted=True):
    """Wait until a page is told that a rig is there, or is not; return what it was told in between."""
    seen = []
    async with asyncio.timeout(PATIENCE_S):
        while True:
            told = await entries(page)
            seen += told
            if any((name, topic) == (rig, "rig") and sample["connected"] is wanted for name, topic, sample in told):
                return seen


@pytest.mark.long
async def test_a_page_that_never_reads_delays_nobody_and_the_console_ends_without_a_complaint(capfd):
    async with bulky_rig() as (endpoint, publish), console("-e", endpoint) as running:
        browser = await running.stranger.enter(running.link)
        with hanging_page(browser):
            async with feed(browser, "?rate=60") as page:
                await connected(page, "sim")
                for _ in range(100):  # frames, together far more than the kernel keeps for a page
                    publish()
                    while not any(topic == "tele/x/position" for _, topic, _ in await entries(page)):
                        pass
                stopped = await browser.post("/api/stop")
            running.process.send_signal(signal.SIGTERM)
            async with asyncio.timeout(PATIENCE_S):
                code = await running.process.wait()

    assert stopped.document["rigs"]["sim"]["confirmed"] == ["x"]
    assert code == 0
    assert not capfd.readouterr().err


async def test_a_page_that_is_open_over_a_restart_of_the_console_stops_and_does_nothing_else(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    listen = ("--listen", f"127.0.0.1:{free_port()}")
    async with bulky_rig() as (endpoint, _):
        async with console("-e", endpoint, *listen) as before:
            page_of_before = await before.stranger.enter(before.link)
            before.process.kill()
            await before.process.wait()
        async with console("-e", endpoint, *listen) as after:
            anew = await after.stranger.enter(after.link)
            async with feed(anew) as page:
                await connected(page, "sim")
            stopped = await page_of_before.post("/api/stop")
            others = [await page_of_before.post("/api/rigs/sim/axes/x/reset"), await page_of_before.get("/api/rigs")]
            forged = await page_of_before.forging(x_ldcnd_csrf="0011223344556677." + "0" * 64).post("/api/stop")

    assert stopped.document["rigs"]["sim"]["confirmed"] == ["x"]
    assert [each.status for each in (*others, forged)] == [401] * 3


@pytest.mark.long
async def test_a_release_that_is_installed_beside_a_console_changes_none_of_its_pages(tmp_path):
    await asyncio.to_thread(
        shutil.copytree, ROOT / "ldcnd", tmp_path / "ldcnd", ignore=shutil.ignore_patterns("__pycache__")
    )
    pages = tmp_path / "ldcnd" / "console" / "static"
    async with console("-e", f"tcp/127.0.0.1:{free_port()}", tree=tmp_path) as running:
        browser = await running.stranger.enter(running.link)
        before = [await browser.get(path) for path in ("/", "/static/main.js")]
        (pages / "index.html").write_text("of another release")
        (pages / "main.js").unlink()
        after = [await browser.get(path) for path in ("/", "/static/main.js")]
        known = await browser.forging(if_none_match=before[1].headers["etag"]).get("/static/main.js")

    assert [(each.status, each.body) for each in after] == [(200, each.body) for each in before]
    assert [each.headers["content-type"] for each in after] == [each.headers["content-type"] for each in before]
    assert (known.status, known.body) == (304, b"")


@pytest.mark.long
async def test_another_link_is_given_without_stopping_anything():
    async with console("-e", f"tcp/127.0.0.1:{free_port()}") as running:
        port = urlsplit(running.link).port
        asked = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "ldcnd", "console", "--link", "--listen", f"127.0.0.1:{port}", stdout=PIPE
        )
        printed, _ = await asked.communicate()
        link = printed.decode().splitlines()[0].removeprefix("console: ")
        browser = await running.stranger.enter(link)
        page = await browser.get("/")
        nowhere = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "ldcnd", "console", "--link", "--listen", f"127.0.0.1:{free_port()}", stderr=PIPE
        )
        _, refused = await nowhere.communicate()

    assert asked.returncode == 0
    assert link != running.link
    assert page.status == 200
    assert nowhere.returncode != 0
    assert b"ldcnd console" in refused


async def link_of(listen):
    """Ask for another link of the console at an address; return how that ended, and what was said."""
    asked = await asyncio.create_subprocess_exec(
        *LDCND, "console", "--link", "--listen", listen, stdout=PIPE, stderr=PIPE
    )
    printed, complaint = await asked.communicate()
    return asked.returncode, (printed + complaint).decode()


@pytest.mark.long
async def test_of_two_consoles_on_one_port_the_link_is_that_of_the_address_asked_for():
    port, nowhere = free_port(), f"tcp/127.0.0.1:{free_port()}"
    async with AsyncExitStack() as stack:
        for host in ("127.0.0.1", "127.0.0.2"):
            other = process("console", "-e", nowhere, "--listen", f"{host}:{port}")
            running = await stack.enter_async_context(other)
            assert f"//{host}:{port}" in (await running.stdout.readline()).decode()
        told = {host: await link_of(f"{host}:{port}") for host in ("127.0.0.1", "127.0.0.2", "localhost", "127.0.0.3")}

    assert [told[host][0] for host in told] == [0, 0, 0, 78]
    assert f"http://127.0.0.1:{port}/" in told["127.0.0.1"][1]
    assert f"http://127.0.0.2:{port}/" in told["127.0.0.2"][1]
    assert f"http://127.0.0.1:{port}/" in told["localhost"][1]
    assert f"no console of this user gives links at 127.0.0.3:{port}" in told["127.0.0.3"][1]
    assert all(f"{host}:{port}" in told["127.0.0.3"][1] for host in ("127.0.0.1", "127.0.0.2"))


@pytest.mark.long
async def test_the_web_server_refuses_what_the_gate_refuses():
    async with console("-e", f"tcp/127.0.0.1:{free_port()}") as running:
        used = await running.stranger.get(path_of(running.link))
        again = await running.stranger.get(path_of(running.link))
        running.process.send_signal(signal.SIGUSR1)
        browser = await running.stranger.enter(await running.printed_link())
        refusals = {}
        for name, wrong in {
            "stranger": running.stranger,
            "foreign origin": browser.forging(origin="http://evil.example"),
        }.items():
            with pytest.raises(InvalidStatus) as caught:
                async with feed(wrong):
                    pass
            refusals[name] = caught.value.response.status_code
        answers = {
            "page": await browser.get("/"),
            "static": await running.stranger.get("/static/index.html"),
            "outside static": await running.stranger.get("/static/../server.py"),
            "foreign host": await browser.forging(host="evil.example").get("/static/index.html"),
            "no rig": await browser.get("/api/rigs"),
        }
        async with asyncio.timeout(PATIENCE_S):
            while "cannot connect" not in (await browser.get("/api/rigs")).document["endpoints"][0]["problem"]:
                await asyncio.sleep(0.1)
        async with feed(browser) as page:
            await entries(page)
            await page.send("anything")
            async with asyncio.timeout(PATIENCE_S):
                await page.wait_closed()

    assert (used.status, again.status) == (303, 401)
    assert refusals == {"stranger": 403, "foreign origin": 403}
    assert {name: answer.status for name, answer in answers.items()} == {
        "page": 200,
        "static": 200,
        "outside static": 404,
        "foreign host": 400,
        "no rig": 200,
    }
    assert answers["page"].headers["cache-control"] == "no-store"
    assert answers["no rig"].document["rigs"] == []
    assert page.close_code == 1008


@pytest.mark.long
async def test_tls_and_a_token_let_in_whoever_has_it_and_cookies_stay_inside_tls(tmp_path):
    now = dt.datetime.now(dt.UTC)
    authority = new_authority("test", now)
    made = issue_daemon(authority, "console", ["127.0.0.1"], now, 1)
    files = {"cert.pem": made.certificate, "key.pem": made.key, "token": b"t" * 40}
    for name, text in files.items():
        (tmp_path / name).write_bytes(text)
        (tmp_path / name).chmod(0o600)
    trusting = ssl.create_default_context(cadata=authority.certificate.decode())
    options = (
        "--certificate",
        tmp_path / "cert.pem",
        "--key",
        tmp_path / "key.pem",
        "--token-file",
        tmp_path / "token",
    )

    nowhere = f"tcp/127.0.0.1:{free_port()}"
    async with console("-e", nowhere, *map(str, options), tls=trusting) as running:
        first, second = [await running.stranger.get(path_of(running.link)) for _ in range(2)]
        browser = await running.stranger.enter(running.link)
        stopped = await browser.post("/api/stop")
        plain = await browser.forging(origin=browser.origin.replace("https", "http")).post("/api/stop")

    assert running.link.startswith("https://127.0.0.1:")
    assert running.link.endswith("t" * 40)
    assert (first.status, second.status) == (303, 303)
    assert first.cookies != second.cookies
    assert "Secure" in first.headers["set-cookie"]
    assert (stopped.status, plain.status) == (200, 403)


@pytest.mark.long
async def test_what_cannot_be_served_or_would_let_strangers_in_is_refused_with_the_reason():
    taken = socket.create_server(("127.0.0.1", 0))
    with taken:
        cases = {
            ("--listen", "127.0.0.1:0", "-e", "nonsense"): "nonsense",
            ("--listen", "0.0.0.0:0"): "that takes --certificate and --key and --token-file",
            ("--listen", f"127.0.0.1:{taken.getsockname()[1]}"): "cannot listen on 127.0.0.1",
        }
        refused = [
            await asyncio.create_subprocess_exec(*LDCND, "console", *arguments, stdout=PIPE, stderr=PIPE)
            for arguments in cases
        ]
        for running, words in zip(refused, cases.values(), strict=True):
            async with asyncio.timeout(PATIENCE_S):
                printed, errors = await running.communicate()
            assert (running.returncode, printed) == (78, b"")
            assert words in errors.decode()
            assert "Traceback" not in errors.decode()


@pytest.mark.system
async def test_rigs_are_lost_and_regained_behind_daemons_and_routers(tmp_path):
    """Two rigs, two endpoints: a daemon itself, and a router with another daemon behind it."""
    direct, routed = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    other = tmp_path / "other.toml"
    simulated = (ROOT / "config" / "simulated.toml").read_text()
    other.write_text(simulated.replace('rig = "sim"', 'rig = "other"').replace("tcp/127.0.0.1:7447", "tcp/127.0.0.1:0"))
    run_direct = ("run", "--config", str(ROOT / "config" / "simulated.toml"), "--listen", direct)
    run_routed = ("run", "--config", str(other), "--listen", "tcp/127.0.0.1:0", "--connect", routed)
    async with AsyncExitStack() as stack:
        first_router = await stack.enter_async_context(router(routed))
        first_daemon = await stack.enter_async_context(process(*run_direct))
        behind_router = await stack.enter_async_context(process(*run_routed))
        running = await stack.enter_async_context(console("-e", direct, "-e", routed))
        browser = await running.stranger.enter(running.link)
        page = await stack.enter_async_context(feed(browser))
        others_page = await stack.enter_async_context(feed(browser, "?rigs=other"))
        await connected(page, "sim")
        await connected(others_page, "other")
        await answering(first_daemon, direct)
        await answering(behind_router, routed)
        both = await browser.post("/api/stop")
        described = (await browser.get("/api/rigs")).document["rigs"]

        first_daemon.kill()
        first_router.kill()
        await connected(page, "sim", wanted=False)
        await connected(others_page, "other", wanted=False)
        neither = await browser.post("/api/stop")
        lost = (await browser.get("/api/rigs")).document["rigs"]
        await first_router.wait()

        await stack.enter_async_context(router(routed))
        again = await stack.enter_async_context(process(*run_direct))
        await connected(page, "sim")
        await connected(others_page, "other")
        await answering(again, direct)
        regained = await browser.post("/api/stop")

    assert [(rig["name"], rig["endpoint"]) for rig in described] == [("other", routed), ("sim", direct)]
    assert [reply.get("status") for reply in both.document["rigs"].values()] == ["stopping"] * 2, both.document
    assert {rig["connected"] for rig in lost} == {False}
    assert all("daemon offline" in rig["problem"] for rig in lost)
    assert all(len(rig["axes"]) == 4 for rig in lost)
    assert all(reply["code"] in ("session_failed", "outcome_unknown") for reply in neither.document["rigs"].values())
    assert all(len(reply["axes"]) == 4 for reply in regained.document["rigs"].values())
