"""What docstrings must say: fields of models, in their schemas; packages, to those who come new."""

import ast
from pathlib import Path

import pytest

import ldcnd
from ldcnd.model.frozen import Frozen, attribute_docstrings


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


PACKAGES = sorted(path.parent for path in Path(ldcnd.__file__).parent.rglob("__init__.py"))


@pytest.mark.parametrize("folder", PACKAGES[1:], ids=lambda path: path.name)
def test_a_package_says_whom_it_serves_and_where_to_start(folder):
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""
    if any(each in text for each in ("RE = RunEngine()", "The pages are files beside")):
        return  # an example, or the one file, is the start

    assert text.count("\n") >= 2
    assert "Serve" in text or "for " in text.lower()
    assert "Start with" in text
