"""The codec: models survive both encodings, nonsense is explained, errors come back as what they were."""

import json
import math

import msgpack
import pydantic_core
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.contract.catalogue import AXIS_COMMANDS
from ldcnd.contract.codec import (
    MAX_PAYLOAD_BYTES,
    MAX_RECEIVED_BYTES,
    Encoding,
    decode,
    decode_error,
    decode_received,
    encode,
    encoding_name,
    error_reply,
    packer,
    rebuild_error,
    reply_encoding,
    to_json,
    understand,
)
from ldcnd.contract.commands import ErrorReply, Home, MoveAbsolute, Power, Reset
from ldcnd.contract.errors import ErrorCode, LdcndError, MalformedRequest, PayloadTooLarge, PositionLimit
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.samples import (
    AxisState,
    CurrentCommand,
    FaultEntry,
    FaultSample,
    LinkState,
    Moving,
    PositionSample,
    Quality,
    StateSample,
)

STATE = StateSample(
    t=1_700_000_000_123_456_789, t_error_ns=5, seq=3, quality=Quality.GOOD, state=AxisState.STANDSTILL, enabled=True,
    referenced=False, moving=Moving.NO, link=LinkState.UP, stop_latched=False, command=None,
)  # fmt: skip

finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.none() | st.floats(min_value=1e-300, max_value=1e300)
moves = st.builds(MoveAbsolute, position=finite, velocity=positive, acceleration=positive)
anything = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.parametrize("encoding", list(Encoding))
def test_a_sample_survives_either_encoding(encoding: Encoding) -> None:
    payload, name = encode(STATE, encoding)

    assert decode(StateSample, payload, name) == STATE


@pytest.mark.parametrize("encoding", list(Encoding))
def test_a_packer_says_the_same_as_encode_also_after_something_that_it_refused(encoding: Encoding) -> None:
    pack = packer(encoding)
    unreadable = STATE.model_copy(update={"command": object()})

    with pytest.raises(pydantic_core.PydanticSerializationError):
        pack(vars(unreadable))

    nowhere = PositionSample(
        t=1, t_error_ns=0, seq=0, quality=Quality.BAD, value=0.0, unit="mm", counts=0, following_error=None
    ).model_copy(update={"value": math.inf, "following_error": math.nan})
    for sample in (STATE, STATE.model_copy(update={"seq": 4, "last_error": "it did not"}), nowhere):
        assert (pack(vars(sample)), encoding_name(type(sample), encoding)) == encode(sample, encoding)


def test_encodings_are_named_as_stock_tools_expect() -> None:
    assert encode(STATE, Encoding.JSON)[1] == "application/json"
    assert encode(STATE, Encoding.MSGPACK)[1] == "application/msgpack;state_sample"


def test_both_encodings_say_the_same_of_models_within_models() -> None:
    fault = FaultEntry(code="overheat", text="too hot", since=1, source="drive")
    command = CurrentCommand(command_id="c-1", verb="home", since=1, target=-0.5)
    for model in (
        STATE.model_copy(update={"command": command}),
        FaultSample(t=1, t_error_ns=0, seq=0, quality=Quality.BAD, active=(fault, fault), first=fault),
    ):
        assert msgpack.unpackb(encode(model, Encoding.MSGPACK)[0]) == json.loads(encode(model, Encoding.JSON)[0])


@given(moves, st.sampled_from(list(Encoding)))
def test_every_request_survives_either_encoding(move: MoveAbsolute, encoding: Encoding) -> None:
    assert decode(MoveAbsolute, *encode(move, encoding)) == move


@pytest.mark.parametrize("name", ["", "zenoh/bytes", "zenoh/string", "text/plain"])
@pytest.mark.parametrize("payload", [b'{"on":true}', b' \n{"on":true}', msgpack.packb({"on": True})])
def test_a_payload_of_no_named_encoding_is_recognised(payload: bytes, name: str) -> None:
    assert decode(Power, payload, name) == Power(on=True)


