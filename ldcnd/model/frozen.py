"""The base of everything that crosses the network or comes from a file: frozen, strict about names, finite."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ldcnd.model.docstrings import attribute_docstrings

FieldsT = ParamSpec("FieldsT")
ModelT = TypeVar("ModelT", bound="Frozen")


class Frozen(BaseModel):
    """An immutable model that refuses unknown fields, NaN and infinity.

    What validates and encodes a model is built when it is needed first: a program seldom needs more than a few of them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the model's JSON Schema, in which its fields are described by the strings below them."""
        schema = handler.resolve_ref_schema(handler(core_schema))
        said = attribute_docstrings(cls)
        for name, described in schema.get("properties", {}).items():
            if name in said:
                described["description"] = said[name]
        return schema


def unchecked(model: Callable[FieldsT, ModelT]) -> Callable[FieldsT, ModelT]:
    """Return what makes a model as its constructor does, without looking at the values.

    For what is made so often that it shows, of values that are what the fields say. Every field has to be given, by
    name, also one that has a default.
    """
    kind, put = cast("type[ModelT]", model), object.__setattr__
    given = set(kind.model_fields)

    def make(*_: FieldsT.args, **fields: FieldsT.kwargs) -> ModelT:
        made = kind.__new__(kind)
        put(made, "__dict__", fields)
        put(made, "__pydantic_fields_set__", given)
        put(made, "__pydantic_extra__", None)
        put(made, "__pydantic_private__", None)
        return made

    return make


def build_models(model: type[Frozen] = Frozen) -> None:
    """Build all models that are known by now, so that whoever is to answer in time does not wait for it then."""
    for known in model.__subclasses__():
        known.model_rebuild()
        build_models(known)
