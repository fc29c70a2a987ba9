"""The reference of the Python client, made from signatures and docstrings; `make fix` writes it."""

import inspect
import re
from collections.abc import Iterator

from ldcnd.client.axis import Axis
from ldcnd.client.motion import Motion, Position, State
from ldcnd.client.rig import Rig, connect
from ldcnd.client.traces import Trace
from ldcnd.client.verbs import AxisVerbs

INNER = {"watched", "controlled", "news", "halt_now", "halt_unfinished", "begun", "lost", "outcome"}
"""Parts of `Axis` and `Rig` that programs do not call."""
HEADER = """# The Python client

What can a program call? This page is made from the docstrings of `ldcnd`;
[write a client](../how-to/write-a-client.md) shows how the parts fit together. `ldcnd.connect_blocking` has the same
calls without `await`.

"""


def client_reference() -> str:
    """Return the page."""
    parts = [f"## `ldcnd.connect{_signature(connect)}`\n\n{_text(connect)}\n"]
    for kind in (Rig, Axis, Motion, Position, State, Trace):
        parts.append(f"## `ldcnd.{kind.__name__}`\n\n{_text(kind)}\n")
        parts += [f"### `{shown}`\n\n{_text(member)}\n" for shown, member in _members(kind)]
    return HEADER + "\n".join(parts)


def _members(kind: type) -> Iterator[tuple[str, object]]:
    own = [*vars(kind), *(vars(AxisVerbs) if kind is Axis else ())]
    for name in dict.fromkeys(own):
        member = inspect.getattr_static(kind, name)
        if name.startswith("_") or name in INNER or not (inspect.isfunction(member) or isinstance(member, property)):
            continue
        wait = "await " if inspect.iscoroutinefunction(member) else ""
        yield f"{wait}{name}{'' if isinstance(member, property) else _signature(member)}", member


def _signature(call: object) -> str:
    if not callable(call):
        raise TypeError(f"{call!r} is not called")
    signature = inspect.signature(call)
    shown = [parameter for name, parameter in signature.parameters.items() if name != "self"]
    text = str(signature.replace(parameters=shown, return_annotation=inspect.Signature.empty))
    text = re.sub(r"<(\w+\.\w+): [^>]*>", r"\1", text)
    return re.sub(r"\b(?:\w+\.)+(?=[A-Z]\w*(?:[\[\], )]|$))", "", text)


def _text(member: object) -> str:
    """Return a docstring as Markdown: its sections as lists."""
    lines, section = [], False
    for line in (inspect.getdoc(member) or "").splitlines():
        if heading := re.fullmatch(r"(Args|Raises|Attributes):", line):
            section = True
            lines += [f"{heading[1]}:", ""]
        elif section and (entry := re.fullmatch(r" {4}(\w[\w, ]*): (.*)", line)):
            lines.append(f"* `{entry[1]}`: {entry[2]}")
        else:
            lines.append(line.strip() if not section or not line.startswith("    ") else f"  {line.strip()}")
    return "\n".join(lines)
