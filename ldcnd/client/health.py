"""The reports of a daemon about itself and its lines."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import decode_received
from ldcnd.contract.health import BusHealth, DaemonHealth
from ldcnd.net.session import Publication, SampleKind


async def last_health(client: RigClient) -> DaemonHealth | None:
    """Return the daemon's last report about itself, or None when there is none yet."""
    reports = await client.read(client.keys.health, DaemonHealth)
    return reports[-1] if reports else None


async def last_bus_health(client: RigClient) -> list[BusHealth]:
    """Return the last report about each line and its axes."""
    return await client.read(client.keys.bus_health("*"), BusHealth)


@asynccontextmanager
async def health_reports(client: RigClient, take: Callable[[DaemonHealth | BusHealth], None]) -> AsyncIterator[None]:
    """Hand every health report to `take` for the time of the context."""

    def decode(sample: Publication) -> None:
        if sample.kind is SampleKind.DELETE:
            return
        if sample.key == client.keys.health:
            take(decode_received(DaemonHealth, sample.payload, sample.encoding))
        else:
            take(decode_received(BusHealth, sample.payload, sample.encoding))

    declaration = await client.subscribe(f"{client.keys.health}/**", decode)
    try:
        yield
    finally:
        await declaration.close()
