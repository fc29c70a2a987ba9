"""Payloads: models to bytes and back, JSON or msgpack, and errors as replies.

Both encodings mean the same: a msgpack payload is held to the rules of JSON, strictly: a number is not a string, true
is not 1. JSON is sent as exactly `application/json`, because stock tools compare the whole name; msgpack names the
schema.
"""

import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from functools import cache, lru_cache, partial
from typing import TypeVar

import msgpack
import pydantic
import pydantic_core

from ldcnd.contract.commands import Command, Effect, ErrorReply, ReceivedError, RemedyStep
from ldcnd.contract.errors import ERRORS, LdcndError, MalformedRequest, PayloadTooLarge, Remedy, RemedyCommand
from ldcnd.contract.frozen import Frozen, own_fields_first, schema_name
from ldcnd.contract.questions import Cause
from ldcnd.printable import is_printable, printable

MAX_PAYLOAD_BYTES = 16 * 1024
"""No request is longer: the largest has a quarter of this."""

MAX_RECEIVED_BYTES = 512 * 1024
"""No answer of a daemon is longer: the plan of a hundred axes has a tenth of it."""

ECHO_CHARACTERS = 80
"""Maximum length of a quoted value in an error, characters."""

_WHITE_SPACE = b" \t\r\n"

ModelT = TypeVar("ModelT", bound=Frozen)
CommandT = TypeVar("CommandT", bound=Command[Frozen])


class Encoding(StrEnum):
    """How a payload is encoded; the value is its name on the wire, without the schema."""

    JSON = "application/json"
    MSGPACK = "application/msgpack"


def to_json(model: Frozen, *, exclude_defaults: bool = False) -> bytes:
    """Return what `model_dump_json` makes, in bytes and in half of the time: a command waits for it twice."""
    return model.__pydantic_serializer__.to_json(model, exclude_defaults=exclude_defaults)


def encode(model: Frozen, encoding: Encoding) -> tuple[bytes, str]:
    """Return a model's payload and the name of its encoding on the wire."""
    if encoding is Encoding.JSON:
        return to_json(model), encoding.value
    return msgpack.packb(vars(model), default=_packable), _msgpack_name(type(model))


def packer(encoding: Encoding) -> Callable[[Mapping[str, object]], bytes]:
    """Return what encodes the fields of models one after another, for one thread, as `encode` does whole models."""
    if encoding is Encoding.JSON:
        return partial(pydantic_core.to_json, inf_nan_mode="null")  # as models are serialised
    return msgpack.Packer(default=_packable).pack


def encoding_name(model: type[Frozen], encoding: Encoding) -> str:
    """Return the name that the encoding of a model has on the wire."""
    return encoding.value if encoding is Encoding.JSON else _msgpack_name(model)


def decode(model: type[ModelT], payload: bytes, encoding: str) -> ModelT:
    """Return the model that a request stands for, strictly; an empty payload has no fields.

    Args:
        model: what it must be.
        payload: at most `MAX_PAYLOAD_BYTES`.
        encoding: its name on the wire; when it names neither JSON nor msgpack, the payload's first byte tells.

    Raises:
        PayloadTooLarge: the payload is too long.
        MalformedRequest: anything else; names the first field that is wrong and what is allowed there. No text may have
            control or formatting characters: it would reach terminals by way of events and logs.
    """
    text = as_json(payload, encoding, MAX_PAYLOAD_BYTES)
    try:
        request = model.model_validate_json(text, strict=True)
    except pydantic.ValidationError as error:
        raise explained(error, model) from None
    if _is_suspicious(text):
        _refuse_unprintable(request)
    return request


