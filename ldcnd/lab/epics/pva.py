"""PV Access beside Channel Access: the same variables, with the same puts, by p4p (extra `epics-pva`)."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import p4p
from caproto import AlarmStatus
from p4p.nt import NTEnum, NTScalar
from p4p.server import DynamicProvider, Server, StaticProvider
from p4p.server.asyncio import SharedPV

from ldcnd.contract.errors import LdcndError
from ldcnd.lab.epics.fields import ChoiceField, Integer, Number, RecordField, Short, String, Text, Value
from ldcnd.lab.epics.gateway import Gateway
from ldcnd.listen_address import ListenAddress

CHANNEL_S = 2.0
"""Longest time that making a channel may take, seconds."""


class _Puts:
    """Takes the puts of a variable, as `SharedPV` has it.

    Attributes:
        on_gone: called when nobody is connected to it any more.
    """

    def __init__(self, field: RecordField, connected: set[object]) -> None:
        self._field, self._connected = field, connected
        self.on_gone: Callable[[], None] = lambda: None

    def onFirstConnect(self, _pv: SharedPV) -> None:  # noqa: N802 - called by p4p
        """Note that a client is there: a jog goes on for as long as it is."""
        self._connected.add(self)

    def onLastDisconnect(self, _pv: SharedPV) -> None:  # noqa: N802
        """Note that the last one has gone."""
        self._connected.discard(self)
        self.on_gone()

    async def put(self, _pv: SharedPV, operation: Any) -> None:  # noqa: ANN401 - p4p has no types
        """Carry a put out; one that asks for it (`record[block=true]`) is answered at the end of its effect."""
        try:
            await self._field.write(self._named(operation.value().raw), wait=_is_blocking(operation))
        except (LdcndError, ValueError, PermissionError) as error:
            operation.done(error=str(error))
        else:
            operation.done()

    def _named(self, given: p4p.Value) -> Value | None:
        """Return the value that a put names, None without one: what its client did not send is 0 in a structure."""
        name = "value.index" if isinstance(self._field, ChoiceField) else "value"
        value: Value | None = given[name] if given.changed(name) else None
        return value


def _is_blocking(operation: Any) -> bool:  # noqa: ANN401
    options = operation.pvRequest().todict().get("record", {}).get("_options", {})
    return str(options.get("block", "")).lower() == "true"


def _shown(field: RecordField) -> dict[str, Any]:
    """Return the value of a variable with what belongs to it, as the normative types of PV Access have it."""
    seconds, nanoseconds = divmod(round(field.timestamp * 1e9), 10**9)
    shown: dict[str, Any] = {
        "value": field.value,
        "alarm": {
            "severity": int(field.severity),
            "status": int(bool(field.status)),
            "message": AlarmStatus(field.status).name,
        },
        "timeStamp": {"secondsPastEpoch": seconds, "nanoseconds": nanoseconds},
    }
    if isinstance(field, ChoiceField):
        words = list(field.enum_strings)
        return {**shown, "value": {"index": words.index(field.value), "choices": words}}
    if isinstance(field, Number):
        low, high = field.lower_ctrl_limit, field.upper_ctrl_limit
        limits = {"limitLow": low, "limitHigh": high}
        return {
            **shown,
            "display": {**limits, "units": field.units, "precision": field.precision},
            "control": limits,
        }
    return shown


class _JogChannels:
    """Jogs, each channel of a client with a variable of its own: only so is it known that one of several is gone."""

    def __init__(self, connected: set[object]) -> None:
        self.fields: dict[str, RecordField] = {}
        self._connected = connected
        self._loop = asyncio.get_running_loop()

    def testChannel(self, name: str) -> bool:  # noqa: N802 - called by p4p, on a thread of its server
        """Tell whether there is such a variable."""
        return name in self.fields

    def makeChannel(self, name: str, _peer: str) -> SharedPV:  # noqa: N802 - likewise
        """Return the variable of a new channel."""
        return asyncio.run_coroutine_threadsafe(self._made(self.fields[name]), self._loop).result(CHANNEL_S)

    async def _made(self, field: RecordField) -> SharedPV:
        puts = _Puts(field, self._connected)
        shared = _variable(field, puts)
        puts.on_gone = partial(_forget, field, field.followers[-1])
        return shared


def _forget(field: RecordField, follower: Callable[[], None]) -> None:
    if follower in field.followers:
        field.followers.remove(follower)


def _variable(field: RecordField, puts: _Puts) -> SharedPV:
    match field:
        case ChoiceField():
            kind: Any = NTEnum()
        case Number():
            kind = NTScalar("d", display=True, control=True, form=True)
        case Integer() | Short():
            kind = NTScalar("i")
        case _:
            kind = NTScalar("s")
    shared = SharedPV(handler=puts, nt=kind, initial=_shown(field))
    field.followers.append(partial(_post, shared, field))
    return shared


def _post(shared: SharedPV, field: RecordField) -> None:
    shared.post(_shown(field))


@asynccontextmanager
async def serve_pva(records: Gateway, address: ListenAddress) -> AsyncIterator[None]:
    """Serve the variables of a gateway until the context ends; beacons go as those of Channel Access do."""
    provider, jogs = StaticProvider("ldcnd"), _JogChannels(records.jog_channels)
    shared: dict[int, SharedPV] = {}

    def add(variables: Mapping[str, RecordField]) -> None:
        for name, field in variables.items():
            if name.endswith((".JOGF", ".JOGR")):
                jogs.fields[name] = field
                continue
            if id(field) not in shared:
                shared[id(field)] = _variable(field, _Puts(field, set()))
            provider.add(name, shared[id(field)])
            if "." not in name and f"{name}.VAL" not in variables:
                provider.add(f"{name}.VAL", shared[id(field)])
            if isinstance(field, String | Text):
                provider.add(f"{name}$", shared[id(field)])

    add(records.variables)
    records.on_added.append(add)
    conf = {"EPICS_PVAS_INTF_ADDR_LIST": address.host, "EPICS_PVAS_SERVER_PORT": str(address.port)}
    if address.host.startswith("127."):
        conf |= {"EPICS_PVAS_AUTO_BEACON_ADDR_LIST": "NO", "EPICS_PVAS_BEACON_ADDR_LIST": address.host}
    jogging = DynamicProvider("ldcnd jogs", jogs)  # p4p keeps none alive
    server = Server(providers=[provider, jogging], conf=conf, useenv=True)
    try:
        yield
    finally:
        records.on_added.remove(add)
        for field in records.variables.values():
            field.followers.clear()
        server.stop()
