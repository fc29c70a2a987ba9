"""Commands on recordings: make, recover, convert and draw them."""

import errno
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ldcnd.cli.connection import Serving, Target, with_target
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.output import on_end
from ldcnd.cli.quantities import save_figure, stacked_rows
from ldcnd.cli.typed import NewFile, WholeNumber, force_option
from ldcnd.client.rig_client import RigClient
from ldcnd.client.traces import SUFFIXES as TRACES
from ldcnd.client.traces import Trace, column_title, load_trace
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.events import FINAL, CommandEvent, CommandStatus
from ldcnd.contract.history import AxisInstant, time_of
from ldcnd.contract.meta import AxisInfo
from ldcnd.parts import require

if TYPE_CHECKING:
    from ldcnd.lab.recording.reading import AxisHistory


RECORDING = click.Path(path_type=Path, exists=True, dir_okay=False)
EXIT_INCOMPLETE = 1
"""The recording is damaged; what could be read of it was used."""


@contextmanager
def a_failure() -> Iterator[None]:
    """Let a recording that cannot be read or written be a failure, not a configuration that cannot work."""
    try:
        yield
    except ConfigError as error:
        raise click.ClickException("\n  ".join(filter(None, [error.message, error.remedy]))) from error


def tell_damages(path: Path, damages: Sequence[object]) -> None:
    """Say what cannot be read of a recording."""
    for damage in damages:
        click.echo(f"{path}, {damage}", err=True)


def utc(t_ns: int) -> str:
    """Return an instant for people."""
    return datetime.fromtimestamp(t_ns / 1e9, UTC).isoformat(timespec="milliseconds")


FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
FILE = click.Path(path_type=Path, dir_okay=False)


@click.group(cls=CommandGroup, invoke_without_command=True)
@click.option(
    "--out",
    "-o",
    type=FILE,
    help="The file to write, NAME.mcap; strftime codes stand for the start in UTC: run-%Y%m%d-%H%M%S.mcap, %% for %.",
)
@click.option("--rotate-mb", type=WholeNumber(1), default=250, show_default=True, help="Begin a new file then.")
@with_target
def record(target: Target, out: Path | None, rotate_mb: int) -> None:
    """Record everything that a rig publishes until SIGTERM or SIGINT; a killed recorder loses one second at most."""
    if click.get_current_context().invoked_subcommand:
        return
    if out is None:
        raise click.UsageError("--out is missing")
    require("mcap")
    out = dated(out, datetime.now(UTC))
    target.serve(lambda client, service: _record(client, service, out, rotate_mb * 1_000_000))


@record.command("recover")
@click.argument("damaged", type=RECORDING)
@click.argument("whole", type=FILE)
def recover_file(damaged: Path, whole: Path) -> None:
    """Copy what can be read of DAMAGED, such as NAME.mcap.part after a power cut, into WHOLE."""
    require("mcap")
    from ldcnd.lab.recording.recovery import recover  # noqa: PLC0415 - needs an optional package

    with a_failure():
        saved = recover(damaged, whole)
    tell_damages(damaged, saved.damages)
    until = f", the last of {utc(saved.last_ns)}" if saved.messages else ""
    click.echo(f"{saved.messages} messages recovered{until}; {saved.losses.missing.total()} missing in between")


@record.command("export")
@click.argument("recording", type=RECORDING)
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@click.option("--parquet", is_flag=True, help="Parquet files instead of CSV.")
def export(recording: Path, folder: Path, parquet: bool) -> None:  # noqa: FBT001 - click's
    """Write RECORDING into FOLDER as CSV: a table for each topic, a row for each message, a column for each value."""
    require("mcap", *(["pyarrow"] if parquet else []))
    from ldcnd.lab.recording.tables import export_tables  # noqa: PLC0415 - needs an optional package

    with a_failure():
        done = export_tables(recording, folder, parquet=parquet)
    click.echo(f"{done.rows} messages in {len(done.tables)} tables in {folder}")
    if done.damages:
        tell_damages(recording, done.damages)
        sys.exit(EXIT_INCOMPLETE)


def recorded(path: Path, axis: str, said: str) -> tuple[list[AxisInstant], AxisInfo]:
    """Return where an axis was by a recording, for `ldcnd axis at`.

    Args:
        path: the recording.
        axis: its name.
        said: an instant or a range, as the daemon takes it.
    """
    require("mcap")
    from ldcnd.lab.recording.instants import recorded_readings  # noqa: PLC0415 - needs an optional package
    from ldcnd.lab.recording.reading import Recording  # noqa: PLC0415
    from ldcnd.lab.recording.recorder import following  # noqa: PLC0415

    file = Recording(path)
    t, until = time_of(said, time.time_ns())
    with a_failure():
        found = recorded_readings(file, axis)
    tell_damages(path, file.damages)
    later = following(path) if found.ends_before(until) else None
    if later:
        click.echo(f"{path} ends before that; the recording goes on in {later}", err=True)
    return [found.at(t)] if t == until else list(found.between(t, until)), found.info


def dated(pattern: Path, start: datetime) -> Path:
    """Return a path with the start of the recording in the place of its strftime codes; files after it have numbers."""
    return Path(start.strftime(str(pattern)))


