"""The base of everything that crosses the network or comes from a file: frozen, strict about names, finite."""

import ast
import inspect
import json
import re
import sys
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

if TYPE_CHECKING:
    from pydantic import GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import CoreSchema

LARGEST_INTEGER = 2**53 - 1
"""The largest integer that every reader of JSON keeps exactly."""
DIALECT = "https://json-schema.org/draft/2020-12/schema"


class Frozen(BaseModel):
    """An immutable model that refuses unknown fields, NaN and infinity.

    What validates and encodes a model is built when it is needed first: a program seldom needs more than a few of them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

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


def build_models(model: type[Frozen] = Frozen) -> None:
    """Build all models that are known by now, so that no answer waits for it later."""
    for known in model.__subclasses__():
        known.model_rebuild()
        build_models(known)


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
