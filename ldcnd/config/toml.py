"""TOML files: read, validated whole, refused with every complaint at once."""

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, TypeVar, get_args

from pydantic import BaseModel, Field, ValidationError

from ldcnd.errors import ConfigError
from ldcnd.model.frozen import Frozen

DocumentT = TypeVar("DocumentT", bound=Frozen)

REMOVED_KEYS = {
    "idle": "`telemetry.on_demand` is gone; delete this key",
    "on_demand": "every item is polled at its rate whether it has subscribers or not; delete this key",
    "pre_empt_polls": "stops wait for the exchange on the wire; delete this key and, on a slow line, raise `baud`",
}
"""Keys of earlier versions, and what to do about them."""


def read_toml(path: Path, document_type: type[DocumentT]) -> DocumentT:
    """Read and validate a file.

    Raises:
        ConfigError: the file cannot be read, is not TOML, or cannot work; names file, keys, what is wrong, what is
            allowed.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: not UTF-8 at byte {error.start}") from error
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    try:
        return document_type.model_validate(document)
    except ValidationError as error:
        raise ConfigError("\n".join(f"{path}: {line}" for line in complaints(error, document_type))) from error


def complaints(error: ValidationError, document_type: type[BaseModel]) -> list[str]:
    """Say for each refused key what is wrong with it."""
    said = []
    details = error.errors()
    for detail in details:
        if detail["type"] == "too_short" and any(
            len(other["loc"]) > len(detail["loc"]) and other["loc"][: len(detail["loc"])] == detail["loc"]
            for other in details
        ):
            continue  # a list is only short because its items were refused
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in detail["loc"]).lstrip(".")
        shown = detail["input"] if isinstance(detail["input"], str | int | float | bool) else None
        given = f" (given: {shown!r})" if shown is not None else ""
        if detail["type"] == "extra_forbidden":
            said.append(f"{key}: {_unknown_key(document_type, detail['loc'])}")
            continue
        said.append(f"{key or 'whole file'}: {detail['msg'].removeprefix('Value error, ')}{given}")
    return said


def _unknown_key(document_type: type[BaseModel], loc: tuple[int | str, ...]) -> str:
    """Say that a key does not exist, and which one may have been meant."""
    name = str(loc[-1])
    if name in REMOVED_KEYS:
        return f"no longer supported: {REMOVED_KEYS[name]}"
    close = difflib.get_close_matches(name, _keys_at(document_type, loc[:-1]), n=1)
    return f"there is no such key{f'; did you mean {close[0]!r}?' if close else ''}"


def _keys_at(document_type: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the table at this place; empty where the place is not a single kind of table."""
    table: object = document_type
    for part in loc:
        if isinstance(part, int):
            continue
        field = table.model_fields.get(part) if isinstance(table, type) and issubclass(table, BaseModel) else None
        table = _table_in(field.annotation) if field else None
    return list(table.model_fields) if isinstance(table, type) and issubclass(table, BaseModel) else []


def _table_in(annotation: object) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for each in get_args(annotation) if (found := _table_in(each))), None)


NAME_CHARACTERS = 63

Name = Annotated[str, Field(pattern=rf"^[a-z0-9][a-z0-9_]{{0,{NAME_CHARACTERS - 1}}}$")]
"""One chunk of a key: lower-case letters, digits, underscores."""

DeviceIdentity = tuple[Annotated[int, Field(ge=0, le=255)], Annotated[int, Field(ge=0, le=255)]]
"""Id and version, as an LDCN or NMC module reports them."""


def refuse_duplicates(what: str, names: list[str]) -> None:
    """Refuse a list in which something stands twice.

    Raises:
        ValueError: names what stands twice.
    """
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{what} {name!r} is given more than once")
