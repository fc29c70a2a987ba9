"""`ldcnd bus replay`: play a capture to a daemon in this process; no port, no network."""

import asyncio
from pathlib import Path

import click

from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.codec import decode_received
from ldcnd.contract.events import CommandEvent
from ldcnd.contract.keys import EVENT
from ldcnd.contract.samples import FaultSample, TelemetryItem
from ldcnd.daemon.replay import Played, Take, config_of, play, published_line, virtual_time
from ldcnd.line.capture import Capture, CaptureHeader, parse_capture
from ldcnd.log import configure_logging
from ldcnd.net.session import Sample

FILE = click.Path(path_type=Path, exists=True, dir_okay=False)


@click.command("replay")
@click.argument("capture", type=FILE)
@click.option("--config", type=FILE, help="The rig's configuration, instead of the one in the capture.")
@click.option("--real-time", is_flag=True, help="Take as long as it took then, instead of no time.")
@click.option("--json", "as_json", is_flag=True, help="Print all that is published, as JSON lines, and nothing else.")
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"]),
    default="error",
    show_default=True,
    help="Log nothing below this.",
)
def command(capture: Path, config: Path | None, *, real_time: bool, as_json: bool, log_level: str) -> None:
    """Play CAPTURE, the text of a wire log, to drivers and daemon, and show the events and faults that come of it.

    It begins when the daemon was started, with its configuration and the commands that clients gave it. Exit code 1,
    and the packet, when the daemon sends something else than it sent then.
    """
    configure_logging(level=log_level)
    played_back = parse_capture(capture.read_text(encoding="utf-8"))
    rig = config_of(played_back.header, load_config(config) if config else None)

    story = Story(played_back.header)

    def show(sample: Sample) -> None:
        if as_json:
            click.echo(published_line(sample))
        elif told := story.tell(sample):
            click.echo(told)

    played = _run(played_back, rig, show, real_time=real_time)
    if not as_json:
        click.echo(f"{played.packets} packets as they were, {played.commands} commands, to the end")


def _run(capture: Capture, rig: RigConfig, show: Take, *, real_time: bool) -> Played:
    with asyncio.Runner(loop_factory=None if real_time else lambda: virtual_time(capture)) as runner:
        return runner.run(play(capture, rig, show))


class Story:
    """Tells events, and faults when they change, in seconds since the daemon was started."""

    def __init__(self, header: CaptureHeader) -> None:
        self._started_ns = header.zero_ns + round(header.started_s * 1e9)
        self._faults: dict[str, str] = {}

    def tell(self, sample: Sample) -> str:
        """Return one line about a sample; empty when it is nothing new."""
        axis, _, item = sample.key.partition("/tele/")[2].partition("/")
        if item == EVENT:
            event = decode_received(CommandEvent, sample.payload, sample.encoding)
            told = f"{event.verb} {event.status}{f': {event.reason}' if event.reason else ''}"
            return f"{self._since_s(event.t):.6f} {axis} {told}"
        if item != TelemetryItem.FAULT:
            return ""
        faults = decode_received(FaultSample, sample.payload, sample.encoding)
        told = ", ".join(f"{fault.code} ({fault.text})" for fault in faults.active) or "no faults"
        if self._faults.get(axis, "no faults") == told:
            return ""
        self._faults[axis] = told
        return f"{self._since_s(faults.t):.6f} {axis} {told}"

    def _since_s(self, t_ns: int) -> float:
        return (t_ns - self._started_ns) / 1e9
