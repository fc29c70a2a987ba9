"""What anyone with Zenoh sees of a daemon in its own process: the public API of eclipse-zenoh only, and JSON Schema."""

import asyncio
import json
import re
import sys
import time
from asyncio.subprocess import PIPE, STDOUT, create_subprocess_exec
from collections.abc import Iterator
from itertools import pairwise
from statistics import median

import jsonschema
import msgpack
import pytest
import zenoh

from tests.support.command_line import run_all
from tests.support.process import ROOT, client, daemon

pytestmark = pytest.mark.real_time

RIG = ROOT / "config" / "simulated.toml"


def connect(endpoint: str) -> zenoh.Session:
    config = {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def get(session: zenoh.Session, selector: str, payload: object = None) -> dict[str, zenoh.Sample]:
    """Return the good answers by key."""
    text = None if payload is None else json.dumps(payload)
    replies = session.get(selector, payload=text, encoding="application/json", timeout=5)
    return {str(reply.ok.key_expr): reply.ok for reply in replies if reply.ok is not None}


def is_stopping(session: zenoh.Session, axis: str) -> bool:
    """Tell whether a stop of an axis is under way."""
    (state,) = get(session, f"ldcn/sim/tele/{axis}/state").values()
    return json.loads(state.payload.to_string())["state"] == "stopping"


@pytest.fixture(scope="module")
def served() -> Iterator[str]:
    """Return the endpoint of one daemon for the tests that only look and stop: to start one takes seconds."""
    with asyncio.Runner() as runner:
        running = daemon(RIG)
        yield runner.run(running.__aenter__())
        runner.run(running.__aexit__(None, None, None))


@pytest.mark.long
async def test_last_values_and_descriptions_are_readable_by_anyone(served):
    with connect(served) as session:
        telemetry = get(session, "ldcn/sim/tele/**")
        schemas = {
            key.rpartition("/")[2]: json.loads(sample.payload.to_string())
            for key, sample in get(session, "ldcn/sim/meta/schema/*").items()
        }

        keys = {key.removeprefix("ldcn/sim/tele/") for key in telemetry}
        items = ("position", "velocity", "adc", "inputs", "fault", "state")
        assert keys == {f"{axis}/{item}" for axis in "xyzc" for item in items}
        for key, sample in telemetry.items():
            assert str(sample.encoding) == "application/json"
            value = json.loads(sample.payload.to_string())
            jsonschema.validate(value, schemas[f"{key.rpartition('/')[2]}_sample"])
            assert sample.timestamp is not None
            assert abs(value["t"] - time.time_ns()) < 30e9
            assert value["quality"] in ("good", "uncertain", "bad")

        packed = get(session, "ldcn/sim/tele/x/position?enc=msgpack")["ldcn/sim/tele/x/position"]
        assert str(packed.encoding) == "application/msgpack;position_sample"
        jsonschema.validate(msgpack.unpackb(packed.payload.to_bytes()), schemas["position_sample"])

        meta = {
            key.removeprefix("ldcn/sim/meta/"): json.loads(sample.payload.to_string())
            for key, sample in get(session, "ldcn/sim/meta/**").items()
        }
        jsonschema.validate(meta["daemon"], schemas["daemon_info"])
        jsonschema.validate(meta["axes/x"], schemas["axis_info"])
        assert meta["axes/x"]["unit"] == "mm"
        assert meta["daemon"]["axes"] == ["x", "y", "z", "c"]
        for command in meta["commands"]["commands"]:
            assert command["request_schema"] in schemas
            assert command["reply_schema"] in schemas
        on_disk = {path.stem: json.loads(path.read_text()) for path in (ROOT / "schemas").glob("*.json")}
        assert schemas == on_disk

        alive = f"ldcn/sim/alive/{meta['daemon']['instance']}"
        expected = {alive} | {f"{alive}/axis/{axis}" for axis in "xyzc"}
        # an axis is alive when its line is up, which may be after the daemon has answered
        async with asyncio.timeout(30):
            while (tokens := alive_tokens(session)) != expected:
                assert tokens < expected
                await asyncio.sleep(0.1)


def alive_tokens(session):
    return {str(reply.ok.key_expr) for reply in session.liveliness().get("ldcn/sim/alive/**") if reply.ok}


async def test_a_wildcard_moves_nothing_and_a_stop_needs_nothing(served):
    with connect(served) as session:
        assert not any("@" in key for key in get(session, "**"))
        assert get(session, "ldcn/sim/@cmd/x/power", {"on": True})

        replies = list(session.get("ldcn/sim/@cmd/*/move_absolute", payload='{"position": 5}', timeout=5))
        assert [json.loads(reply.err.payload.to_string())["code"] for reply in replies] == ["wildcard_refused"]

        stopped = get(session, "ldcn/sim/@stop")
        (answer,) = stopped.values()
        assert json.loads(answer.payload.to_string())["confirmed"] == ["x", "y", "z", "c"]
        state = get(session, "ldcn/sim/tele/x/state")["ldcn/sim/tele/x/state"]
        assert json.loads(state.payload.to_string())["stop_latched"] is True


@pytest.mark.long
async def test_a_storage_that_answers_with_older_values_deceives_no_client(served):
    """The storage is stock Zenoh: it keeps what was published once, and answers every key with it from then on."""
    with connect(served) as session, connect(served) as storage:
        old = get(session, "ldcn/sim/tele/**")

        def answer(query):
            for key, sample in old.items():
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, sample.payload, encoding=sample.encoding, timestamp=sample.timestamp)

        declared = storage.declare_queryable("ldcn/**", answer, complete=True)
        await command_line(served, "reset", "y")
        await command_line(served, "power", "on", "y")
        await command_line(served, "move", "y", "9", "--velocity", "5", "--wait")
        (truth,) = (
            json.loads(reply.ok.payload.to_string())
            for reply in session.get("ldcn/sim/tele/y/position", target=zenoh.QueryTarget.ALL, timeout=5)
            if reply.ok and str(reply.replier_id.zid) != str(storage.zid())
        )
        listed = await command_line(served, "list")
        async with client(served) as rig:
            positions, state = await rig.positions(), await rig.state("y")
        declared.undeclare()

    assert truth["value"] == pytest.approx(9, abs=0.05)
    assert positions["y"].value == pytest.approx(9, abs=0.05)
    assert state.enabled
    assert re.search(r"^y .* (8\.9|9\.0)\d* mm", listed, re.MULTILINE), listed


