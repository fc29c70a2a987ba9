"""Motor records of a gateway as a Channel Access client uses them, without the network in between."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from random import Random
from types import MappingProxyType, SimpleNamespace

from caproto import ChannelType, SubscriptionType

from ldcnd.client.rig import Rig
from ldcnd.config.rig import RigConfig
from ldcnd.contract.samples import LinkState
from ldcnd.lab.epics.gateway import Gateway, gateway
from ldcnd.sim.chain import Chain
from tests.support.rig import RunningRig, running_rig, two_axes

KINDS = {str: ChannelType.STRING, int: ChannelType.LONG, float: ChannelType.DOUBLE}
VALUES: tuple[float | int | str, ...] = (
    *(0, 1, 2, 3, -1, 1.5, -20.0, 1e9, 1e-9),
    *("Go", "Stop", "Set", "Use", "Enable", "Disable", "Move", "1", ""),
)
"""What is put at random."""
SCREENS = {
    "motorx_all": "ACCL ATHM BACC BDST BVEL CARD CNEN DESC DHLM DIFF DIR DLLM DLY DMOV DRBV DTYP DVAL EGU ERES FLNK "
    "PCOF ICOF DCOF PREM POST STUP SYNC "
    "FOFF FRAC HLM HLS HOMF HOMR JAR JOGF JOGR JVEL LLM LLS LVIO MIP MOVN MRES MSTA OFF OMSL PREC RBV RCNT RDBD RDBL "
    "REP RLV RMP RRBV RRES RTRY RVAL SET SPMG STAT STOP TDIR TWF TWR TWV UEIP URIP VAL VBAS VELO VERS VMAX",
    "motor8x": "DESC DMOV EGU HLS LLS LVIO RBV SET STOP TWF TWR TWV VAL",
    "ophyd and pyepics": "ACCL DIR DMOV EGU HLM HLS HOMF HOMR LLM LLS MOVN MSTA OFF RBV RTYP SET STOP TDIR VAL VELO",
    "NICOS": "RBV VAL DMOV MOVN MISS LVIO HLS LLS HLM LLM DHLM DLLM OFF DIR SPMG STAT SEVR STOP RDBD EGU VELO CNEN",
}
"""Fields that screens of the motor record and clients use, in their own words."""
STARTS = (".VAL", ".TWF", ".TWR", ".HOMF", ".HOMR", ".JOGF", ".JOGR")
STARTING = 0.7


@asynccontextmanager
async def records(
    *,
    moves: bool = True,
    power: bool = True,
    config: RigConfig | None = None,
    chains: Mapping[str, Chain] = MappingProxyType({}),
) -> AsyncIterator[tuple[RunningRig, Gateway]]:
    """Run a daemon and a gateway in this process, on simulated lines of `chains`; x is enabled if it can be moved."""
    async with running_rig(config or two_axes(), chains) as running:
        for name in running.daemon.rig.axes:
            await running.until(name, lambda state: state.link is LinkState.UP)
        rig = Rig(running.client, await running.client.daemon())
        async with gateway(rig, prefix="T:", moves=rig.axes if moves else ()) as made:
            await shows(made, "T:x.SEVR", "NO_ALARM")
            if moves and power:
                await put(made, "T:x.CNEN", "Enable")
                await shows(made, "T:x.CNEN", "Enable")
            yield running, made


class Wanted:
    """What a subscription asks for."""

    def __init__(self, kind: ChannelType, mask: SubscriptionType) -> None:
        self.channel_filter = SimpleNamespace(sync=None)
        self.data_type_name = kind.name
        self.mask = mask


async def monitored(
    made: Gateway,
    name: str,
    kind: ChannelType = ChannelType.LONG,
    mask: SubscriptionType = SubscriptionType.DBE_VALUE | SubscriptionType.DBE_ALARM,
) -> "asyncio.Queue[SimpleNamespace]":
    """Return the queue of all that a client is sent who monitors a variable."""
    sent: asyncio.Queue[SimpleNamespace] = asyncio.Queue()
    await made.variables[name].subscribe(sent, Wanted(kind, mask), None)
    return sent


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
