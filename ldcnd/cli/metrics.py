"""`ldcnd metrics`: the health of a running daemon for Prometheus, from a process of its own."""

import asyncio
from typing import TYPE_CHECKING

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.ending import on_end
from ldcnd.cli.served_at import address_option
from ldcnd.client.health import health_reports
from ldcnd.client.rig_client import RigClient, Samples
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.samples import FaultSample, ShadowSample, StateSample, TelemetryItem
from ldcnd.listen_address import ListenAddress

if TYPE_CHECKING:
    from ldcnd.lab.metrics import HealthCollector

DEFAULT_ADDRESS = "127.0.0.1:9464"


@click.command()
@address_option("--address", DEFAULT_ADDRESS)
@with_target
def command(target: Target, address: ListenAddress) -> None:
    """Serve metrics over HTTP until SIGTERM or SIGINT; the daemon itself never waits for a scraper."""
    target.run(lambda client: _serve(client, address))


async def _serve(client: RigClient, address: ListenAddress) -> None:
    try:
        from prometheus_client import CollectorRegistry  # noqa: PLC0415 - an optional package

        from ldcnd.lab.metrics import HealthCollector, metrics_server  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError("prometheus-client is not installed", remedy="pip install 'ldcnd[metrics]'") from error
    loop = asyncio.get_running_loop()
    collector = HealthCollector(client.rig, loop.time)
    registry = CollectorRegistry()
    registry.register(collector)
    ending = asyncio.Event()
    on_end(ending.set)
    try:
        async with (
            health_reports(client, collector.take),
            client.samples(item=TelemetryItem.SHADOW) as shadows,
            client.samples(item=TelemetryItem.STATE) as states,
            client.samples(item=TelemetryItem.FAULT) as faults,
            metrics_server(registry, address.host, address.port) as port,
            asyncio.TaskGroup() as group,
        ):
            for axis, state in (await client.states()).items():
                collector.take_state(axis, state)
            for axis, fault in (await client.faults()).items():
                collector.take_state(axis, fault)
            following = [
                group.create_task(_follow(samples, collector), name="samples") for samples in (shadows, states, faults)
            ]
            click.echo(f"metrics on http://{address.in_url}:{port}/metrics")
            await ending.wait()
            for task in following:
                task.cancel()
    except OSError as error:
        where = f"{address.in_url}:{address.port}"
        raise ConfigError(f"cannot serve on {where}: {error.strerror}", value=where) from error


async def _follow(samples: Samples, collector: "HealthCollector") -> None:
    async for axis, sample in samples:
        if isinstance(sample, ShadowSample):
            collector.take_shadow(axis, sample)
        elif isinstance(sample, StateSample | FaultSample):
            collector.take_state(axis, sample)
