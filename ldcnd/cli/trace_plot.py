"""Drawing a trace; the only place that knows matplotlib, which is an extra."""

import importlib
from pathlib import Path
from types import ModuleType

from ldcnd.cli.trace_file import column_title
from ldcnd.client.traces import Trace
from ldcnd.errors import ConfigError

WIDTH_IN = 10.0
ROW_IN = 2.2
DOTS_PER_INCH = 120
NS_PER_MS = 1e6


def plot_trace(trace: Trace, path: Path) -> None:
    """Draw every channel above the others, against the time from the trigger or the first sample.

    Raises:
        ConfigError: matplotlib is missing, or the file cannot be written.
    """
    header = trace.header
    # a module by name: the extra is not there where types are checked
    figure = _matplotlib("matplotlib.figure").Figure(
        figsize=(WIDTH_IN, 1.0 + ROW_IN * len(header.channels)), dpi=DOTS_PER_INCH, layout="constrained"
    )
    rows = figure.subplots(len(header.channels), 1, sharex=True, squeeze=False)
    times_ms = [offset / NS_PER_MS for offset in trace.offsets_ns]
    for (axes,), channel, column in zip(rows, header.channels, trace.values, strict=True):
        values = [float("nan") if value is None else value for value in column]
        signal = not channel.unit
        axes.plot(times_ms, values, linewidth=1.0, drawstyle="steps-post" if signal else "default")
        axes.set_ylabel(column_title(channel.name, channel.unit).replace(" [", "\n["))
        axes.grid(visible=True, alpha=0.3)
        if header.trigger_index is not None:
            axes.axvline(0.0, color="tab:red", linewidth=0.8)
        if header.trigger and header.trigger.channel == channel.name and not signal:
            axes.axhline(header.trigger.level, color="tab:red", linewidth=0.8, linestyle=":")
    rows[-1][0].set_xlabel("ms")
    figure.suptitle(f"{header.axis}, trace {header.trace_id}" + (f"\n{header.problem}" if header.problem else ""))
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be drawn: {error}") from error


def _matplotlib(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(
            "plotting needs matplotlib; install it with: pip install 'ldcnd[plot]'",
        ) from error
