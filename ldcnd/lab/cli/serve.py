"""Programs that show a rig to others until they are ended: Prometheus, EPICS, ROS 2, Foxglove."""

import asyncio
import re
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import click

from ldcnd.cli.connection import Serving, Target, with_target
from ldcnd.cli.output import on_end
from ldcnd.cli.typed import WholeNumber, address_option, parsed_address
from ldcnd.client.network import ZenohSettings, endpoint_of, open_session
from ldcnd.client.overview import health_reports
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient, Samples, check_axes
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.samples import FaultSample, PositionSample, ShadowSample, StateSample, TelemetryItem
from ldcnd.listen_address import ListenAddress
from ldcnd.parts import require

if TYPE_CHECKING:
    from ldcnd.lab.metrics import HealthCollector


METRICS_ADDRESS = "127.0.0.1:9464"


@click.command()
@address_option("--address", METRICS_ADDRESS)
@with_target
def metrics(target: Target, address: ListenAddress) -> None:
    """Serve metrics over HTTP until SIGTERM or SIGINT; the daemon itself never waits for a scraper."""
    target.serve(lambda client, service: _serve_metrics(client, service, address))


async def _serve_metrics(client: RigClient, service: Serving, address: ListenAddress) -> None:
    require("prometheus_client")
    from prometheus_client import CollectorRegistry  # noqa: PLC0415 - an optional package

    from ldcnd.lab.metrics import HealthCollector, metrics_server  # noqa: PLC0415

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
            client.samples(item=TelemetryItem.POSITION) as positions,
            metrics_server(registry, address.host, address.port) as port,
            asyncio.TaskGroup() as group,
        ):
            for axis, state in (await client.states()).items():
                collector.take_state(axis, state)
            for axis, fault in (await client.faults()).items():
                collector.take_state(axis, fault)
            following = [
                group.create_task(_follow(samples, collector), name="samples")
                for samples in (shadows, states, faults, positions)
            ]
            service.serves(f"metrics on http://{address.in_url}:{port}/metrics")
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
        elif isinstance(sample, PositionSample):
            collector.take_position(axis, sample)


EPICS_ADDRESS = "127.0.0.1:5064"


@click.command()
@click.argument("axes", nargs=-1)
@click.option("--prefix", help="Of every process variable; the rig's name and a colon when missing.")
@click.option(
    "--moves", is_flag=True, help="Let puts move the axes, under a lease of this program; it is read-only otherwise."
)
@address_option("--address", EPICS_ADDRESS)
@click.option(
    "--pva",
    callback=parsed_address,
    metavar="HOST:PORT",
    help="Serve them over PV Access, too, such as on 127.0.0.1:5075.",
)
@with_target
def epics(
    target: Target,
    address: ListenAddress,
    axes: tuple[str, ...],
    prefix: str | None,
    moves: bool,  # noqa: FBT001 - click's
    pva: ListenAddress | None,
) -> None:
    """Serve AXES (all of them by default) as motor records until SIGTERM or SIGINT.

    Clients are not authenticated: with --moves, any client that reaches an address moves axes.
    """
    target.serve(lambda client, service: _serve_epics(client, service, address, axes, prefix, pva, moves=moves))


async def _serve_epics(
    client: RigClient,
    service: Serving,
    address: ListenAddress,
    axes: tuple[str, ...],
    prefix: str | None,
    pva: ListenAddress | None,
    *,
    moves: bool,
) -> None:
    require("caproto", *(["p4p"] if pva else []))
    from ldcnd.lab.epics.gateway import gateway, serve  # noqa: PLC0415 - needs an optional package

    rig = Rig(client, await client.daemon())
    named = f"{rig.name}:" if prefix is None else prefix
    async with AsyncExitStack() as faces:
        moved = (axes or rig.axes) if moves else ()
        records = await faces.enter_async_context(gateway(rig, prefix=named, axes=axes, moves=moved))
        if pva:
            from ldcnd.lab.epics.pva import serve_pva  # noqa: PLC0415 - likewise

            await faces.enter_async_context(serve_pva(records, pva))
        await _serve_until_ended(
            service,
            lambda ready: serve(records, address, ready),
            address,
            f"{'motor records' if moves else 'read-only motor records'} {named}{{{','.join(axes or rig.axes)}}}",
        )


