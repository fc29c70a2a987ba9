"""ldcnd owns RS-485 servo lines and exposes their drives over Zenoh.

    import asyncio, ldcnd

    async def main() -> None:
        async with ldcnd.connect() as rig, rig.control("x", client="demo") as x:
            await x.power(on=True)
            move = await x.move_absolute(5, velocity=5)
            await move.done()

    asyncio.run(main())

What is named here is the Python client; everything below it is not for programs. Nothing is loaded before it is used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ldcnd.client.axis import Axis
    from ldcnd.client.blocking import connect as connect_blocking
    from ldcnd.client.motion import Motion, Position, State
    from ldcnd.client.rig import Rig, connect
    from ldcnd.client.traces import Trace
    from ldcnd.contract.errors import LdcndError

_HOME = {
    "Axis": ("ldcnd.client.axis", "Axis"),
    "LdcndError": ("ldcnd.contract.errors", "LdcndError"),
    "Motion": ("ldcnd.client.motion", "Motion"),
    "Position": ("ldcnd.client.motion", "Position"),
    "Rig": ("ldcnd.client.rig", "Rig"),
    "State": ("ldcnd.client.motion", "State"),
    "Trace": ("ldcnd.client.traces", "Trace"),
    "connect": ("ldcnd.client.rig", "connect"),
    "connect_blocking": ("ldcnd.client.blocking", "connect"),
}

__all__ = ["Axis", "LdcndError", "Motion", "Position", "Rig", "State", "Trace", "connect", "connect_blocking"]


def __getattr__(name: str) -> object:
    """Load an attribute on first use."""
    if name not in _HOME:
        raise AttributeError(f"module 'ldcnd' has no attribute {name!r}")
    module, attribute = _HOME[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    """List the client."""
    return sorted(__all__)