@pytest.mark.parametrize("name", ["application/json", "application/msgpack", ""])
def test_an_empty_payload_has_no_fields(name: str) -> None:
    assert decode(Reset, b"", name) == Reset()


@pytest.mark.parametrize(
    ("name", "encoding"),
    [
        ("application/json", Encoding.JSON),
        ("application/msgpack", Encoding.MSGPACK),
        ("application/msgpack;power_request", Encoding.MSGPACK),
        ("zenoh/bytes", Encoding.JSON),
        ("", Encoding.JSON),
    ],
)
def test_a_reply_is_encoded_as_its_query(name: str, encoding: Encoding) -> None:
    assert reply_encoding(name) is encoding


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        ({"velocity": 1}, ["position", "missing", "fields are: position, direction"]),
        ({"position": 1, "velocty": 1}, ["velocty", "no such field", "fields are: position, direction"]),
        ({"position": "12"}, ["position", "valid number", "'12'"]),
        ({"position": True}, ["position", "valid number", "True"]),
        ({"position": None}, ["position", "valid number", "None"]),
        ({"position": 1, "velocity": -2}, ["velocity", "greater than 0", "-2"]),
        ([1], ["the payload", "object"]),
    ],
)
@pytest.mark.parametrize("encoding", list(Encoding))
def test_a_wrong_field_is_named_with_what_is_allowed(payload: object, words: list[str], encoding: Encoding) -> None:
    raw = json.dumps(payload).encode() if encoding is Encoding.JSON else msgpack.packb(payload)

    with pytest.raises(MalformedRequest) as caught:
        decode(MoveAbsolute, raw, encoding.value)

    for word in words:
        assert word in caught.value.message
    assert "\n" not in caught.value.message


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("encoding", list(Encoding))
def test_no_position_is_infinite_or_no_number(value: float, encoding: Encoding) -> None:
    raw = {Encoding.JSON: json.dumps, Encoding.MSGPACK: msgpack.packb}[encoding]({"position": value})

    with pytest.raises(MalformedRequest, match=r"position: .*finite") as caught:
        decode(MoveAbsolute, raw.encode() if isinstance(raw, str) else raw, encoding.value)

    assert error_reply(caught.value).code is ErrorCode.MALFORMED_REQUEST


def test_a_limit_that_was_broken_is_told_by_itself() -> None:
    with pytest.raises(MalformedRequest) as caught:
        decode(Home, b'{"timeout_s": 4000}', "application/json")

    assert (caught.value.value, caught.value.limit) == (4000, 3600)


def test_broken_json_is_no_msgpack() -> None:
    with pytest.raises(MalformedRequest, match="not valid JSON"):
        decode(Power, b'{"on":', "application/json")


def test_the_longest_payload_is_taken_and_one_byte_more_is_not() -> None:
    longest = b'{"on":true}'.ljust(MAX_PAYLOAD_BYTES)

    assert decode(Power, longest, "application/json").on
    with pytest.raises(PayloadTooLarge) as caught:
        decode(Power, longest + b" ", "application/json")
    assert caught.value.limit == MAX_PAYLOAD_BYTES


def test_an_answer_may_be_longer_than_any_request() -> None:
    """The plan of two full lines is."""
    answer = b'{"rig":"sim","holds":true,"buses":[]}'

    assert decode_received(RigBudget, answer.ljust(MAX_RECEIVED_BYTES), "application/json").holds
    with pytest.raises(PayloadTooLarge):
        decode_received(RigBudget, answer.ljust(MAX_RECEIVED_BYTES + 1), "application/json")


@given(
    st.sampled_from(list(AXIS_COMMANDS.values())),
    st.binary(max_size=200) | anything.map(msgpack.packb) | anything.map(lambda value: json.dumps(value).encode()),
    st.sampled_from(["application/json", "application/msgpack", "zenoh/bytes"]),
)
def test_any_bytes_are_a_request_or_a_refusal_that_can_be_sent(model: type, payload: bytes, name: str) -> None:
    try:
        decoded = decode(model, payload, name)
    except MalformedRequest as error:
        reply = error_reply(error)
        assert decode(ErrorReply, *encode(reply, Encoding.JSON)) == reply
    else:
        assert isinstance(decoded, model)