async def _serve_until_ended(
    service: Serving, serve: Callable[[asyncio.Event], Coroutine[None, None, None]], address: ListenAddress, what: str
) -> None:
    """Run a server until SIGTERM or SIGINT, and say what it serves once it has set its event.

    Raises:
        ConfigError: the address cannot be had.
    """
    ready, where = asyncio.Event(), f"{address.in_url}:{address.port}"
    serving = asyncio.create_task(serve(ready), name=what)
    on_end(lambda: _cancel(serving))
    await asyncio.wait({serving, asyncio.create_task(ready.wait())}, return_when=asyncio.FIRST_COMPLETED)
    if ready.is_set():
        service.serves(f"{what} on {where}")
    try:
        await serving
    except asyncio.CancelledError:
        return
    except OSError as error:
        raise ConfigError(f"cannot serve on {where}: {error.strerror}", value=where) from error


SECOP_ADDRESS = "127.0.0.1:10767"


@click.command()
@click.argument("axes", nargs=-1)
@click.option(
    "--moves", is_flag=True, help="Let clients move the axes, under a lease of this program; it is read-only otherwise."
)
@address_option("--address", SECOP_ADDRESS)
@with_target
def secop(target: Target, address: ListenAddress, axes: tuple[str, ...], moves: bool) -> None:  # noqa: FBT001 - click's
    """Serve AXES (all of them by default) as modules of a SECoP node until SIGTERM or SIGINT.

    SECoP does not authenticate clients: with --moves, any client that reaches the address moves axes.
    """
    target.serve(lambda client, service: _serve_secop(client, service, address, axes, moves=moves))


async def _serve_secop(
    client: RigClient, service: Serving, address: ListenAddress, axes: tuple[str, ...], *, moves: bool
) -> None:
    require("frappy")
    from ldcnd.lab.secop.node import serve  # noqa: PLC0415 - needs an optional package, under the GPL

    rig = Rig(client, await client.daemon())
    await _serve_until_ended(
        service,
        lambda ready: serve(rig, address, axes, (axes or rig.axes) if moves else (), ready),
        address,
        f"{'SECoP modules' if moves else 'read-only SECoP modules'} {{{','.join(axes or rig.axes)}}}",
    )


def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()


HIGHEST_DOMAIN = 232


@click.command()
@click.argument("axes", nargs=-1)
@click.option("--router", required=True, help="Zenoh endpoint of the ROS graph's router, such as tcp/127.0.0.1:7447.")
@click.option("--domain", type=WholeNumber(0, HIGHEST_DOMAIN), default=0, show_default=True, envvar="ROS_DOMAIN_ID")
@click.option("--namespace", default="/", show_default=True, help="Of the node and of joint_states, such as /lab.")
@with_target
def ros2(target: Target, axes: tuple[str, ...], router: str, domain: int, namespace: str) -> None:
    """Publish AXES (all of them by default) on joint_states and /diagnostics until SIGTERM or SIGINT; read-only."""
    if not re.fullmatch(r"/|(/[A-Za-z_][A-Za-z0-9_]*)+", namespace):
        raise click.BadParameter(
            "a namespace is / or names behind slashes, such as /lab/stage", param_hint="--namespace"
        )
    target.serve(lambda client, service: _serve_ros2(client, service, axes, router, domain, namespace))


async def _serve_ros2(
    client: RigClient, service: Serving, axes: tuple[str, ...], router: str, domain: int, namespace: str
) -> None:
    from ldcnd.lab.ros2.bridge import run_bridge  # noqa: PLC0415

    rig = Rig(client, await client.daemon())
    check_axes(rig.name, axes, rig.axes)
    endpoint = endpoint_of(router)
    async with open_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
        running = asyncio.create_task(run_bridge(rig, session, axes, domain, namespace), name="bridge")
        on_end(lambda: _cancel(running))
        service.serves(f"rig {rig.name} in ROS domain {domain} through {endpoint}")
        try:
            await running
        except asyncio.CancelledError:
            return


FOXGLOVE_ADDRESS = "127.0.0.1:8765"


@click.command()
@address_option("--address", FOXGLOVE_ADDRESS)
@with_target
def foxglove(target: Target, address: ListenAddress) -> None:
    """Show a rig in Foxglove until SIGTERM or SIGINT; read-only, and open to everyone who can reach the address."""
    target.serve(lambda client, service: _serve_foxglove(client, service, address))


async def _serve_foxglove(client: RigClient, service: Serving, address: ListenAddress) -> None:
    require("foxglove")
    from ldcnd.lab.recording.live_view import LiveView  # noqa: PLC0415 - needs an optional package

    ending = asyncio.Event()
    on_end(ending.set)
    with LiveView(f"ldcnd {client.rig}", address.host, address.port) as view:
        async with client.published(view.take):
            service.serves(f"rig {client.rig} on ws://{address.in_url}:{view.port}")
            await ending.wait()
