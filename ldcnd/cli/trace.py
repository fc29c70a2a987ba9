"""`ldcnd trace`: record an axis against time, and show the result."""

import sys
from datetime import UTC, datetime
from pathlib import Path

import click

from ldcnd.cli.connection import AXIS, Target, of_options, with_target
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.output import end_as_interrupted, show_passing
from ldcnd.cli.sending import Shown, derived_question
from ldcnd.cli.there import axis_of
from ldcnd.cli.typed import Finite, NewFile, WholeNumber, force_option, is_file
from ldcnd.client.rig_client import RigClient
from ldcnd.client.traces import (
    Trace,
    armed_trace,
    column_title,
    fetch_trace,
    load_trace,
    require_suffix,
    save_trace,
    wait_for_trace,
)
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.number_text import NotANumber, read_number
from ldcnd.contract.traces import (
    LONGEST_WAIT_S,
    MOST_SAMPLES,
    AbortTrace,
    TakeTrace,
    TraceAbortReply,
    TraceChannel,
    TraceHeader,
    TraceReply,
    TraceTrigger,
    TriggerKind,
)

UPLOAD_S = 600.0
"""A drive's memory over a busy line takes minutes at worst."""
FASTEST = "fastest"


def _interval(_context: click.Context, _parameter: click.Parameter, value: str) -> float | str:
    if value == FASTEST:
        return FASTEST
    try:
        seconds = read_number(value)
    except NotANumber:
        seconds = 0.0
    if seconds <= 0.0:
        raise click.BadParameter(f"{value!r} is neither seconds nor {FASTEST!r}")
    return seconds


def _trigger(_context: click.Context, _parameter: click.Parameter, value: str | None) -> TraceTrigger | None:
    """Return a trigger that is given as CHANNEL:KIND or CHANNEL:KIND:LEVEL."""
    if value is None:
        return None
    channel, _, rest = value.partition(":")
    kind, _, level = rest.partition(":")
    try:
        return TraceTrigger(channel=channel, kind=TriggerKind(kind), level=read_number(level) if level else None)
    except ValueError:
        kinds = ", ".join(TriggerKind)
        raise click.BadParameter(f"{value!r} is not CHANNEL:KIND:LEVEL with one of {kinds}") from None


def _full_scale(_context: click.Context, _parameter: click.Parameter, values: tuple[str, ...]) -> dict[str, float]:
    """Return full scales that are given as CHANNEL:LARGEST."""
    scales = {}
    for value in values:
        channel, _, largest = value.partition(":")
        try:
            scales[channel] = read_number(largest)
        except ValueError:
            raise click.BadParameter(f"{value!r} is not CHANNEL:LARGEST") from None
    return scales


def _file(_context: click.Context, _parameter: click.Parameter, value: Path | None) -> Path | None:
    return require_suffix(value) if value else None


out_option = click.option("--out", type=NewFile(), callback=_file, help="Write the trace to FILE.csv or FILE.json.")


@click.group(cls=CommandGroup)
def command() -> None:
    """Record an axis against time, and show the result."""