@pytest.mark.parametrize(
    ("payload", "name"),
    [
        (b"[" * 16000, "application/json"),
        (b'{"position":' + b"[" * 16000, "application/json"),
        (b'{"position":' + b"9" * 16000 + b"}", "application/json"),
        (b'{"position":' + b"9" * 400 + b"}", "application/json"),
        (b'{"position":1e999}', "application/json"),
        (b'{"position":"' + b"x" * 16000 + b'"}', "application/json"),
        (b'{"' + b"x" * 16000 + b'":1}', "application/json"),
        (b"\x91" * 16000, "application/msgpack"),
        (b"\x91" * 300 + b"\xc0", "application/msgpack"),
        (b"\xdf\xff\xff\xff\xff", "application/msgpack"),
        (msgpack.packb({1: 2}), "application/msgpack"),
        (msgpack.packb({"position": b"\xff"}), "application/msgpack"),
        (msgpack.packb({"position": msgpack.Timestamp(1)}), "application/msgpack"),
        (b"\x81\xa8position\xa2\xff\xfe", "application/msgpack"),
        (b"\xff\xfe{}", "application/json"),
    ],
)
def test_hostile_payloads_are_refused_in_a_short_sentence(payload: bytes, name: str) -> None:
    with pytest.raises(MalformedRequest) as caught:
        decode(MoveAbsolute, payload, name)

    assert len(encode(error_reply(caught.value), Encoding.JSON)[0]) < 1000


def every_error() -> list[type[LdcndError]]:
    found, todo = [], [LdcndError]
    while todo:
        kind = todo.pop()
        todo.extend(kind.__subclasses__())
        found.append(kind)
    return found


@pytest.mark.parametrize("code", list(ErrorCode))
def test_each_code_is_rebuilt_as_an_error_of_that_code(code: ErrorCode) -> None:
    reply = ErrorReply(code=code, message="m", retryable=False, axis="x", value=1.5, limit="l", nearest=1.0, remedy="r")

    error = rebuild_error(reply)

    assert error.code is code
    assert (str(error), error.axis, error.value, error.limit, error.nearest, error.remedy) == (
        "m", "x", 1.5, "l", 1.0, "r",
    )  # fmt: skip


@pytest.mark.parametrize("kind", every_error(), ids=lambda kind: kind.__name__)
def test_each_error_survives_the_network_but_for_its_exact_class(kind: type[LdcndError]) -> None:
    error = kind("what happened", axis="x", value="v", limit=2, nearest=3, remedy="do this")

    payload, name = encode(error_reply(error), Encoding.JSON)
    rebuilt = rebuild_error(decode(ErrorReply, payload, name))

    assert (rebuilt.code, rebuilt.retryable, vars(rebuilt)) == (error.code, error.retryable, vars(error))


@pytest.mark.parametrize("value", [math.nan, math.inf, 10**400])
def test_an_error_about_a_value_that_json_cannot_carry_can_be_sent(value: float) -> None:
    reply = error_reply(PositionLimit("x: too far", value=value, nearest=math.inf))

    assert isinstance(reply.value, str)
    assert reply.nearest is None


@pytest.mark.parametrize("encoding", list(Encoding))
def test_a_client_ignores_the_fields_of_a_newer_daemon_and_a_daemon_refuses_them(encoding: Encoding) -> None:
    newer = STATE.model_dump(mode="json") | {"mood": "sunny"}
    payload = json.dumps(newer).encode() if encoding is Encoding.JSON else msgpack.packb(newer)

    assert decode_received(StateSample, payload, encoding.value) == STATE
    with pytest.raises(MalformedRequest, match="mood"):
        decode(StateSample, payload, encoding.value)


