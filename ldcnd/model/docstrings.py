"""What the fields of a model mean, from the strings below them in its source.

Read only where a schema or a reference is written: to read them for every model of every program took a quarter of what
the program needed to begin.
"""

import ast
import inspect
import sys
from collections.abc import Mapping
from functools import cache
from itertools import pairwise

from pydantic import BaseModel


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
