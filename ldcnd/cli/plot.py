"""`ldcnd plot`: an axis of a recording as a picture."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ldcnd.cli.figure import save_figure, stacked_rows
from ldcnd.cli.recording_file import EXIT_INCOMPLETE, RECORDING, require_mcap, tell_damages, utc
from ldcnd.cli.typed import NewFile, force_option
from ldcnd.client.trace_file import column_title
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.events import FINAL, CommandEvent, CommandStatus

if TYPE_CHECKING:
    from ldcnd.lab.recording.reading import AxisHistory

NS_PER_S = 1e9
MOST_LABELS = 40
"""Maximum number of event labels; the names of more would overlap."""


@click.command()
@click.argument("recording", type=RECORDING)
@click.argument("axis")
@click.option("--output", "-o", type=NewFile(), required=True, help="Picture to write, such as a PNG.")
@force_option
def command(recording: Path, axis: str, output: Path) -> None:
    """Draw AXIS of RECORDING: its quantities, commands and faults against time; needs the extras record and plot."""
    require_mcap()
    from ldcnd.lab.recording.reading import Recording, axis_history  # noqa: PLC0415 - needs an optional package

    file = Recording(recording)
    history = axis_history(file, axis)
    plot_axis(history, output)
    if history.not_understood:
        click.echo(f"{history.not_understood} messages of another version were left out", err=True)
    if file.damages:
        tell_damages(recording, file.damages)
        sys.exit(EXIT_INCOMPLETE)


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