def understand(model: type[CommandT], payload: bytes, encoding: str) -> tuple[CommandT, LdcndError | None]:
    """Return the command that a request stands for, and what is wrong with the request all the same.

    As `decode`, but for what takes energy out. That is understood by its verb, and `power` off or a speed override of 0
    by a field that says so, whatever else the payload says: the complaint is for the answer, once the command was sent.

    Raises:
        PayloadTooLarge, MalformedRequest: as `decode`, of any other command.
    """
    try:
        return decode(model, payload, encoding), None
    except LdcndError as error:
        calms = model.calms
        fields = {calms[0]: calms[1]} if calms and _says_nothing(calms[0], payload) else {}
        if not (fields or model.effect is Effect.REST):
            raise
        return model.model_validate(fields), error


def _says_nothing(field: str, payload: bytes) -> bool:
    """Tell whether a payload says of a field that it is false or 0, whatever is wrong with the rest of it.

    Nothing is decoded: no damage elsewhere, no other encoding than the one that is declared hides the field.
    """
    said = [match.lastgroup == "nothing" for match in _field(field).finditer(payload)]
    return bool(said) and all(said)


@cache
def _field(name: str) -> re.Pattern[bytes]:
    """Return what finds a field of a request, as JSON or msgpack: `nothing` where people write false or 0 there."""
    key = re.escape(name.encode())
    length = re.escape(bytes([len(name)]))
    packed = b"(?: %s | \\xc4%s | \\xd9%s ) %s" % (re.escape(bytes([0xA0 | len(name)])), length, length, key)
    false = rb"(?: false | 0 (?:\.0+)? | \"(?: 0|f|n|no|off|false )\" )"
    zero = rb"(?: \xc2 | \x00 | \xca\x00{4} | \xcb\x00{8} | \xa1[0fn] | \xa2no | \xa3off | \xa5false )"
    return re.compile(
        rb"(?: \"%s\" \s* : \s* (?= %s \s* (?: [,}] | \Z ) ) | %s (?= %s ) ) (?P<nothing>) | (?: \"%s\" \s* : | %s )"
        % (key, false, packed, zero, key, packed),
        re.VERBOSE | re.IGNORECASE,
    )


def decode_received(model: type[ModelT], payload: bytes, encoding: str) -> ModelT:
    """Return the model that a daemon's answer or sample stands for, without the fields that only a newer daemon has.

    For clients: within one version of the interface fields are only ever added, so what is unknown may be ignored.
    Control and formatting characters in texts become escapes: what the daemon says may end on a terminal.

    Args:
        model: what it must be.
        payload: at most `MAX_RECEIVED_BYTES`.
        encoding: as for `decode`.

    Raises:
        PayloadTooLarge: the payload is too long.
        MalformedRequest: a known field is missing or wrong.
    """
    text = as_json(payload, encoding, MAX_RECEIVED_BYTES)
    try:
        if _is_suspicious(text):
            text = _with_escapes(text)
        return model.model_validate_json(text, strict=True, extra="ignore")
    except pydantic.ValidationError as error:
        raise explained(error, model) from None


def read_received(payload: bytes, encoding: str) -> tuple[object, bytes]:
    """Return what a daemon sent, as it is and as JSON with escapes as `decode_received` makes them; no model is built.

    Raises:
        PayloadTooLarge: the payload is too long.
        MalformedRequest: it cannot be read.
    """
    if (_named(encoding) or _detected(payload)) is Encoding.MSGPACK and 0 < len(payload) <= MAX_RECEIVED_BYTES:
        value, text = _from_msgpack(payload)
    else:
        text = as_json(payload, encoding)
        try:
            value = pydantic_core.from_json(text)
        except ValueError as error:
            raise MalformedRequest(f"the payload is not valid JSON: {_short(str(error))}") from None
    return value, _with_escapes(text) if _is_suspicious(text) else text


def decode_error(payload: bytes, encoding: str) -> LdcndError:
    """Return the error that a daemon answers with.

    Raises:
        MalformedRequest: the payload is no error.
    """
    return rebuild_error(decode_received(ReceivedError, payload, encoding))


