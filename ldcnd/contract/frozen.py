"""The base of everything that crosses the network or comes from a file: frozen, strict about names, finite."""

import ast
import inspect
import json
import re
import sys
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict
from pydantic_core import PydanticKnownError, core_schema

from ldcnd.contract.number_text import is_number

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import CoreSchema

LARGEST_INTEGER = 2**53 - 1
"""The largest integer that every reader of JSON keeps exactly."""
DIALECT = "https://json-schema.org/draft/2020-12/schema"


class Frozen(BaseModel):
    """An immutable model that refuses unknown fields, NaN, infinity, and for a number what is none.

    Texts and truths are no numbers, in Python and in TOML as in JSON: `position="1_000"` is refused. What validates and
    encodes a model is built when it is needed first: a program seldom needs more than a few of them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: type[BaseModel], handler: "GetCoreSchemaHandler") -> "CoreSchema":
        """Return what validates the model, with the rule for numbers in each of its fields."""
        schema: CoreSchema = _with_numbers(handler(source), cls)
        return schema

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: "CoreSchema", handler: "GetJsonSchemaHandler"
    ) -> "JsonSchemaValue":
        """Return the model's JSON Schema, in which its fields are described by the strings below them."""
        schema = handler.resolve_ref_schema(handler(core_schema))
        said = attribute_docstrings(cls)
        for name, described in schema.get("properties", {}).items():
            if name in said:
                described["description"] = said[name]
        return schema


_NOT_FOR_VALUES = frozenset({"default", "metadata", "serialization", "keys_schema", "config"})
"""Parts of a core schema that validate no values; JSON has texts for the keys of a table."""


def _with_numbers(schema: Any, model: type[BaseModel]) -> Any:  # noqa: ANN401 - a core schema is a tree of dicts
    """Return the core schema of a model with the rule for numbers wherever an int or a float is validated.

    JSON is validated without a call of Python, strictly. A model inside has the rule from its own class.
    """
    match schema:
        case {"type": "model", "cls": other} if other is not model:
            return schema
        case {"type": "int" | "float"}:
            given = core_schema.no_info_before_validator_function(
                _whole if schema["type"] == "int" else _real, {**schema, "strict": False}
            )
            return core_schema.json_or_python_schema({**schema, "strict": True}, given)
        case {"type": "model-fields", "fields": fields}:  # by their names, which mean nothing here
            return {**schema, "fields": {name: _with_numbers(each, model) for name, each in fields.items()}}
        case dict():
            return {key: each if key in _NOT_FOR_VALUES else _with_numbers(each, model) for key, each in schema.items()}
        case list() | tuple():
            return type(schema)(_with_numbers(each, model) for each in schema)
    return schema


def _real(value: object) -> float:
    try:
        if is_number(value):
            return float(value)
    except (OverflowError, ValueError):  # beyond binary64; a signalling NaN
        raise PydanticKnownError("finite_number") from None
    raise PydanticKnownError("float_type")


def _whole(value: object) -> int:
    try:
        # every number converts, also those of NumPy, whose types do not say so
        if is_number(value) and value == (whole := int(value)):  # type: ignore[arg-type]
            return whole
    except (OverflowError, ValueError):  # infinity, NaN
        raise PydanticKnownError("finite_number") from None
    raise PydanticKnownError("int_from_float" if is_number(value) else "int_type")


def build_models(model: type[Frozen] = Frozen) -> None:
    """Build all models that are known by now, so that no answer waits for it later."""
    for known in model.__subclasses__():
        known.model_rebuild()
        build_models(known)


def own_fields_first(model: type[BaseModel]) -> list[str]:
    """Return the names of the fields of a model: those that it adds itself, then those of its bases, nearest first."""
    inherits = [each.model_fields for each in model.__mro__ if issubclass(each, BaseModel)]
    return sorted(model.model_fields, key=lambda name: max(up for up, fields in enumerate(inherits) if name in fields))


def attribute_docstrings(model: type[BaseModel]) -> dict[str, str]:
    """Return what is said of the fields of a model, those of its bases included, by name."""
    said: dict[str, str] = {}
    for base in reversed(model.__mro__):
        said |= _classes(base.__module__).get(base.__name__, {})
    return {name: said[name] for name in model.model_fields if name in said}


@cache
def _classes(module: str) -> Mapping[str, Mapping[str, str]]:
    """Return what the classes of a module say of their attributes; nothing for a module without source."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (KeyError, OSError, TypeError):
        return {}
    return {node.name: dict(_attributes(node)) for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def _attributes(node: ast.ClassDef) -> list[tuple[str, str]]:
    said = []
    for statement, following in pairwise(node.body):
        match statement, following:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                said.append((name, inspect.cleandoc(text)))
    return said


@cache
def schema_name(model: type[Frozen]) -> str:
    """Return the name of a model's schema as it appears in keys and file names: its title in snake_case."""
    generate = model.model_config.get("model_title_generator")
    title = model.model_config.get("title") or (generate(model) if generate else model.__name__)
    return re.sub(r"(?<!^)(?=[A-Z])", "_", title).lower()


def schema_text(model: type[Frozen]) -> str:
    """Return the model's JSON Schema as stable text with a final newline."""
    schema = {"$schema": DIALECT, **model.model_json_schema(mode="serialization")}
    return json.dumps(schema, indent=2, sort_keys=True) + "\n"
