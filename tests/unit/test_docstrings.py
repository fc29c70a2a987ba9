"""What docstrings must say: fields of models, in their schemas; packages, to those who come new."""

from ldcnd.contract.frozen import Frozen, attribute_docstrings


class Base(Frozen):
    """What others build upon."""

    first: int
    """Said of
    the first."""
    silent: int


class Derived(Base):
    """One of them."""

    first: int
    """Said anew."""
    other: Base
    """A model."""


def test_what_is_said_of_attributes_is_found_in_the_source():
    assert attribute_docstrings(Base) == {"first": "Said of\nthe first."}
    assert attribute_docstrings(Derived) == {"first": "Said anew.", "other": "A model."}


def test_a_model_without_source_says_nothing_of_its_own():
    made = type("Made", (Base,), {"__module__": "made.here", "__annotations__": {"own": int}})

    assert attribute_docstrings(made) == {"first": "Said of\nthe first."}


def test_schemas_describe_their_fields():
    schema = Derived.model_json_schema()

    assert schema["properties"]["first"]["description"] == "Said anew."
    assert "description" not in schema["properties"]["silent"]
    assert schema["properties"]["other"] == {"$ref": "#/$defs/Base", "description": "A model."}
    assert schema["$defs"]["Base"]["properties"]["first"]["description"] == "Said of\nthe first."