@command.command()
@click.argument("axis", type=AXIS)
@click.option("--channel", "-c", "channels", multiple=True, help="What to record; may be repeated.")
@click.option("--interval", callback=_interval, default=FASTEST, help=f"Seconds between samples [{FASTEST}].")
@click.option("--samples", type=WholeNumber(2, MOST_SAMPLES), default=500, help="How many samples [500].")
@click.option("--pre", type=WholeNumber(0), default=0, help="Number of them before the trigger [0].")
@click.option("--trigger", callback=_trigger, help=f"CHANNEL:KIND:LEVEL; kinds: {', '.join(TriggerKind)}.")
@click.option("--full-scale", multiple=True, callback=_full_scale, help="CHANNEL:LARGEST, to resolve it finer.")
@click.option("--timeout", type=Finite(0, LONGEST_WAIT_S, min_open=True), default=30.0, help="Seconds [30].")
@out_option
@force_option
@with_target
def take(
    target: Target,
    axis: str,
    *,
    channels: tuple[str, ...],
    interval: float | str,
    samples: int,
    pre: int,
    trigger: TraceTrigger | None,
    full_scale: dict[str, float],
    timeout: float,
    out: Path | None,
) -> None:
    """Record channels of AXIS; without any, show which it has. Ctrl-C and SIGTERM end the trace."""
    if not channels:
        info = target.run(lambda client: axis_of(client, axis))
        target.show(info, *info.trace_channels)
        return
    request = of_options(
        TakeTrace,
        channels=channels,
        interval_s=FASTEST if isinstance(interval, str) else interval,
        samples=samples,
        pre_trigger=pre,
        trigger=trigger,
        full_scale=full_scale,
        timeout_s=timeout,
    )

    async def work(client: RigClient) -> Trace:
        async with armed_trace(client, axis, request) as reply:
            print(_granted(reply), file=sys.stderr)
            within_s = timeout + 2 * reply.interval_s * reply.samples + UPLOAD_S
            await wait_for_trace(client, axis, reply.trace_id, within_s, _show_phase)
            show_passing("")
            return await fetch_trace(client, axis, reply.trace_id)

    end_as_interrupted()
    _deliver(target, target.run(work), out)


@command.command()
@click.argument("what", metavar="WHAT", type=AXIS)
@out_option
@force_option
@with_target
def show(target: Target, what: str, out: Path | None) -> None:
    """Tell what is in WHAT: a file, or the last trace of an axis, of any client.

    A name with a dot or a slash is a file.
    """
    trace = load_trace(Path(what)) if is_file(what) else target.run(lambda client: fetch_trace(client, what))
    _deliver(target, trace, out)


def _aborted(reply: TraceAbortReply, _axis: AxisInfo | None) -> Shown:
    yield reply, [f"{reply.axis}: trace ended"]


command.add_command(derived_question("abort", AbortTrace, shows=_aborted))


def _granted(reply: TraceReply) -> str:
    pace = f"every {reply.interval_s * 1e3:g} ms" if reply.interval_s else "as fast as the line allows"
    return f"trace {reply.trace_id}: {reply.samples} samples by the {reply.source}, {pace}"


def _show_phase(header: TraceHeader) -> None:
    share = "" if header.uploaded is None else f" {header.uploaded:.0%}"
    show_passing(f"{header.axis}: {header.phase}{share}")


def _deliver(target: Target, trace: Trace, out: Path | None) -> None:
    if out:
        save_trace(trace, out)
    target.show(trace.header, *_summary(trace))


def _summary(trace: Trace) -> list[str]:
    header, offsets = trace.header, trace.offsets_ns
    taken = datetime.fromtimestamp(header.t / 1e9, UTC).isoformat(timespec="milliseconds")
    lines = [
        f"{header.axis}, trace {header.trace_id}: {len(offsets)} samples by the {header.source}",
        f"time 0 is {taken}, give or take {header.t_error_ns / 1e6:.3f} ms",
        f"from {offsets[0] / 1e6:.3f} ms to {offsets[-1] / 1e6:.3f} ms",
    ]
    if header.trigger and header.trigger_index is not None:
        trigger = header.trigger
        level = "" if trigger.level is None else f" {trigger.level:g}"
        lines.append(f"trigger at sample {header.trigger_index}: {trigger.channel} {trigger.kind}{level}")
    if header.trigger_late_s:
        lines.append(f"the condition was met at most {header.trigger_late_s * 1e3:.1f} ms before")
    lines += [_extremes(channel, column) for channel, column in zip(header.channels, trace.values, strict=True)]
    if header.drive:
        lines.append(f"words taken as {header.drive.word_layout}, {header.drive.byte_order} byte first")
    if header.problem:
        lines.append(f"uncertain: {header.problem}")
    return lines


def _extremes(channel: TraceChannel, column: tuple[float | None, ...]) -> str:
    known = [value for value in column if value is not None]
    title = column_title(channel.name, channel.unit)
    return f"  {title}: {min(known):g} to {max(known):g}" if known else f"  {title}: not known"
