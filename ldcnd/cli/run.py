"""`ldcnd run`, the daemon in the foreground."""

import asyncio
import contextlib
import json
import shlex
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator, Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import click

from ldcnd.cli.output import Terminal, show_lines
from ldcnd.cli.typed import CONFIGURATION, CONSOLE_ADDRESS, parsed_address
from ldcnd.config.plan import require_plan
from ldcnd.config.rig import RigConfig, example, load_config, single_line
from ldcnd.contract.frozen import build_models
from ldcnd.daemon.assembly import open_daemon
from ldcnd.daemon.daemon import Daemon
from ldcnd.daemon.service import (
    Service,
    held_awake,
    last_words,
    loop_factory,
    require_writable,
    settle_heap,
    state_held,
)
from ldcnd.line.tasks import GuardedGroup
from ldcnd.listen_address import ListenAddress, parse_listen_address
from ldcnd.log import configure_logging, get_logger
from ldcnd.net.zenoh_settings import DEFAULT_ENDPOINT, reached_at
from ldcnd.net.zenoh_threads import senders_wait
from ldcnd.systemd import Notifier

LINK_S = 20.0
"""Longest time that the console takes to print its link."""
END_S = 5.0


async def show_first_steps(daemon: Daemon, rig: RigConfig, address: ListenAddress) -> None:
    """Wait until the lines are up, serve the console, say what to type next; until cancelled.

    Args:
        daemon: the daemon that starts.
        rig: its configuration.
        address: where the console serves.
    """
    endpoint = reached_at(rig.zenoh.listen)
    await daemon.wait_up()
    async with _console(endpoint, address) as link:
        show_lines(*first_steps(rig, endpoint, link))
        await asyncio.Event().wait()


def first_steps(rig: RigConfig, endpoint: str, link: str | None) -> list[str]:
    """Return the lines that a newcomer reads."""
    axes = [axis for bus in rig.bus for axis in bus.axis]
    program = _program()
    at = "" if endpoint == DEFAULT_ENDPOINT else f" -e {shlex.quote(endpoint)}"
    lines = ["", f"Rig {rig.rig} is up: {', '.join(axis.name for axis in axes)}. Nothing moves unless you ask for it."]
    lines += ["In a second terminal:", f"  {program} list{at}"]
    if movable := next((axis.name for axis in axes if axis.reference == "at_reset"), None):
        lines += [f"  {program} power on {movable}{at}", f"  {program} move {movable} 10 --wait{at}"]
    lines += [f"  {program} stop{at}    # at any time; software, not an emergency stop"]
    lines += [f"In a browser, within ten minutes: {link}"] if link else ["No console serves; `ldcnd console` says why."]
    return [*lines, "Ctrl-C here ends it; what moves is brought to rest first.", ""]


def _program() -> str:
    """Return how this program was called, so that what is printed can be typed."""
    called = Path(sys.argv[0])
    with contextlib.suppress(ValueError):
        return str(called.resolve().relative_to(Path.cwd())) if called.name == "ldcnd" else "ldcnd"
    return "ldcnd"


@contextlib.asynccontextmanager
async def _console(endpoint: str, address: ListenAddress) -> AsyncIterator[str | None]:
    """Run a console until the context ends; with its link, or None when it does not serve: the daemon goes on."""
    words = ("-m", "ldcnd", "console", "--json", "-e", endpoint, "--listen", f"{address.in_url}:{address.port}")
    try:
        # the pipe ends with this process, however that ends, and the console with the pipe
        console = await asyncio.create_subprocess_exec(sys.executable, *words, "--with-input", stdin=PIPE, stdout=PIPE)
    except OSError:
        yield None
        return
    try:
        yield await _link(console)
    finally:
        with contextlib.suppress(ProcessLookupError):
            console.terminate()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(END_S):
                await console.wait()


async def _link(console: Process) -> str | None:
    assert console.stdout  # noqa: S101 - it is piped
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LINK_S):
            if line := await console.stdout.readline():
                return str(json.loads(line)["link"])
    return None


log = get_logger("run")


