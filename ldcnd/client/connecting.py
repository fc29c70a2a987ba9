"""From an endpoint to a rig."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

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
        if rig is None:
            rigs = [daemon.rig for daemon in await find_rigs(session)]
            if not rigs:
                raise SessionError(
                    f"no daemon answers at {', '.join(settings.connect) or 'the configured endpoints'}",
                    remedy="start one with `ldcnd run`, or name its endpoint with --connect; a login without a role"
                    " sees none either",
                )
            if len(rigs) > 1:
                raise UnknownAxis(f"there are several rigs: {', '.join(sorted(rigs))}", remedy="choose one with --rig")
            rig = rigs[0]
        yield RigClient(session, rig)