def test_a_client_ignores_new_fields_at_any_depth() -> None:
    newer = STATE.model_dump(mode="json") | {
        "command": {"command_id": "a-1", "verb": "home", "since": 5, "progress": 0.5}
    }

    decoded = decode_received(StateSample, json.dumps(newer).encode(), "application/json")

    assert decoded.command is not None
    assert decoded.command.verb == "home"


def test_a_client_still_misses_a_field_that_every_daemon_sends() -> None:
    older = {name: value for name, value in STATE.model_dump(mode="json").items() if name != "moving"}

    with pytest.raises(MalformedRequest, match="moving: this field is missing"):
        decode_received(StateSample, json.dumps(older).encode(), "application/json")


def test_an_error_code_that_is_news_to_the_client_is_passed_on_in_words() -> None:
    payload = b'{"code": "too_sunny", "message": "the sun shines", "retryable": true, "axis": "x", "albedo": 0.3}'

    error = decode_error(payload, "application/json")

    assert type(error) is LdcndError
    assert (error.axis, "the sun shines" in error.message, "too_sunny" in error.message) == ("x", True, True)


def test_an_error_code_that_the_client_knows_is_its_class() -> None:
    error = decode_error(*encode(error_reply(PositionLimit("x: too far", axis="x")), Encoding.JSON))

    assert (type(error), error.message) == (PositionLimit, "x: too far")


class _NotBuiltYet(Frozen):
    """A model that nobody has used before."""

    name: str
    count: int = 3


@given(moves)
def test_json_is_that_of_pydantic(move):
    for without in (False, True):
        assert to_json(move, exclude_defaults=without) == move.model_dump_json(exclude_defaults=without).encode()


def test_json_of_a_model_that_was_never_validated_is_that_of_pydantic():
    made = _NotBuiltYet.model_construct(name="x", count=3)

    assert to_json(made, exclude_defaults=True) == b'{"name":"x"}'


OFF = {
    "a character that is none": b'{"on":false,"client":"\\ud800"}',
    "a number of 5000 digits": b'{"on":false,"sequence":' + b"9" * 5000 + b"}",
    "2000 lists": b'{"on":false,"x":' + b"[" * 2000 + b"]" * 2000 + b"}",
    "no UTF-8": b'{"on":false,"client":"\xff"}',
    "a byte order mark": b'\xef\xbb\xbf{"on": false}',
    "what follows": b'{"on": 0} and more',
    "cut short": b'{"client": "ann", "on": false',
    "msgpack": b"\x81\xa2on\xc2",
    "msgpack with a key that is a number": b"\x82\xa2on\xc2\x01\x02",
    "msgpack and one byte": b"\x81\xa2on\xc2\xc0",
    "msgpack with a time": b"\x82\xa2on\xc2\xa1x\xd6\xff\x00\x00\x00\x00",
    "a word": b'{"on": "OFF"}',
}
NOT_OFF = (
    b'{"on": true, "x": 1}', b'{"on": 0.5}', b'{"on": 01}', b'{"on": null}', b"{}", b'{"on": false, "on": true}',
    b'{"client": "\\"on\\": false"}', b"\x81\xa2on\xc3", b"\x81\xa2on\x01", b"", b'{"on": falsehood}',
)  # fmt: skip


@pytest.mark.parametrize("payload", OFF.values(), ids=OFF)
@pytest.mark.parametrize("encoding", ["application/json", "application/msgpack", ""])
def test_what_says_off_is_understood_whatever_else_is_wrong(payload: bytes, encoding: str) -> None:
    command, _complaint = understand(Power, payload, encoding)

    assert command.on is False


@pytest.mark.parametrize("payload", NOT_OFF)
@pytest.mark.parametrize("encoding", ["application/json", "application/msgpack", ""])
def test_what_does_not_say_off_switches_nothing_off(payload: bytes, encoding: str) -> None:
    try:
        command, _complaint = understand(Power, payload, encoding)
    except MalformedRequest:
        return
    assert command.on is True
