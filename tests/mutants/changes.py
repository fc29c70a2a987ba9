"""What can be changed in a module so that it still runs but does something else."""

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}
LOGGED = frozenset({"debug", "info", "warning", "error", "exception"})
"""Calls whose loss changes nothing but the log."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one module.

    Attributes:
        path: of the module, below the project's folder.
        line: where it is changed.
        change: what was done, in words.
        before: the line as it was.
        source: the whole module after the change.
    """

    path: str
    line: int
    change: str
    before: str
    source: str


def mutants_of(path: str, root: Path) -> Iterator[Mutant]:
    """Yield all changes of a module, in the order of its lines."""
    text = (root / path).read_text(encoding="utf-8")
    lines = text.splitlines()
    tree = ast.parse(text)
    decorating = {
        id(part)
        for node in ast.walk(tree)
        for decorator in getattr(node, "decorator_list", ())
        for part in ast.walk(decorator)
    }
    for number, node in enumerate(ast.walk(tree)):
        if id(node) in decorating:
            continue
        for change in _changes(node):
            changed = copy.deepcopy(tree)
            target = next(other for at, other in enumerate(ast.walk(changed)) if at == number)
            _make(target, change)
            line = getattr(node, "lineno", 0)
            yield Mutant(path, line, change, lines[line - 1].strip(), ast.unparse(ast.fix_missing_locations(changed)))


def _changes(node: ast.AST) -> Iterator[str]:
    """Yield the names of what can be done to a node."""
    match node:
        case ast.Compare(ops=[op]) if type(op) in COMPARISONS:
            yield f"{type(op).__name__} to {COMPARISONS[type(op)].__name__}"
        case ast.BoolOp():
            yield "and to or" if isinstance(node.op, ast.And) else "or to and"
        case ast.BinOp(op=ast.BitOr(), right=ast.Constant(value=None)):
            pass  # a type
        case ast.BinOp(op=op) if type(op) in OPERATORS and not isinstance(node.left, ast.Constant | ast.JoinedStr):
            yield f"{type(op).__name__} to {OPERATORS[type(op)].__name__}"
        case ast.UnaryOp(op=ast.Not()):
            yield "not removed"
        case ast.If():
            yield "condition true"
            yield "condition false"
        case ast.Constant(value=bool()):
            yield "the other truth value"
        case ast.Expr(value=ast.Call() | ast.Await()) if not _is_logged(node.value):
            yield "call removed"
        case ast.Assign(targets=[ast.Attribute()]) | ast.AugAssign(target=ast.Attribute()):
            yield "assignment removed"
        case ast.Raise():
            yield "raise removed"


def _is_logged(value: ast.expr) -> bool:
    match value:
        case ast.Call(func=ast.Attribute(value=ast.Name(id="log"), attr=attr)) if attr in LOGGED:
            return True
        case _:
            return False


def _make(node: ast.AST, change: str) -> None:
    """Change a node in place."""
    match node:
        case ast.Compare():
            node.ops = [COMPARISONS[type(node.ops[0])]()]
        case ast.BoolOp():
            node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        case ast.BinOp():
            node.op = OPERATORS[type(node.op)]()
        case ast.UnaryOp():
            node.op, node.operand = ast.Not(), ast.UnaryOp(ast.Not(), node.operand)
        case ast.If():
            node.test = ast.Constant(change == "condition true")
        case ast.Constant():
            node.value = not node.value
        case ast.Expr() | ast.Assign() | ast.AugAssign() | ast.Raise():
            node.__class__ = ast.Pass  # type: ignore[assignment]
            node._fields = ()
