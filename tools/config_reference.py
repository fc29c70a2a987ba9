"""The configuration file as a page for people, written from the models that read it."""

import types
from collections.abc import Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from ldcnd.config.rig import RigConfig
from ldcnd.contract.frozen import attribute_docstrings
from ldcnd.drives.toml import Variants

PLAIN = {str: "string", int: "integer", float: "number", bool: "true or false", Path: "path"}
PREFACE = """# Configuration

A rig is one TOML file. `ldcnd check-config FILE` validates it whole, without opening anything, and names file, key,
what is wrong and what is allowed; `ldcnd run` does the same before it opens a port. Defaults are those of the models;
keys that are not listed here are refused.
"""


def config_reference() -> str:
    """Return the page, in Markdown."""
    return PREFACE + "".join(_sections(RigConfig, "", {RigConfig}))


def _sections(
    model: type[BaseModel], path: str, seen: set[type[BaseModel]], family: str = "", common: type[BaseModel] = BaseModel
) -> Iterator[str]:
    """Describe a table and the tables within it, each model once; of a family only what `common` has not alike."""
    fields = {name: field for name, field in model.model_fields.items() if not _alike(field, common, name)}
    said = attribute_docstrings(model)
    if common is not BaseModel:
        said = attribute_docstrings(common) | said
    title = f"{f'`[{path}]`' if path else 'Top level'}{f', family `{family}`' if family else ''}"
    what = (model.__doc__ or "").strip().splitlines()[0]
    rows = "".join(_row(name, field, said.get(name, "")) for name, field in fields.items())
    if rows:
        yield f"\n## {title}\n\n{what}\n\n| key | type | default | meaning |\n|---|---|---|---|\n{rows}"
    for name, field in fields.items():
        inner, many = _table(field.annotation)
        if inner is None or inner in seen:
            continue
        seen.add(inner)
        below = f"{path.strip('[]')}.{name}".lstrip(".")
        place = f"[{below}]" if many else below
        known = common.model_fields.get(name)
        base = _table(known.annotation)[0] if known else None
        yield from _sections(inner, place, seen, family if base else "", base or BaseModel)
        for variant, special in _variants(field):
            yield from _sections(special, place, seen, variant, inner)


def _alike(field: FieldInfo, common: type[BaseModel], name: str) -> bool:
    known = common.model_fields.get(name)
    if known is None:
        return False
    return (known.annotation, known.default, known.metadata) == (field.annotation, field.default, field.metadata)


def _variants(field: FieldInfo) -> list[tuple[str, type[BaseModel]]]:
    return [each for found in _marks(field.annotation) for each in found.models().items()]


def _marks(annotation: Any) -> list[Variants]:  # noqa: ANN401 - an annotation can be anything
    if isinstance(annotation, Variants):
        return [annotation]
    inner = (*get_args(annotation), *getattr(annotation, "__metadata__", ()))
    return list(dict.fromkeys(found for each in inner for found in _marks(each)))


def _row(name: str, field: FieldInfo, said: str) -> str:
    default = "required" if field.is_required() else _value(field.get_default(call_default_factory=True))
    meaning = " ".join(said.split())
    bounds = ", ".join(text for constraint in field.metadata if (text := _bound(constraint)))
    return f"| `{name}` | {_type(field.annotation)}{f', {bounds}' if bounds else ''} | {default} | {meaning} |\n"


def _bound(constraint: object) -> str:
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    return " ".join(
        f"{signs[name]} {value:g}" for name in signs if (value := getattr(constraint, name, None)) is not None
    )


def _value(value: Any) -> str:  # noqa: ANN401 - a default can be anything
    if value is PydanticUndefined or value is None:
        return "none"
    if isinstance(value, BaseModel):
        return "see below"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, StrEnum | str):
        return f'`"{value}"`'
    if isinstance(value, tuple):
        return f"`[{', '.join(_value(item).strip('`') for item in value)}]`"
    return f"`{value}`"


def _type(annotation: Any) -> str:  # noqa: ANN401 - an annotation can be anything
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        marks = [each for mark in arguments[1:] for each in getattr(mark, "metadata", (mark,))]
        ends = [end for name in ("ge", "le") for mark in marks if (end := getattr(mark, name, None)) is not None]
        return f"{_type(arguments[0])} {ends[0]:g} to {ends[1]:g}" if len(ends) == 2 else _type(arguments[0])  # noqa: PLR2004
    if origin in (Union, types.UnionType):
        return " or ".join(_type(part) for part in arguments if part is not type(None))
    if origin is Literal:
        return " or ".join(f'`"{choice}"`' for choice in arguments)
    if origin is tuple:
        rest = [each for each in arguments if each is not Ellipsis]
        count = f"{len(rest)} " if Ellipsis not in arguments else ""
        kinds = list(dict.fromkeys(map(_plural, rest)))
        return f"array of {count}{' and '.join(kinds)}"
    if origin is Mapping:
        return f"table of {_plural(arguments[1])}, by {_key(arguments[0])}"
    if isinstance(annotation, type) and issubclass(annotation, StrEnum):
        return " or ".join(f'`"{choice}"`' for choice in annotation)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table"
    return PLAIN[annotation]


def _plural(annotation: Any) -> str:  # noqa: ANN401 - an annotation can be anything
    """Return what several of a kind are called."""
    kind, _, rest = _type(annotation).partition(" ")
    return f"{kind}s {rest}".rstrip() if kind in {"array", "table", *PLAIN.values()} else f"{kind} {rest}".rstrip()


def _key(annotation: Any) -> str:  # noqa: ANN401 - an annotation can be anything
    """Return what the keys of a table are: the title of their kind, or the names themselves."""
    titles = (each.title for each in getattr(annotation, "__metadata__", ()) if isinstance(each, FieldInfo))
    return next((title for title in titles if title), None) or _type(annotation)


def _table(annotation: Any) -> tuple[type[BaseModel] | None, bool]:  # noqa: ANN401 - an annotation can be anything
    """Return the model of a table, and whether there may be many of them."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False
    for part in get_args(annotation):
        inner, _ = _table(part)
        if inner:
            return inner, get_origin(annotation) is tuple
    return None, False
