"""What bad input gets: one typed error, and nothing on the wire."""

import json

import msgpack
import pytest

from ldcnd.contract.codec import MAX_PAYLOAD_BYTES
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.line.flight_recorder import WireEvent
from tests.support.rig import RunningRig, running_rig

X = "ldcn/sim/@cmd/x"
LOOKING = {CommandCode.READ_STATUS}


def sent_commands(rig: RunningRig) -> list[CommandCode]:
    """Return everything but polls that has gone over the wire since the line came up."""
    records = rig.daemon.rig.buses[0].bus.wire_log.records()
    packets = [record.data for record in records if record.event is WireEvent.SENT and record.data[:1] == b"\xaa"]
    return [command for command in (CommandCode(packet[2] & 0x0F) for packet in packets) if command not in LOOKING]


async def ask(rig: RunningRig, key: str, payload: bytes, encoding: str) -> dict[str, object]:
    """Return the one answer to a query, which must be an error."""
    answers = await rig.session.query(key, payload, encoding=encoding)
    assert len(answers) == 1
    assert answers[0].is_error
    assert answers[0].encoding == "application/json"
    return json.loads(answers[0].payload)


@pytest.mark.parametrize(
    ("key", "payload", "encoding", "code", "words"),
    [
        (f"{X}/move_absolute", b"", "", "malformed_request", ["position"]),
        (f"{X}/move_absolute", b"{", "application/json", "malformed_request", ["JSON"]),
        (f"{X}/move_absolute", b"\xc1", "application/msgpack", "malformed_request", ["msgpack"]),
        (f"{X}/move_absolute", b"[1, 2]", "application/json", "malformed_request", []),
        (f"{X}/move_absolute", b'{"position": "ten"}', "application/json", "malformed_request", ["position", "ten"]),
        (f"{X}/move_absolute", b'{"position": true}', "application/json", "malformed_request", ["position"]),
        (f"{X}/move_absolute", b'{"position": NaN}', "application/json", "malformed_request", ["position"]),
        (f"{X}/move_absolute", b'{"position": Infinity}', "application/json", "malformed_request", ["position"]),
        (
            f"{X}/move_absolute",
            msgpack.packb({"position": float("nan")}),
            "application/msgpack",
            "malformed_request",
            ["position"],
        ),
        (
            f"{X}/move_absolute",
            msgpack.packb({"position": float("-inf")}),
            "application/msgpack",
            "malformed_request",
            ["position"],
        ),
        (f"{X}/move_absolute", b'{"position": 1, "unit": "inch"}', "application/json", "malformed_request", ["unit"]),
        (f"{X}/move_absolute", b'{"position": 100.001}', "application/json", "position_limit", ["100", "mm", "axis x"]),
        (f"{X}/move_absolute", b'{"position": -1e300}', "application/json", "position_limit", ["-100"]),
        (
            f"{X}/move_absolute",
            b'{"position": 1, "velocity": 51}',
            "application/json",
            "velocity_limit",
            ["51", "50", "mm/s"],
        ),
        (
            f"{X}/move_absolute",
            b'{"position": 1, "acceleration": 1001}',
            "application/json",
            "acceleration_limit",
            ["1001", "1000"],
        ),
        (
            f"{X}/move_absolute",
            b'{"position": 1, "velocity": 0}',
            "application/json",
            "malformed_request",
            ["velocity"],
        ),
        (f"{X}/move_absolute", b'{"position": 1, "velocity": 1e-9}', "application/json", "value_out_of_range", []),
        (f"{X}/move_velocity", b'{"velocity": 0}', "application/json", "value_out_of_range", ["halt"]),
        (f"{X}/move_relative", b'{"distance": 1e12}', "application/json", "position_limit", ["100"]),
        (f"{X}/home", b'{"method": "current"}', "application/json", "not_supported", ["current", "index"]),
        (f"{X}/home", b'{"method": "magic"}', "application/json", "malformed_request", ["method"]),
        (f"{X}/set_gains", b'{"kp": 99999}', "application/json", "malformed_request", ["kp", "32767"]),
        (
            f"{X}/report_shadow",
            b'{"t": 1000000000000000000000000000000, "learning": false, "judged": 1}',
            "application/json",
            "malformed_request",
            ["t:"],
        ),
        (f"{X}/fly", b"{}", "application/json", "unknown_verb", ["fly", "move_absolute"]),
        (f"{X}/plan", b"{}", "application/json", "unknown_verb", ["preview"]),
        ("ldcn/sim/@cmd/nobody/halt", b"{}", "application/json", "unknown_axis", ["nobody", "x, y, z, c"]),
        ("ldcn/sim/@cmd/*/halt", b"{}", "application/json", "wildcard_refused", ["*"]),
        ("ldcn/sim/@cmd/x/*", b"{}", "application/json", "wildcard_refused", ["*"]),
        ("ldcn/*/@cmd/x/halt", b"{}", "application/json", "wildcard_refused", ["*"]),
        ("ldcn/sim/@cmd/**", b"{}", "application/json", "wildcard_refused", ["*"]),
        ("ldcn/sim/@cmd/x", b"{}", "application/json", "malformed_request", ["@cmd"]),
        (f"{X}/reset", b" " * (MAX_PAYLOAD_BYTES + 1), "application/json", "payload_too_large", ["16384"]),
    ],
)
@pytest.mark.sweep(3)
async def test_bad_input_gets_one_typed_error_and_nothing_reaches_the_wire(key, payload, encoding, code, words):
    async with running_rig() as rig:
        await rig.power_on("x")
        before = sent_commands(rig)

        error = await ask(rig, key, payload, encoding)

        assert error["code"] == code
        for word in words:
            assert word in f"{error['message']} {error.get('remedy')}"
        assert sent_commands(rig) == before
        assert await rig.client.daemon()


async def test_a_refusal_names_the_nearest_value():
    async with running_rig() as rig:
        await rig.power_on("x")

        error = await ask(rig, f"{X}/move_absolute", b'{"position": 250}', "application/json")

        assert (error["axis"], error["value"], error["limit"], error["nearest"]) == ("x", 250, 100, 100)
        assert error["retryable"] is False