async def command_line(endpoint: str, *arguments: str) -> str:
    """Run one command that succeeds; return what it prints."""
    running = await create_subprocess_exec(
        sys.executable, "-m", "ldcnd", *arguments, "--connect", endpoint, stdout=PIPE, stderr=STDOUT, cwd=ROOT
    )
    async with asyncio.timeout(60):
        printed, _ = await running.communicate()
    assert running.returncode == 0, printed.decode()
    return printed.decode()


@pytest.mark.long
async def test_published_samples_count_up_and_bear_the_instant_of_measurement(served):
    with connect(served) as session:
        received = session.declare_subscriber("ldcn/sim/tele/x/position", zenoh.handlers.FifoChannel(100))
        samples = [received.recv() for _ in range(20)]
        received.undeclare()

    values = [msgpack.unpackb(sample.payload.to_bytes()) for sample in samples]
    assert [value["seq"] for value in values] == list(range(values[0]["seq"], values[0]["seq"] + 20))
    # medians: a machine that stands still for a moment delays some samples
    assert median((late["t"] - early["t"]) / 1e9 for early, late in pairwise(values)) == pytest.approx(1 / 20, rel=0.2)
    assert median(value["t_error_ns"] for value in values) < 100e6
    for sample, value in zip(samples, values, strict=True):
        assert value["t_error_ns"] > 0
        assert abs(sample.timestamp.get_time().timestamp() - value["t"] / 1e9) < 0.001


@pytest.mark.long
async def test_a_json_rig_is_readable_by_tools_that_print_what_they_get(tmp_path):
    # what the examples z_sub, z_get and z_get_liveliness of eclipse-zenoh do, call by call
    config = tmp_path / "json.toml"
    config.write_text(RIG.read_text() + '\n[telemetry]\nencoding = "json"\n')
    async with daemon(config) as endpoint:
        with connect(endpoint) as session:
            received = session.declare_subscriber("ldcn/sim/tele/**", zenoh.handlers.FifoChannel(100))
            printed = [
                f">> [Subscriber] Received {sample.kind} ('{sample.key_expr}': '{sample.payload.to_string()}')"
                for sample in (received.recv() for _ in range(60))
            ]
            received.undeclare()
            encodings = {str(reply.ok.encoding) for reply in session.get("ldcn/sim/tele/*/state") if reply.ok}
            asked = [reply.ok.payload.to_string() for reply in session.get("ldcn/sim/tele/x/**") if reply.ok]
            shown = [str(reply.ok.key_expr) for reply in session.liveliness().get("ldcn/**") if reply.ok]

    for line in printed:
        key, value = re.fullmatch(r">> \[Subscriber\] Received \S+ \('(\S+)': '(.+)'\)", line).groups()
        assert key.startswith("ldcn/sim/tele/")
        assert json.loads(value)["t"] > 0
    assert encodings == {"application/json"}
    assert len(asked) == 6
    assert all(json.loads(value)["quality"] for value in asked)
    assert sum("/axis/" in key for key in shown) == 4


@pytest.mark.long
async def test_the_tour_of_the_readme_runs(tmp_path):
    text = (ROOT / "README.md").read_text()
    commands = re.findall(r"^\.venv/bin/(ldcnd (?!top|run).*)$", text, re.MULTILINE)
    assert len(commands) >= 6

    async with daemon(RIG) as endpoint:
        typed = [f"{command} --connect {endpoint}" for command in commands]
        ran = await run_all(tmp_path, *typed[:-1])
        with connect(endpoint) as session:
            async with asyncio.timeout(20):
                while is_stopping(session, "x"):  # a reset is refused until then
                    await asyncio.sleep(0.05)
        ran += await run_all(tmp_path, *typed[-1:])

    assert [(each.code, command) for each, command in zip(ran, commands, strict=True)] == [
        (0, command) for command in commands
    ], ran


@pytest.mark.long
async def test_a_command_without_a_daemon_says_so_and_exits_with_3():
    done = await create_subprocess_exec(
        sys.executable, "-m", "ldcnd", "list", "--connect", "tcp/127.0.0.1:1", stdout=PIPE, stderr=STDOUT
    )
    printed, _ = await done.communicate()

    assert done.returncode == 3
    assert b"tcp/127.0.0.1:1" in printed
