"""Models are built when they are needed first, or all of them on demand."""

from ldcnd.contract.frozen import Frozen, build_models


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
