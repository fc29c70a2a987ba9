"""Models are built when they are needed first, or all of them on demand; numbers in them are numbers."""

import importlib
import pkgutil
import types
from collections.abc import Iterator, Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
import pydantic
import pytest

import ldcnd
from ldcnd.contract.catalogue import PUBLIC_MODELS
from ldcnd.contract.commands import MoveAbsolute, SetGains
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen, build_models
from ldcnd.drives.toml import read_toml
from ldcnd.parts import EXTRAS

NO_NUMBERS = (
    "1_000",
    " 5 ",
    "5",
    "1,5",
    "1e3",
    "0x10",
    "",
    b"5",
    True,
    False,
    np.bool_(1),
    np.array(5.0),
    5j,
    [5],
)


def test_a_model_is_built_at_its_first_use():
    class Late(Frozen):
        value: int

    assert not Late.__pydantic_complete__
    assert Late(value=1).value == 1
    assert Late.__pydantic_complete__


def test_all_models_can_be_built_at_once():
    class Base(Frozen):
        value: int

    class Derived(Base):
        other: int

    build_models()

    assert Base.__pydantic_complete__
    assert Derived.__pydantic_complete__


@pytest.mark.parametrize(
    "number",
    [
        5,
        5.0,
        np.float32(5),
        np.float64(5),
        np.int8(5),
        np.uint64(5),
        Decimal(5),
        Decimal("5.0"),
        Fraction(5),
    ],
)
def test_what_python_counts_with_is_a_number(number):
    assert MoveAbsolute(position=number).position == 5
    assert type(MoveAbsolute(position=number).position) is float
    assert SetGains(kp=number).kp == 5
    assert type(SetGains(kp=number).kp) is int


@pytest.mark.parametrize(
    "value",
    [
        float("nan"),
        float("inf"),
        Decimal("NaN"),
        Decimal("sNaN"),
        Decimal("-Infinity"),
        Decimal("1e999"),
        np.float32("nan"),
        10**400,
        Fraction(10**400),
    ],
)
def test_what_no_register_can_hold_is_no_number(value):
    with pytest.raises(pydantic.ValidationError, match="position"):
        MoveAbsolute(position=value)
    with pytest.raises(pydantic.ValidationError, match="kp"):
        SetGains(kp=value)


@pytest.mark.parametrize("value", [5.5, Decimal("5.5"), Fraction(11, 2), np.float32(5.5)])
def test_a_whole_number_has_no_fraction(value):
    with pytest.raises(pydantic.ValidationError, match="kp"):
        SetGains(kp=value)


@pytest.mark.long
def test_no_field_of_any_model_takes_a_text_or_a_truth_for_a_number():
    """Walk everything that crosses the network or comes from a file, by the annotations of its fields."""
    taken = {
        f"{model.__module__}.{model.__qualname__}.{name}: {bad!r}"
        for model in _all_models()
        for name, field in model.model_fields.items()
        for bad in NO_NUMBERS
        for shape in _with_number(field.annotation, bad)
        if _takes(model, name, shape)
    }
    fields = {name for model in _all_models() for name, field in model.model_fields.items() if _has_number(field)}

    assert len(fields) > 200, "the walk has found the fields of the models"
    assert not taken, f"{len(taken)} are taken: " + ", ".join(sorted(taken)[:20])


def test_the_walk_covers_what_is_published():
    assert set(PUBLIC_MODELS) <= set(_all_models())


def test_a_file_says_numbers_as_numbers(tmp_path):
    class Table(Frozen):
        rate_hz: float
        count: int

    file = tmp_path / "numbers.toml"
    file.write_text('rate_hz = "1_000"\ncount = true\n')

    with pytest.raises(ConfigError, match=r"(?s)rate_hz: .*valid number.*count: .*valid integer"):
        read_toml(file, Table)

    file.write_text("rate_hz = 1_000\ncount = 3.0\n")
    assert read_toml(file, Table) == Table(rate_hz=1000, count=3)


def test_json_is_read_as_strictly():
    for text in ('{"position": "5"}', '{"position": true}', '{"position": NaN}', '{"position": 1e999}'):
        with pytest.raises(pydantic.ValidationError, match="position"):
            MoveAbsolute.model_validate_json(text)


def _all_models() -> list[type[Frozen]]:
    for module in pkgutil.walk_packages(ldcnd.__path__, "ldcnd."):
        if not module.name.endswith("__main__"):
            try:
                importlib.import_module(module.name)
            except ModuleNotFoundError as error:
                if (error.name or "").partition(".")[0] not in EXTRAS:
                    raise
    return [model for model in _below(Frozen) if model.__module__.startswith("ldcnd.")]


def _below(model: type[Frozen]) -> Iterator[type[Frozen]]:
    for each in model.__subclasses__():
        yield each
        yield from _below(each)


def _has_number(field: Any) -> bool:
    return bool(list(_with_number(field.annotation, object())))


def _with_number(annotation: Any, value: object) -> Iterator[object]:
    """Yield this value in each place of a type where a number stands, and nothing else that it could be."""
    inner = get_args(annotation)
    origin = get_origin(annotation)
    if annotation in (int, float):
        yield value
    elif origin is Annotated:
        yield from _with_number(inner[0], value)
    elif origin in (Union, types.UnionType):
        others = {str: str | bytes, bool: bool | np.bool_}
        if not any(isinstance(value, others.get(each, ())) for each in inner):
            for each in inner:
                yield from _with_number(each, value)
    elif origin is tuple:
        for shape in _with_number(inner[0], value):
            yield (shape,) if inner[-1] is Ellipsis else (shape,) * len(inner)
    elif origin in (list, frozenset):
        yield from ([shape] for shape in _with_number(inner[0], value))
    elif isinstance(origin, type) and issubclass(origin, Mapping):
        yield from ({"key": shape} for shape in _with_number(inner[1], value))


def _takes(model: type[Frozen], name: str, value: object) -> bool:
    """Tell whether a model complains about other fields alone."""
    alias = model.model_fields[name].alias or name
    try:
        model.model_validate({alias: value})
    except pydantic.ValidationError as error:
        return not any(each["loc"][:1] in ((alias,), ()) for each in error.errors())
    return True
