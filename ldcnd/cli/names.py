"""Names that were typed: a wrong one gets one line with the nearest right one."""

from collections.abc import Iterable
from difflib import get_close_matches

from ldcnd.client.rig_client import RigClient
from ldcnd.errors import UnknownAxis
from ldcnd.model.meta import AxisInfo

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
