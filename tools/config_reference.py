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

PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean", Path: "path"}
PREFACE = """# Configuration

Which keys does a rig's file have? A rig is one TOML file. `ldcnd check-config FILE` validates it whole, without opening
anything, and names file, key, what is wrong and what is allowed; keys that are not listed here are refused. The default
of a key stands behind the semicolon.
"""
ELSEWHERE = {
    "sim.module.behaviour": "`schemas/rig_config.json` has its switches, `ModuleSettings`.",
    "sim.module.plant": "`schemas/rig_config.json` has its constants, `PlantConfig`.",
    "sim.unit": "[The simulated line](simulator.md#smartsteps) shows its keys.",
}
"""Tables that have a page of their own."""


def config_reference() -> str:
    """Return the page, in Markdown."""
    return PREFACE + "".join(_sections(RigConfig, "", "", {RigConfig}))


def _sections(
    model: type[BaseModel],
    path: str,
    role: str,
    seen: set[type[BaseModel]],
    family: str = "",
    common: type[BaseModel] = BaseModel,
) -> Iterator[str]:
    """Describe a table and the tables within it, each model once; of a family only what `common` has not alike."""
    fields = {name: field for name, field in model.model_fields.items() if not _alike(field, common, name)}
    said = attribute_docstrings(model)
    if common is not BaseModel:
        said = attribute_docstrings(common) | said
    # only a line has a key of that name: what simulates one takes the family of the line that uses it
    of_family = (f", family `{family}`" if "family" in said else f", for `{family}`") if family else ""
    title = f"{f'`[{path}]`' if path else 'Top level'}{of_family}"
    what = (model.__doc__ or "").strip().splitlines()[0]
    about = what if not role or what.startswith(role.rstrip(".")) else role
    below = {name: inner for name, field in fields.items() if (inner := _table(field.annotation)[0])}
    new = {name for name, inner in below.items() if inner not in seen}
    rows = "".join(_row(name, field, said.get(name, "")) for name, field in fields.items() if name not in new)
    if path.strip("[]") in ELSEWHERE:
        yield f"\n## {title}\n\n{about} {ELSEWHERE[path.strip('[]')]}\n"
        return
    if rows:
        yield f"\n## {title}\n\n{about}\n\n{rows}"
    for name, inner in below.items():
        if inner in seen:
            continue
        many = _table(fields[name].annotation)[1]
        seen.add(inner)
        inside = f"{path.strip('[]')}.{name}".lstrip(".")
        place = f"[{inside}]" if many else inside
        known = common.model_fields.get(name)
        base = _table(known.annotation)[0] if known else None
        yield from _sections(
            inner, place, _role(fields[name], said.get(name, "")), seen, family if base else "", base or BaseModel
        )
        for variant, special in _variants(fields[name]):
            yield from _sections(special, place, "", seen, variant, inner)


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


def _role(field: FieldInfo, said: str) -> str:
    """Return what the key of a table says that its own class does not: what holds without it, if it may be missing."""
    return " ".join(said.split()) if field.get_default(call_default_factory=True) is None else ""


def _row(name: str, field: FieldInfo, said: str) -> str:
    default = "required" if field.is_required() else _value(field.get_default(call_default_factory=True))
    meaning = " ".join(said.split())
    bounds = _bounds(field.metadata)
    value = f"{_type(field.annotation)}{f' {bounds}' if bounds else ''}{f'; {default}' if default else ''}"
    return f"* `{name}` ({value}): {meaning}\n"


def _bounds(metadata: list[Any]) -> str:
    found = {
        sign: f"{value:g}"
        for constraint in metadata
        for sign, name in ((">", "gt"), (">=", "ge"), ("<", "lt"), ("<=", "le"))
        if (value := getattr(constraint, name, None)) is not None
    }
    if set(found) == {">=", "<="}:
        return f"{found['>=']} to {found['<=']}"
    return ", ".join(f"{sign} {value}" for sign, value in found.items())


def _value(value: Any) -> str:  # noqa: ANN401 - a default can be anything
    if value is PydanticUndefined or value is None:
        return ""
    if isinstance(value, BaseModel):
        return "see above"
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
        return ", ".join(f'`"{choice}"`' for choice in arguments)
    if origin is tuple:
        rest = [each for each in arguments if each is not Ellipsis]
        count = f"{len(rest)} " if Ellipsis not in arguments else ""
        kinds = list(dict.fromkeys(map(_plural, rest)))
        return f"array of {count}{' and '.join(kinds)}"
    if origin is Mapping:
        return f"table of {_plural(arguments[1])}, by {_key(arguments[0])}"
    if isinstance(annotation, type) and issubclass(annotation, StrEnum):
        return ", ".join(f'`"{choice}"`' for choice in annotation)
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
