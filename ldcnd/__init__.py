"""ldcnd owns RS-485 servo lines and exposes their drives over Zenoh.

    import asyncio, ldcnd

    async def main() -> None:
        async with ldcnd.connect() as rig, rig.control("x", client="demo") as x:
            await x.power(on=True)
            move = await x.move_absolute(5, velocity=5)
            await move.done()

    asyncio.run(main())

What is named here is for programs: the client, every error, and the values that its calls take and return. Everything
below is not. Nothing is loaded before it is used.
"""

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType

CALLS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "connect": ("ldcnd.client.rig", "connect"),
        "connect_blocking": ("ldcnd.client.blocking", "connect"),
        "open": ("ldcnd.client.blocking", "open_rig"),
        "recording": ("ldcnd.lab.recording.tables", "recording"),
    }
)
"""The functions: where each is."""
MODULES = (
    "ldcnd.contract.errors",
    "ldcnd.client.rig",
    "ldcnd.client.axis",
    "ldcnd.client.motion",
    "ldcnd.client.traces",
    "ldcnd.client.blocking",
    "ldcnd.contract.samples",
    "ldcnd.contract.commands",
    "ldcnd.contract.questions",
    "ldcnd.contract.rig_commands",
    "ldcnd.contract.parameters",
    "ldcnd.contract.traces",
    "ldcnd.contract.events",
    "ldcnd.contract.history",
    "ldcnd.contract.meta",
    "ldcnd.contract.leases",
)
"""Their public classes are named here, but for the commands, of which the axes have a method each."""


INNER = frozenset({"Command"})
"""Bases of what is not named here."""


def __getattr__(name: str) -> object:
    """Load an attribute on first use."""
    if name.startswith("_") or name in ("CALLS", "MODULES", "INNER"):
        raise AttributeError(f"module 'ldcnd' has no attribute {name!r}")
    if name in CALLS:
        module, attribute = CALLS[name]
        return getattr(import_module(module), attribute)
    for module in MODULES:
        found = vars(import_module(module)).get(name)
        if is_public(found, module):
            return found
    raise AttributeError(f"module 'ldcnd' has no attribute {name!r}")


def is_public(value: object, module: str) -> bool:
    """Tell whether a value of a module is named here, too."""
    if not isinstance(value, type) or value.__module__ != module or not value.__name__.isidentifier():
        return False
    return not value.__name__.startswith("_") and all(base.__name__ not in INNER for base in value.__mro__)


def __dir__() -> list[str]:
    """List what is named here."""
    found = {module: vars(import_module(module)).items() for module in MODULES}
    classes = (name for module, members in found.items() for name, value in members if is_public(value, module))
    return sorted([*CALLS, *classes])