@click.command()
@click.option(
    "--config",
    type=CONFIGURATION,
    help="The rig's configuration (TOML); without one, a terminal is asked whether a simulated rig will do.",
)
@click.option("--listen", "-l", multiple=True, help="Listen here instead of the configured endpoints; may be repeated.")
@click.option("--connect", "-e", multiple=True, help="Connect here too; may be repeated.")
@click.option("--bus", help="Serve this line only, as the rig RIG_BUS: one process for each line.")
@click.option(
    "--console",
    is_flag=False,
    flag_value=CONSOLE_ADDRESS,
    metavar="[HOST:PORT]",
    callback=parsed_address,
    help=f"Serve the console beside it, at {CONSOLE_ADDRESS} unless said otherwise, and say what to type next.",
)
@click.option("--log-json", is_flag=True, help="Log JSON lines instead of text.")
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"]),
    default="info",
    show_default=True,
    help="Log nothing below this.",
)
def command(
    config: Path | None,
    listen: tuple[str, ...],
    connect: tuple[str, ...],
    bus: str | None,
    console: ListenAddress | None,
    *,
    log_json: bool,
    log_level: str,
) -> None:
    """Own the lines of a rig and serve its drives until SIGTERM or SIGINT; moving axes are stopped first.

    SIGHUP reads CONFIG again: limits, default speeds and rates change at once, the log names what needs a restart. When
    the terminal on which it was started is closed, the daemon ends as at SIGTERM.
    Options, the log level among them, keep their values.
    """
    configure_logging(json=log_json, level=log_level)
    file = config or _simulated()
    if config is None and console is None and find_spec("starlette"):
        console = parse_listen_address(CONSOLE_ADDRESS)

    def load() -> RigConfig:
        rig = load_config(file)
        if bus:
            rig = single_line(rig, bus)
        require_plan(rig)
        zenoh = rig.zenoh.model_copy(
            update={"listen": listen or rig.zenoh.listen, "connect": (*rig.zenoh.connect, *connect)}
        )
        return rig.model_copy(update={"zenoh": zenoh})

    rig = load()
    require_writable(rig)
    with (
        state_held(rig),
        held_awake(wanted=rig.daemon.hold_cpu_awake),
        asyncio.Runner(loop_factory=loop_factory(uvloop=rig.daemon.uvloop)) as runner,
    ):
        runner.run(serve(rig, load, console))


def _simulated() -> Path:
    """Return the configuration of the simulated rig, if that is agreed to at the terminal.

    Raises:
        click.UsageError: it is not, or there is no terminal; says what to type.
    """
    simulated = example("simulated.toml")
    if sys.stdin.isatty() and sys.stdout.isatty():
        click.echo(
            "No configuration is given (--config). A rig of four simulated drives needs none, and moves nothing."
        )
        if click.confirm("Run it?", default=True):
            return simulated
    raise click.UsageError(
        f"name the configuration of a rig: --config rig.toml. {shlex.quote(str(simulated))} is that of a simulated one;"
        " `ldcnd scan PORT --write rig.toml` begins that of your drives"
    )


async def serve(rig: RigConfig, load: Callable[[], RigConfig], console: ListenAddress | None = None) -> None:
    """Serve one rig until a signal ends it; SIGHUP has its configuration read again."""
    async with open_daemon(rig) as daemon:
        service = Service(daemon, Notifier(), load)
        terminal = Terminal()

        def hang_up() -> None:
            (service.end if terminal.has_gone else service.reload)()

        handlers = {signal.SIGTERM: service.end, signal.SIGINT: service.end, signal.SIGHUP: hang_up}
        loop = asyncio.get_running_loop()
        for number, handler in handlers.items():
            loop.add_signal_handler(number, handler)
        build_models()
        settle_heap()
        try:
            with last_words(partial(write_captures, daemon)):
                async with GuardedGroup(daemon.guarded) as group:
                    beside = [group.create_task(senders_wait(), name="senders wait")]
                    if console:
                        beside.append(group.create_task(show_first_steps(daemon, rig, console), name="console"))
                    try:
                        await service.run()
                    finally:
                        for task in beside:
                            task.cancel()
        finally:
            for number in handlers:
                loop.remove_signal_handler(number)


def write_captures(daemon: Daemon) -> None:
    """Leave behind what was on the lines, where there is a place for it."""
    if daemon.captures:
        daemon.captures.write_all("aborted, as by a watchdog")