async def _record(client: RigClient, service: Serving, out: Path, rotate_bytes: int) -> None:
    from ldcnd.lab.recording.recorder import KEPT_SAMPLES, LINGER_S, Recorder  # noqa: PLC0415 - needs an optional package

    def tell(path: Path) -> None:
        click.echo(f"the daemon was restarted with another configuration: recording goes on in {path}", err=True)

    descriptions = await client.descriptions()
    path = out
    try:
        recorder = Recorder(out, descriptions, time.time_ns, rotate_bytes, client.descriptions, tell)
        on_end(recorder.end)
        try:
            with recorder:
                async with client.published(recorder.take, KEPT_SAMPLES, LINGER_S) as gave_way:
                    service.serves(f"recording rig {client.rig} to {out}", err=True)
                    await recorder.run(gave_way)
        finally:
            path = recorder.path
            click.echo(recorder.summary, err=True)  # only now: until the subscriptions are gone, more is recorded
    except OSError as error:
        raise click.ClickException(_not_written(path, error)) from error


def _not_written(path: Path, error: OSError) -> str:
    """Return in words that a recording cannot be written, and what to do; a full disk has no name in its error."""
    room = f"; make room in {path.absolute().parent}: recordings stay there until they are deleted"
    return f"{error.filename or path}: cannot be written: {error.strerror}{room if error.errno in FULL else ''}"


NS_PER_S = 1e9
NS_PER_MS = 1e6
MOST_LABELS = 40
"""Maximum number of event labels; the names of more would overlap."""


@click.command()
@click.argument("file", type=RECORDING)
@click.argument("axis", required=False)
@click.option("--output", "-o", type=NewFile(), required=True, help="Picture to write, such as a PNG.")
@force_option
def plot(file: Path, axis: str | None, output: Path) -> None:
    """Draw FILE, a trace, or AXIS of a recording: quantities, commands and faults against time.

    Needs the extra plot, and for recordings record.
    """
    if file.suffix in TRACES:
        trace = load_trace(file)
        if axis not in {None, trace.header.axis}:
            raise click.UsageError(f"{file} is a trace of axis {trace.header.axis}, not of {axis}")
        plot_trace(trace, output)
        return
    if axis is None:
        raise click.UsageError(f"name the axis to draw of the recording {file}")
    require("mcap")
    from ldcnd.lab.recording.reading import Recording, axis_history  # noqa: PLC0415 - needs an optional package

    recording = Recording(file)
    with a_failure():
        history = axis_history(recording, axis)
    plot_axis(history, output)
    if history.not_understood:
        click.echo(f"{history.not_understood} messages of another version were left out", err=True)
    if recording.damages:
        tell_damages(file, recording.damages)
        sys.exit(EXIT_INCOMPLETE)


def plot_trace(trace: Trace, path: Path) -> None:
    """Draw every channel above the others, against the time from the trigger or the first sample.

    Raises:
        ConfigError: matplotlib is missing, or the file cannot be written.
    """
    header = trace.header
    figure, rows = stacked_rows(len(header.channels))
    times_ms = [offset / NS_PER_MS for offset in trace.offsets_ns]
    for axes, channel, column in zip(rows, header.channels, trace.values, strict=True):
        values = [float("nan") if value is None else value for value in column]
        signal = not channel.unit
        axes.plot(times_ms, values, linewidth=1.0, drawstyle="steps-post" if signal else "default")
        axes.set_ylabel(column_title(channel.name, channel.unit).replace(" [", "\n["))
        if header.trigger_index is not None:
            axes.axvline(0.0, color="tab:red", linewidth=0.8)
        if header.trigger and header.trigger.channel == channel.name and not signal:
            axes.axhline(header.trigger.level or 0.0, color="tab:red", linewidth=0.8, linestyle=":")
    rows[-1].set_xlabel("ms")
    figure.suptitle(f"{header.axis}, trace {header.trace_id}" + (f"\n{header.problem}" if header.problem else ""))
    save_figure(figure, path)


def plot_axis(history: "AxisHistory", path: Path) -> None:
    """Draw each quantity above the next, commands as lines and faults as shades across all of them.

    Raises:
        ConfigError: matplotlib is missing, there is nothing to draw, or the file cannot be written.
    """
    if not history.series:
        raise ConfigError(f"axis {history.axis}: the recording has no value of it", value=history.axis)
    first_ns = min(series.t_ns[0] for series in history.series)
    last_ns = max(series.t_ns[-1] for series in history.series)

    def seconds(t_ns: int) -> float:
        return (t_ns - first_ns) / NS_PER_S

    figure, rows = stacked_rows(len(history.series))
    for axes, series in zip(rows, history.series, strict=True):
        axes.plot([seconds(t_ns) for t_ns in series.t_ns], series.values, linewidth=1.0)
        axes.set_ylabel(column_title(series.title, series.unit).replace(" [", "\n["))
        for since_ns, until_ns in history.faults:
            end_ns = last_ns if until_ns is None else until_ns
            axes.axvspan(seconds(since_ns), seconds(end_ns), color="tab:red", alpha=0.15, linewidth=0)
    marks = list(_marks(history.events))
    for event in marks:
        at_s = seconds(event.t)
        colour = "tab:green" if event.status in {CommandStatus.ACCEPTED, CommandStatus.DONE} else "tab:red"
        for axes in rows:
            axes.axvline(at_s, color=colour, linewidth=0.6, linestyle=":")
        if len(marks) <= MOST_LABELS:
            label = f" {event.verb} {event.status}"
            rows[0].annotate(
                label, (at_s, 1.0), xycoords=("data", "axes fraction"), rotation=90, fontsize=6, ha="right", va="top"
            )
    rows[-1].set_xlabel("s")
    figure.suptitle(f"{history.axis}, from {utc(first_ns)}")
    save_figure(figure, path)


def _marks(events: list[CommandEvent]) -> Iterator[CommandEvent]:
    """Leave out what lies between the beginning of a command and its end."""
    for event in events:
        if event.status is CommandStatus.ACCEPTED or event.status in FINAL:
            yield event
