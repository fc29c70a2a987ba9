"""Drawing a trace."""

from pathlib import Path

from ldcnd.cli.figure import save_figure, stacked_rows
from ldcnd.client.trace_file import column_title
from ldcnd.client.traces import Trace

NS_PER_MS = 1e6


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
            axes.axhline(header.trigger.level, color="tab:red", linewidth=0.8, linestyle=":")
    rows[-1].set_xlabel("ms")
    figure.suptitle(f"{header.axis}, trace {header.trace_id}" + (f"\n{header.problem}" if header.problem else ""))
    save_figure(figure, path)
