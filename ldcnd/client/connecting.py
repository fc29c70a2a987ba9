"""From an endpoint to a rig."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from difflib import get_close_matches

from ldcnd.client.rig_client import RigClient, find_rigs
from ldcnd.errors import SessionError, UnknownAxis
from ldcnd.messaging.zenoh_session import open_zenoh_session
from ldcnd.messaging.zenoh_settings import ZenohSettings


def at(*endpoints: str) -> ZenohSettings:
    """Return the settings of a client without a login, such as `at("tcp/127.0.0.1:7447")`."""
    return ZenohSettings(mode="client", connect=endpoints)


@asynccontextmanager
async def open_rig(settings: ZenohSettings, rig: str | None = None) -> AsyncIterator[RigClient]:
    """Join the network and use one rig for as long as the context lasts.

    Args:
        settings: where to connect, and with which login.
        rig: which one; not needed when only one can be reached.

    Raises:
        SessionError: no connection, or no daemon answers.
        UnknownAxis: several rigs can be reached and none was named.
    """
    async with open_zenoh_session(settings) as session:
        rigs = sorted({daemon.rig for daemon in await find_rigs(session)})
        if rig not in rigs:
            if not rigs:
                raise SessionError(
                    f"no daemon answers at {', '.join(settings.connect) or 'the configured endpoints'}",
                    remedy="start one with `ldcnd run`, or name its endpoint with --connect; a login without a role"
                    " sees none either",
                )
            there = f"there are: {', '.join(rigs)}"
            if rig is not None:
                near = next(iter(get_close_matches(rig, rigs, 1)), None)
                meant = f"; did you mean {near!r}?" if near else ""
                raise SessionError(f"no rig {rig!r} answers{meant}", value=rig, remedy=there)
            if len(rigs) > 1:
                raise UnknownAxis(f"several rigs answer; {there}", remedy="choose one with --rig")
            rig = rigs[0]
        yield RigClient(session, rig)