def reply_encoding(encoding: str) -> Encoding:
    """Return how to answer a query of that encoding: alike, and in JSON when it does not say."""
    return _named(encoding) or Encoding.JSON


def error_reply(error: LdcndError) -> ErrorReply:
    """Return the part of an error that may be sent over the network."""
    return ErrorReply(
        code=error.code,
        message=error.message,
        retryable=error.retryable,
        axis=error.axis,
        value=_finite(error.value),
        limit=_finite(error.limit),
        nearest=error.nearest if error.nearest is None or math.isfinite(error.nearest) else None,
        remedy=error.remedy,
        steps=remedy_steps(error),
        page=error.page,
    )


def remedy_steps(error: LdcndError) -> tuple[RemedyStep, ...]:
    """Return the commands that the remedy of an error names."""
    steps = error.remedy.steps if error.remedy is not None else ()
    return tuple(RemedyStep(verb=each.verb, said=each.said, arguments=dict(each.arguments)) for each in steps)


def remedy_of(reply: ReceivedError | Cause) -> Remedy | None:
    """Return the remedy that a reply tells of."""
    steps = tuple(RemedyCommand(each.verb, each.said, each.arguments) for each in reply.steps)
    return None if reply.remedy is None else Remedy.of(reply.remedy, steps)


def rebuild_error(reply: ReceivedError) -> LdcndError:
    """Return the error that a reply tells of, of the class that has its code; the root when no class has it."""
    known = ERRORS.get(reply.code)
    return (known or LdcndError)(
        reply.message if known else f"{reply.message} ({reply.code}, an error code newer than this client)",
        axis=reply.axis,
        value=reply.value,
        limit=reply.limit,
        nearest=reply.nearest,
        remedy=remedy_of(reply),
    )


def _refuse_unprintable(request: Frozen) -> None:
    for field, text in _texts(request):
        if not is_printable(text):
            raise MalformedRequest(
                f"{field}: control and formatting characters are not accepted, not {_short(repr(text))}",
                value=_short(repr(text)),
                remedy="leave them out",
            )


_SUSPICIOUS = re.compile(
    # escapes of JSON that may stand for a character that is not printable, and such characters themselves
    rb"\\u|\\[bfnrt]|[\x7f]|\xc2[\x80-\x9f\xad]|\xd8\x9c|\xe1\xa0\x8e|\xe2\x80|\xe2\x81|\xef\xbb|\xef\xbf|\xf3\xa0"
)


_BACKSLASH, _DELETE = b"\\\x7f"


def _is_suspicious(text: bytes) -> bool:
    """Tell whether JSON may have texts with unprintable characters."""
    if text.isascii() and _BACKSLASH not in text and _DELETE not in text:
        return False  # nearly every one, in a tenth of the time of the search
    return _SUSPICIOUS.search(text) is not None


def _with_escapes(text: bytes) -> bytes:
    """Return JSON whose texts have no unprintable characters but line feeds."""
    try:
        return pydantic_core.to_json(_escaped(pydantic_core.from_json(text)))
    except ValueError:
        return text  # validation says what is wrong with it


def _escaped(value: object) -> object:
    match value:
        case str():
            return printable(value, keep="\n")
        case list():
            return [_escaped(item) for item in value]
        case dict():
            return {_escaped(key): _escaped(item) for key, item in value.items()}
        case _:
            return value


def _texts(value: object, field: str = "") -> Iterator[tuple[str, str]]:
    """Yield every text in a model, with the name of its field."""
    match value:
        case str():
            yield field, value
        case Frozen():
            for name, item in vars(value).items():
                yield from _texts(item, f"{field}.{name}" if field else name)
        case tuple() | list():
            for item in value:
                yield from _texts(item, field)
        case Mapping():
            for key, item in value.items():
                yield from _texts(key, field)
                yield from _texts(item, f"{field}.{key}")


@cache
def _msgpack_name(model: type[Frozen]) -> str:
    return f"{Encoding.MSGPACK.value};{schema_name(model)}"


