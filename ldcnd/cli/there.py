"""Names of a rig, asked of its daemon; a wrong one is answered with the nearest right one."""

from collections.abc import Iterable
from difflib import get_close_matches

from ldcnd.client.overview import last_bus_health
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import UnknownAxis
from ldcnd.contract.meta import AxisInfo

NEAR = 0.4
"""How alike two names must be, from 0 to 1."""


def unknown(what: str, name: str, known: Iterable[str]) -> UnknownAxis:
    """Return the refusal of a name."""
    names = sorted(known)
    by_fold = {each.casefold(): each for each in names}
    near = by_fold.get(name.casefold()) or next(iter(get_close_matches(name, names, 1, NEAR)), None)
    meant = f"; did you mean {near!r}?" if near else ""
    return UnknownAxis(
        f"there is no {what} {name!r}{meant}", value=name, remedy=f"there are: {', '.join(names) or 'none'}"
    )


async def axis_of(client: RigClient, name: str) -> AxisInfo:
    """Return what an axis is.

    Raises:
        UnknownAxis: the rig has none of that name.
    """
    axes = {info.axis: info for info in await client.axes()}
    if name not in axes:
        raise unknown("axis", name, axes)
    return axes[name]


async def check_there(client: RigClient, name: str, *, lines: bool = False) -> None:
    """Refuse the name of nothing that the rig has: an axis, an I/O module or, with `lines`, a line.

    Raises:
        UnknownAxis: the rig has none of that name.
    """
    buses = await client.buses()
    known = {module.name for bus in buses for module in bus.modules}  # none while the line is down
    known |= {module.module for report in await last_bus_health(client) for module in report.modules}
    known |= {bus.bus for bus in buses} if lines else set()
    if name not in known:
        await axis_of(client, name)
