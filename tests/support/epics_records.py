"""Motor records of a gateway as a Channel Access client uses them, without the network in between."""

import asyncio
from random import Random

from caproto import ChannelType

from ldcnd.lab.epics.gateway import Gateway

KINDS = {str: ChannelType.STRING, int: ChannelType.LONG, float: ChannelType.DOUBLE}
VALUES: tuple[float | int | str, ...] = (
    *(0, 1, 2, 3, -1, 1.5, -20.0, 1e9, 1e-9),
    *("Go", "Stop", "Set", "Use", "Enable", "Disable", "Move", "1", ""),
)
"""What is put at random."""
STARTS = (".VAL", ".TWF", ".TWR", ".HOMF", ".HOMR", ".JOGF", ".JOGR")
STARTING = 0.7


async def put(made: Gateway, name: str, value: float | str) -> None:
    """Put with completion."""
    data = [value.encode()] if isinstance(value, str) else [value]
    async with asyncio.timeout(120):
        await made.variables[name].auth_write("host", "user", data, KINDS[type(value)], None)


async def shows(made: Gateway, name: str, wanted: object, what: str = "value") -> None:
    """Wait until a variable has a value, or another attribute has."""
    async with asyncio.timeout(30):
        while getattr(made.variables[name], what) != wanted:
            await asyncio.sleep(0.01)


def any_put(made: Gateway, dice: Random) -> tuple[str, float | int | str]:
    """Return a variable and a value for it; each second one would start a motion where it can be put."""
    names, values = sorted(made.variables), VALUES
    if dice.random() < STARTING:
        names, values = [name for name in names if name.endswith(STARTS)], (1, 2.5, -3.0, 40.0)
        if dice.random() < STARTING:
            names = [name for name in names if made.variables[name].action]
    return dice.choice(names), dice.choice(values)
