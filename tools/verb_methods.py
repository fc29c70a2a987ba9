"""The methods of the Python client, one for each command of an axis, made from the command classes.

`python -m tools client` writes them into `ldcnd/client/verbs.py`: type checkers and editors see signatures that nothing
has to be kept equal to.
"""

import ast
import inspect
import re
import sys
from collections.abc import Iterator
from textwrap import dedent, fill

from ldcnd.contract.catalogue import COMMANDS
from ldcnd.contract.commands import About, AxisCommand, Command, Ends, Stop
from ldcnd.contract.frozen import Frozen, attribute_docstrings, own_fields_first
from ldcnd.contract.traces import TakeTrace
from ldcnd.contract.units import DIMENSIONS

BY_HAND = (Stop, TakeTrace)
"""`Axis` has these itself: a stop has a key of its own, and a trace is fetched when it is complete."""
WIDTH = 120
BEGIN = "    # made by `python -m tools client`: begin\n"
END = "    # made by `python -m tools client`: end\n"
HEADER = '''"""The verbs of an axis as methods; made from the command classes by `make fix`, not edited."""

from abc import ABC, abstractmethod
from typing import TypeVar

'''
CLASS = '''

ReplyT = TypeVar("ReplyT", bound=Frozen)
AxisReplyT = TypeVar("AxisReplyT", bound=CommandReply)


class AxisVerbs(ABC):
    """One method for each command; it returns once the drive has acknowledged the command, or raises why not.

    Positions, velocities and accelerations are numbers in the unit of the axis, that a second and that a second
    squared, or texts with a unit that the axis has, such as "3000 rpm".
    """

    @abstractmethod
    async def _send(self, command: type[AxisCommand[AxisReplyT]], **fields: object) -> AxisReplyT:
        """Send a command that ends with its reply."""

    @abstractmethod
    async def _start(self, command: type[AxisCommand[CommandReply]], **fields: object) -> Motion:
        """Send a command that ends later."""

    @abstractmethod
    async def _ask(self, command: type[Command[ReplyT]], /, **fields: object) -> ReplyT:
        """Query the daemon about the axis."""
'''


def verb_methods() -> str:
    """Return the text of `ldcnd/client/verbs.py`, but for what ruff makes of it."""
    names: set[type] = set()
    methods = "".join(_method(command, names) for command in _of_axes())
    imports = {"ldcnd.client.motion": {"Motion"}, "ldcnd.contract.frozen": {"Frozen"}}
    imports["ldcnd.contract.commands"] = {"AxisCommand", "Command", "CommandReply"}
    for used in names:
        imports.setdefault(used.__module__, set()).add(used.__name__)
    lines = [f"from {module} import {', '.join(sorted(found))}" for module, found in sorted(imports.items())]
    return HEADER + "\n".join(lines) + CLASS + methods


def with_blocking_methods(module: str) -> str:
    """Return the text of `ldcnd/client/blocking.py` with the methods of its `Axis` regenerated."""
    before, _, rest = module.partition(BEGIN)
    _, _, after = rest.partition(END)
    lines = [
        f"    {name} = {'_moving' if _moves(command) else '_waiting'}(asynchronous.Axis.{name})\n"
        for command in _of_axes()
        for name in (method_name(command),)
    ]
    return f"{before}{BEGIN}{''.join(lines)}\n{END}{after}"


def method_name(command: type[Command[Frozen]]) -> str:
    """Return the name of a command's method: that of its class in snake_case."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", command.__name__).lower()


def _of_axes() -> tuple[type[Command[Frozen]], ...]:
    return tuple(command for command in COMMANDS if command.about is About.AXIS and command not in BY_HAND)


def _moves(command: type[Command[Frozen]]) -> bool:
    return issubclass(command, AxisCommand) and command.ends is Ends.BY_READING


def _method(command: type[Command[Frozen]], names: set[type]) -> str:
    how, reply = "_ask", command.reply_model().__name__
    if issubclass(command, AxisCommand):
        how, reply = ("_start", "Motion") if _moves(command) else ("_send", reply)
    names |= {command} | ({command.reply_model()} if reply != "Motion" else set())
    own = [name for name in own_fields_first(command) if name not in AxisCommand.model_fields and name != "lease"]
    annotations, said = _annotations(command), attribute_docstrings(command)
    annotations |= {name: annotations[name].replace("float", "float | str") for name in own if name in DIMENSIONS}
    positional, keyword = [], []
    for name in own:
        field = command.model_fields[name]
        names |= _types_in(command, annotations[name])
        if field.is_required() and annotations[name] != "bool":
            positional.append(f"{name}: {annotations[name]}")
        elif field.is_required():
            keyword.append(f"{name}: {annotations[name]}")
        else:
            default = field.default
            shown = f"{type(default).__name__}.{default.name}" if hasattr(default, "name") else repr(default)
            keyword.append(f"{name}: {annotations[name]} = {shown}")
    signature = ", ".join(["self", *positional, *(["*", *keyword] if keyword else [])])
    made_by = ", ".join([command.__name__, *(f"{name}={name}" for name in own)])
    return (
        f"\n    async def {method_name(command)}({signature}) -> {reply}:\n"
        f"{''.join(_docstring(command, own, said))}"
        f"        return await self.{how}({made_by})\n"
    )


def _docstring(command: type[Command[Frozen]], own: list[str], said: dict[str, str]) -> Iterator[str]:
    yield f'        """{command.summary()}'
    if own:
        yield "\n\n        Args:\n"
        for name in own:
            text = " ".join(said.get(name, "see the command").split())
            yield fill(f"{name}: {text}", WIDTH, initial_indent=" " * 12, subsequent_indent=" " * 16) + "\n"
        yield "        "
    yield '"""\n'


def _annotations(command: type[Command[Frozen]]) -> dict[str, str]:
    """Return the annotations of the fields as their source has them, those of the bases included."""
    found: dict[str, str] = {}
    for base in reversed(command.__mro__):
        if not base.__module__.startswith("ldcnd.contract.") or "[" in base.__name__:
            continue
        node = ast.parse(dedent(inspect.getsource(base))).body[0]
        if isinstance(node, ast.ClassDef):
            found |= {
                part.target.id: ast.unparse(_Plain().visit(part.annotation))
                for part in node.body
                if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name)
            }
    return found


class _Plain(ast.NodeTransformer):
    """Takes the limits out of an annotation: `Annotated[int, Field(ge=0)]` is `int` to a caller."""

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.value, ast.Name) and node.value.id == "Annotated" and isinstance(node.slice, ast.Tuple):
            return node.slice.elts[0]
        return node


def _types_in(command: type[Command[Frozen]], annotation: str) -> set[type]:
    module = vars(sys.modules[command.__module__])
    found = (module.get(node.id) for node in ast.walk(ast.parse(annotation)) if isinstance(node, ast.Name))
    return {each for each in found if isinstance(each, type)}