def _packable(value: object) -> object:
    """Return the JSON form of a value that msgpack cannot pack; models' fields need no detour."""
    return vars(value) if isinstance(value, Frozen) else pydantic_core.to_jsonable_python(value)


def as_json(payload: bytes, encoding: str, longest: int = MAX_RECEIVED_BYTES) -> bytes:
    """Return a payload as JSON.

    Raises:
        PayloadTooLarge: it is longer than `longest` bytes.
        MalformedRequest: it cannot be read.
    """
    if len(payload) > longest:
        raise PayloadTooLarge(
            f"the payload has {len(payload)} bytes, more than the {longest} that it may have",
            value=len(payload),
            limit=longest,
        )
    if not payload:
        return b"{}"
    is_msgpack = (_named(encoding) or _detected(payload)) is Encoding.MSGPACK
    return _from_msgpack(payload)[1] if is_msgpack else payload


@lru_cache(maxsize=64)
def _named(encoding: str) -> Encoding | None:
    try:
        return Encoding(encoding.partition(";")[0].strip().lower())
    except ValueError:
        return None


def _detected(payload: bytes) -> Encoding:
    """Detect an encoding that is not named from the payload: clients often send bytes and say no more."""
    return Encoding.JSON if payload[:1] == b"{" or payload[:1] in _WHITE_SPACE else Encoding.MSGPACK


def _from_msgpack(payload: bytes) -> tuple[object, bytes]:
    """Return what msgpack says, as it is and as JSON."""
    try:
        value: object = msgpack.unpackb(payload)
        return value, pydantic_core.to_json(value)
    # what msgpack cannot read, and what JSON cannot say: both libraries raise kinds of ValueError
    except (ValueError, msgpack.UnpackException) as error:
        raise MalformedRequest(
            "the payload is neither a JSON object nor a msgpack map of text keys: " + _short(str(error)),
            remedy=f"send {Encoding.JSON.value} or {Encoding.MSGPACK.value}",
        ) from None


def valid(model: type[ModelT], **fields: object) -> ModelT:
    """Return a model of what a program has given.

    Raises:
        MalformedRequest: a value is none that the model takes; names the field.
    """
    try:
        return model.model_validate(fields)
    except pydantic.ValidationError as error:
        raise explained(error, model) from None


def explained(error: pydantic.ValidationError, model: type[Frozen] = Frozen) -> MalformedRequest:
    """Say in one sentence what is wrong with the first field that is."""
    first = error.errors(include_url=False)[0]
    field = ".".join(str(part) for part in first["loc"])
    fields = ", ".join(own_fields_first(model)) or "none"
    value = first["input"]
    context = first.get("ctx", {})
    match first["type"]:
        case "json_invalid":
            return MalformedRequest(f"the payload is not valid JSON: {_short(str(context.get('error', '')))}")
        case "extra_forbidden":
            return MalformedRequest(f"{_short(field)}: there is no such field; the fields are: {fields}")
        case "missing":
            return MalformedRequest(f"{field}: this field is missing; the fields are: {fields}")
    what = first["msg"][:1].lower() + first["msg"][1:]
    limits = (context[bound] for bound in ("ge", "gt", "le", "lt") if bound in context)
    return MalformedRequest(
        f"{_short(field) or 'the payload'}: {_short(what)}, not {_short(repr(value))}",
        value=_finite(value) if type(value) in {int, float, str} else _short(repr(value)),
        limit=next(limits, None),
    )


def _finite(value: float | str | None) -> float | str | None:
    """Return what JSON can carry of a value: no infinity, no NaN, nothing endless."""
    if isinstance(value, str):
        return _short(value)
    if value is None or abs(value) <= sys.float_info.max:
        return value
    return _short(str(value))


def _short(text: str) -> str:
    return text if len(text) <= ECHO_CHARACTERS else text[: ECHO_CHARACTERS - 3] + "..."
