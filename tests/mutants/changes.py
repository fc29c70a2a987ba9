"""What can be changed in a module so that it still runs but does something else."""

import ast
import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType

COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
LOGGED = frozenset({"debug", "info", "warning", "error", "exception"})
"""Calls whose loss changes nothing but the log."""
SHOWN = 100
"""Longest text of one side of a change, in characters."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one module.

    Attributes:
        path: of the module, below the project's folder.
        place: qualified name of the function or class that is changed; empty for the module itself.
        function: qualified name of the outermost function around the change; empty where there is none.
        lines: first and last line of what is changed.
        node: number of the changed node, as `ast.walk` counts.
        kind: which of the changes of that node.
        change: the code before and after.
        ordinal: how many alike there are before it in its place.
        nth: which of its kind it is in its place, from 1.
    """

    path: str
    place: str
    function: str
    lines: tuple[int, int]
    node: int
    kind: str
    change: str
    ordinal: int = 0
    nth: int = 1

    @property
    def address(self) -> tuple[str, str, str, int]:
        """What names the change without its text: module, function, kind, and which of that kind."""
        return self.path, self.place, self.kind, self.nth

    def rank(self, seed: int) -> bytes:
        """Return what orders mutants at random for a seed, and keeps that order when others come and go."""
        what = f"{seed} {self.path} {self.place} {self.change} {self.ordinal}"
        return hashlib.sha256(what.encode()).digest()

    def module(self, root: Path) -> CodeType:
        """Compile the changed module; its lines keep their numbers."""
        file = root / self.path
        tree = ast.parse(file.read_text(encoding="utf-8"))
        target = next(node for number, node in enumerate(ast.walk(tree)) if number == self.node)
        _make(target, self.kind)
        return compile(ast.fix_missing_locations(tree), str(file), "exec", dont_inherit=True)

    def __str__(self) -> str:
        nth = f" (nth = {self.nth})" if self.nth > 1 else ""
        return f"{self.path}:{self.lines[0]} {self.place}: {self.change}{nth}"


def mutants_of(path: str, root: Path) -> Iterator[Mutant]:
    """Yield all changes of a module, in the order of its nodes."""
    tree = ast.parse((root / path).read_text(encoding="utf-8"))
    places = {id(tree): ("", "")} | dict(_places(tree, "", ""))
    left_alone = {id(part) for node in ast.walk(tree) for root_of in _left_alone(node) for part in ast.walk(root_of)}
    alike: Counter[tuple[str, str]] = Counter()
    of_kind: Counter[tuple[str, str]] = Counter()
    for number, node in enumerate(ast.walk(tree)):
        if id(node) in left_alone:
            continue
        place, function = places[id(node)]
        for kind in _kinds(node):
            if kind == "assignment removed" and place.endswith("__init__"):
                continue  # any test would miss the attribute
            before = ast.unparse(node.test if isinstance(node, ast.If) else node).partition("\n")[0][:SHOWN]
            change = f"{kind}: {before}"
            of_kind[place, kind] += 1
            count = of_kind[place, kind]
            yield Mutant(path, place, function, _lines(node), number, kind, change, alike[place, change], count)
            alike[place, change] += 1


def _places(node: ast.AST, place: str, function: str) -> Iterator[tuple[int, tuple[str, str]]]:
    """Yield where each node stands: the innermost function or class, and the outermost function."""
    for child in ast.iter_child_nodes(node):
        yield id(child), (place, function)
        name = f"{place}.{child.name}".lstrip(".") if isinstance(child, DEFINITIONS) else place
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield id(child.args), (name, function)
            yield from _places(child.args, name, function)  # defaults are computed outside
            body = ast.Module(child.body, [])
            yield from _places(body, name, function or name)
        else:
            yield from _places(child, name, function)


def _left_alone(node: ast.AST) -> Iterator[ast.AST]:
    """Yield parts of a node that carry no behaviour: types, decorators, the wording of messages, `zip(strict=...)`."""
    match node:
        case ast.FunctionDef() | ast.AsyncFunctionDef():
            yield from node.decorator_list
            yield from (part for part in (node.returns,) if part)
        case ast.ClassDef():
            yield from node.decorator_list
            yield from node.bases
        case ast.arg(annotation=ast.expr() as annotation) | ast.AnnAssign(annotation=annotation):
            yield annotation
        case ast.JoinedStr():
            yield node
        case ast.Call(func=ast.Attribute(value=ast.Name(id="log"), attr=attr)) if attr in LOGGED:
            yield node
        case ast.keyword(arg="strict"):
            yield node
        case ast.If(test=ast.Name(id="TYPE_CHECKING")):
            yield node


def _kinds(node: ast.AST) -> Iterator[str]:
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


def _lines(node: ast.AST) -> tuple[int, int]:
    """Return the lines of which one must have run for the change to be able to matter."""
    shown = node.test if isinstance(node, ast.If) else node
    assert isinstance(shown, ast.expr | ast.stmt)
    return shown.lineno, shown.end_lineno or shown.lineno


def _make(node: ast.AST, kind: str) -> None:
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
            node.test = ast.Constant(kind == "condition true")
        case ast.Constant():
            node.value = not node.value
        case ast.Expr() | ast.Assign() | ast.AugAssign() | ast.Raise():
            node.__class__ = ast.Pass  # type: ignore[assignment]
            node._fields = ()  # type: ignore[misc]
