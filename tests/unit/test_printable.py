"""What strangers write cannot reach a terminal as control or formatting characters."""

import json
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.contract.codec import Encoding, decode, decode_received, encode
from ldcnd.contract.commands import Halt
from ldcnd.contract.errors import LdcndError, MalformedRequest, UnknownAxis
from ldcnd.contract.events import CommandEvent, CommandStatus
from ldcnd.contract.leases import Acquire
from ldcnd.printable import is_printable, printable

ATTACKS = (
    "\x1b]52;c;cm0gLXJmIC8=\x07",
    "x\nforged: line",
    "\x9b31m",
    "\x7f",
    "ann\u202egpj.exe",
    "\u2066hidden\u2069",
    "zero\u200bwidth",
    "\ufeff",
)
HARMLESS = ("ann", "bench 3, Jürgen", "測試", "µm/s²", "Ω", "")

event = CommandEvent(
    t=1, seq=0, run="r", number=0, axis="x", command_id="c", verb="halt", client="ann", status=CommandStatus.DONE
)


@given(st.text())
def test_no_control_or_formatting_character_is_left(text: str):
    shown = printable(text)

    assert is_printable(shown)
    assert not [character for character in shown if unicodedata.category(character) == "Cc"]
    assert printable(shown) == shown


@pytest.mark.parametrize("text", HARMLESS)
def test_what_is_harmless_stays_as_it_is(text: str):
    assert printable(text) == text


@pytest.mark.parametrize("escaped", [True, False])
@pytest.mark.sweep(2)
def test_each_such_character_is_found_in_a_request_however_it_is_spelled(*, escaped: bool):
    unfit = [chr(code) for code in range(0x110000) if not is_printable(chr(code))]

    taken = [
        hex(ord(character))
        for character in unfit
        if escaped or unicodedata.category(character) != "Cs"  # no UTF-8 has a lone surrogate
        if is_taken(json.dumps({"client": f"a{character}b"}, ensure_ascii=escaped))
    ]

    assert len(unfit) > 200
    assert taken == []


def is_taken(text: str) -> bool:
    try:
        decode(Halt, text.encode(), Encoding.JSON)
    except MalformedRequest:
        return False
    return True


@pytest.mark.parametrize("text", ATTACKS)
@pytest.mark.parametrize("encoding", Encoding)
@pytest.mark.parametrize("request_", [Halt(client="?"), Halt(command_id="?"), Halt(lease="?"), Acquire(client="?")])
def test_a_request_with_such_a_text_is_refused(text: str, encoding: Encoding, request_: Halt | Acquire):
    field = next(name for name, value in request_ if value == "?")
    payload, name = encode(request_.model_copy(update={field: text}), encoding)

    with pytest.raises(MalformedRequest, match=field) as refused:
        decode(type(request_), payload, name)

    assert is_printable(refused.value.message)


@pytest.mark.parametrize("text", ATTACKS)
def test_a_name_that_is_one_of_several_is_looked_at_too(text: str):
    payload, name = encode(Acquire(client="ann", axes=("x", text)), Encoding.JSON)

    with pytest.raises(MalformedRequest, match="axes"):
        decode(Acquire, payload, name)


@pytest.mark.parametrize("text", ATTACKS)
@pytest.mark.parametrize("encoding", Encoding)
def test_what_a_daemon_says_has_escapes_when_a_client_reads_it(text: str, encoding: Encoding):
    payload, name = encode(event.model_copy(update={"client": text, "reason": text}), encoding)

    read = decode_received(CommandEvent, payload, name)

    assert read.client == read.reason == printable(text, keep="\n")
    assert is_printable((read.client or "").replace("\n", ""))


@pytest.mark.parametrize("text", HARMLESS)
def test_what_a_daemon_says_is_read_as_it_is_otherwise(text: str):
    said = event.model_copy(update={"client": text})

    assert decode_received(CommandEvent, *encode(said, Encoding.JSON)) == said


@pytest.mark.parametrize("text", ATTACKS)
def test_an_error_shows_escapes_of_what_it_repeats(text: str):
    error = UnknownAxis(f"there is no axis {text}", axis=text, value=text, limit=text, remedy=f"leave out {text}")

    said = (error.message, str(error), error.axis, error.value, error.limit, error.remedy)
    assert [part for part in said if not is_printable(str(part).replace("\n", ""))] == []


def test_an_error_keeps_its_lines():
    assert str(LdcndError("one\ntwo")) == "one\ntwo"
