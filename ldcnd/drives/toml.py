"""TOML files: read, validated whole, refused with every complaint at once."""

import difflib
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import (
    BaseModel,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PlainSerializer,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WithJsonSchema,
    WrapValidator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.units import Ratio

DocumentT = TypeVar("DocumentT", bound=Frozen)


@dataclass(frozen=True, slots=True)
class Variants:
    """Marks a table that different models read; what they have in common is the annotated model.

    Attributes:
        choose: returns the model that reads a table; raises ValueError when there is none.
        models: returns all of them by name.
    """

    choose: Callable[[Mapping[str, Any]], type[BaseModel]]
    models: Callable[[], Mapping[str, type[BaseModel]]]

    def __get_pydantic_core_schema__(self, source: type[BaseModel], handler: GetCoreSchemaHandler) -> CoreSchema:
        """Read a table by its own model before it is taken for the common one."""

        def read(document: object) -> object:
            # an instance is there already; what is neither is refused by the common model, in its words
            return self.choose(document).model_validate(document) if isinstance(document, dict) else document

        return core_schema.no_info_before_validator_function(read, handler(source))

    def __get_pydantic_json_schema__(self, common: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Describe all of them; where there are none, what they would have in common."""
        models = self.models().values()
        return {"anyOf": [handler(model.__pydantic_core_schema__) for model in models]} if models else handler(common)


REMOVED_KEYS = {
    "idle": "`telemetry.on_demand` is gone; delete this key",
    "on_demand": "every item is polled at its rate whether it has subscribers or not; delete this key",
    "pre_empt_polls": "stops wait for the exchange on the wire; delete this key and, on a slow line, raise `baud`",
}
"""Keys of earlier versions, and what to do about them."""


def read_toml(
    path: Path, document_type: type[DocumentT], prepare: Callable[[dict[str, Any]], object] = lambda document: document
) -> DocumentT:
    """Read and validate a file; `prepare` gets what is in it, and returns what is validated.

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
    except (ValueError, RecursionError) as error:  # a number too long, and tables too deep, are no TOMLDecodeError
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    try:
        return document_type.model_validate(prepare(document))
    except ValidationError as error:
        raise ConfigError("\n".join(f"{path}: {line}" for line in complaints(error, document_type))) from error
    except (TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        # the gate of every file: a daemon that runs must outlive whatever stands in one that it is to read again
        raise ConfigError(f"{path}: a value is of another kind or size than its key takes: {error}") from error


def complaints(error: ValidationError, document_type: type[BaseModel], whole: str = "whole file") -> list[str]:
    """Say for each refused key what is wrong with it; `whole` is what is meant where no key is."""
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
        said.append(f"{key or whole}: {detail['msg'].removeprefix('Value error, ')}{given}")
    return said


def _unknown_key(document_type: type[BaseModel], loc: tuple[int | str, ...]) -> str:
    """Say that a key does not exist, and which one may have been meant."""
    name = str(loc[-1])
    if name in REMOVED_KEYS:
        return f"no longer supported: {REMOVED_KEYS[name]}"
    keys = _keys_at(document_type, loc[:-1])
    # in one of the models that may stand there, but not in the one that was chosen
    if name in keys:
        return "drives of another family have this key"
    close = difflib.get_close_matches(name, keys, n=1)
    return f"there is no such key{f'; did you mean {close[0]!r}?' if close else ''}"


def _keys_at(document_type: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the table at this place; empty where the place is not a single kind of table."""
    tables: list[type[BaseModel]] = [document_type]
    for part in loc:
        if not isinstance(part, int):
            fields = [table.model_fields[part] for table in tables if part in table.model_fields]
            tables = [table for field in fields for table in _tables_in(field.annotation)]
    return [key for table in tables for key in table.model_fields]


def _tables_in(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if isinstance(annotation, Variants):
        return list(annotation.models().values())
    inner = (*get_args(annotation), *getattr(annotation, "__metadata__", ()))
    return [table for each in inner for table in _tables_in(each)]


NAME_CHARACTERS = 63

Name = Annotated[str, Field(pattern=rf"^[a-z0-9][a-z0-9_]{{0,{NAME_CHARACTERS - 1}}}$")]
"""One chunk of a key: lower-case letters, digits, underscores."""

DeviceIdentity = tuple[Annotated[int, Field(ge=0, le=255)], Annotated[int, Field(ge=0, le=255)]]
"""Id and version, as a module reports them."""

LEAST_SCALE, MOST_SCALE = 1e-9, 1e12
"""Counts in a unit between which every count is a finite position."""


def _number_or_ratio(value: object, number: ValidatorFunctionWrapHandler) -> float:
    """Take a text with a stroke for a ratio; its number has the same bounds as one that is no text."""
    if isinstance(value, str) and "/" in value:
        value = Ratio(value)
    taken: float = number(value)
    return value if isinstance(value, Ratio) else taken


def _as_written(value: float) -> float | str:
    return value.written if isinstance(value, Ratio) else value


CountsPerUnit = Annotated[
    float,
    Field(ge=LEAST_SCALE, le=MOST_SCALE),
    WrapValidator(_number_or_ratio),
    PlainSerializer(_as_written),
    WithJsonSchema({"anyOf": [{"type": "number", "minimum": LEAST_SCALE, "maximum": MOST_SCALE}, {"type": "string"}]}),
]
"""A number, or a ratio as text such as "10000/360", which stays one where it is written again."""


def refuse_duplicates(what: str, names: list[str]) -> None:
    """Refuse a list in which something stands twice.

    Raises:
        ValueError: names what stands twice.
    """
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{what} {name!r} is given more than once")
