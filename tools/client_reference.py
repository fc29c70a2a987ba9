"""The reference of the Python client, made from signatures and docstrings; `make fix` writes it."""

import inspect
import re
from collections.abc import Iterator

from ldcnd.client.axis import Axis
from ldcnd.client.motion import Motion, Position, State
from ldcnd.client.rig import Rig, connect
from ldcnd.client.traces import Trace

INNER = {"watched", "controlled", "news", "halt_now", "halt_unfinished", "begin", "begun", "lost", "outcome"}
"""Parts of `Axis` and `Rig` that programs do not call."""
HEADER = """# The Python client

What can a program call? `help(ldcnd.Axis)` and editors have arguments, units and errors of each call;
[write a client](../how-to/write-a-client.md) shows how the parts fit together. Calls with `await` are the same
without it after `ldcnd.connect_blocking`. Arguments in brackets may be left out.

"""

VERBS = """
And a method for each verb of an axis, which [keys and payloads](keys.md#all-keys) explains: `await x.home(velocity=1)`.
"""


def client_reference() -> str:
    """Return the page."""
    parts = [HEADER + f"* `{_call('ldcnd.connect', connect)}`: {_summary(connect)}\n"]
    for kind in (Rig, Axis, Motion, Position, State, Trace):
        rows = "".join(f"* `{shown}`: {_summary(member)}\n" for shown, member in _members(kind))
        calls = f"\n{rows}" if rows else ""
        calls += VERBS if kind is Axis else ""
        parts.append(f"## `ldcnd.{kind.__name__}`\n\n{_summary(kind)}{_attributes(kind)}\n{calls}")
    return "\n".join(parts)


def _members(kind: type) -> Iterator[tuple[str, object]]:
    for name in vars(kind):
        member = inspect.getattr_static(kind, name)
        if name.startswith("_") or name in INNER or not (inspect.isfunction(member) or isinstance(member, property)):
            continue
        wait = "await " if inspect.iscoroutinefunction(member) else ""
        yield wait + (name if isinstance(member, property) else _call(name, member)), member


def _call(name: str, call: object) -> str:
    """Return a call with the names of its arguments; those that may be left out are in brackets."""
    if not callable(call):
        raise TypeError(f"{call!r} is not called")
    parameters = [each for own, each in inspect.signature(call).parameters.items() if own != "self"]
    needed = [
        f"*{each.name}" if each.kind is each.VAR_POSITIONAL else each.name for each in parameters if _needed(each)
    ]
    others = [each.name for each in parameters if not _needed(each)]
    optional = f"[{', '.join(others)}]" if others else ""
    return f"{name}({' '.join(part for part in (', '.join(needed), optional) if part)})"


def _needed(parameter: inspect.Parameter) -> bool:
    return parameter.default is inspect.Parameter.empty


def _summary(member: object) -> str:
    """Return the first paragraph of a docstring."""
    return " ".join((inspect.getdoc(member) or "").partition("\n\n")[0].split())


def _attributes(kind: type) -> str:
    """Return a sentence with the attributes that a docstring describes."""
    names = re.findall(r"(?m)^    (\w+): ", (inspect.getdoc(kind) or "").partition("Attributes:")[2])
    return f" Attributes: {', '.join(f'`{name}`' for name in names)}." if names else ""
