"""Models are built when they are needed first, or all of them on demand."""

import pytest
from pydantic import ValidationError

from ldcnd.model.frozen import Frozen, build_models, unchecked


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


def test_a_model_that_is_made_unchecked_is_like_any_other():
    class Value(Frozen):
        value: float
        unit: str = "mm"

    made, checked = unchecked(Value)(value=1.5, unit="mm"), Value(value=1.5)

    assert made == checked
    assert hash(made) == hash(checked)
    assert made.model_dump_json() == checked.model_dump_json()
    assert made.model_copy(update={"unit": "deg"}) == Value(value=1.5, unit="deg")
    with pytest.raises(ValidationError, match="frozen"):
        made.value = 2.0  # type: ignore[misc]
