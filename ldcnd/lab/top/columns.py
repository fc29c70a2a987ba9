"""The words in which a glance is shown: one table of axes, one of lines."""

from ldcnd.contract.samples import Moving
from ldcnd.contract.troubles import Severity
from ldcnd.lab.top.glance import AxisGlance, BusGlance, ModuleGlance, RigGlance

UNKNOWN = "-"
MARKS = {Severity.FINE: " ", Severity.NOTICE: "!", Severity.WRONG: "X"}
"""A mark beside the colour, readable without telling colours apart."""

AXIS_TITLES = ("", "bus", "axis", "state", "position", "trouble", "velocity", "target", "A/D", "age", "rate", "control")
NARROW = (0, 2, 3, 4, 5, 11)
"""Which of them a narrow terminal shows: that control and trouble can be seen comes before rates and ages."""
BUS_TITLES = ("", "bus", "line", "busy", "exchanges", "errors", "resent", "poll p99", "stop max", "trouble")


def narrow_cells(row: AxisGlance) -> tuple[str, ...]:
    """Return the cells of an axis that a narrow terminal shows: what its trouble says its state does not say again."""
    cells = axis_cells(row)
    return tuple(
        cells[column].partition(", ")[0] if AXIS_TITLES[column] == "state" else cells[column] for column in NARROW
    )


def axis_cells(row: AxisGlance) -> tuple[str, ...]:
    """Return the cells of an axis, one for each of `AXIS_TITLES`."""
    rate = UNKNOWN if row.rate_hz is None else f"{row.rate_hz:.0f}/{row.rate_wanted_hz:.0f} Hz"
    return (
        MARKS[row.severity],
        row.bus,
        row.axis,
        row.shown_state,
        row.shown_position,
        row.trouble,
        UNKNOWN if row.moving is Moving.UNKNOWN else row.shown_velocity or UNKNOWN,
        UNKNOWN if row.target is None else f"{row.target:.3f}",
        UNKNOWN if row.adc_volts is None else f"{row.adc_volts:.2f} V",
        UNKNOWN if row.age_s is None else f"{row.age_s:.1f} s",
        rate,
        row.control or UNKNOWN,
    )


def bus_cells(row: BusGlance) -> tuple[str, ...]:
    """Return the cells of a line, one for each of `BUS_TITLES`."""
    return (
        MARKS[row.severity],
        row.bus,
        "up" if row.up else "down",
        f"{row.utilisation:.0%}" if row.up else UNKNOWN,
        UNKNOWN if row.exchanges_per_s is None else f"{row.exchanges_per_s:.0f}/s",
        str(row.errors),
        str(row.resent),
        UNKNOWN if row.poll_p99_s is None else f"{row.poll_p99_s * 1e3:.1f} ms",
        UNKNOWN if row.stop_longest_s is None else f"{row.stop_longest_s * 1e3:.1f} ms",
        row.trouble,
    )


def module_cells(row: ModuleGlance) -> tuple[str, ...]:
    """Return the cells of an I/O module, in the table of its line."""
    return (MARKS[row.severity], row.module, row.shown_state, *([UNKNOWN] * 6), row.trouble)


def line_rows(glance: RigGlance) -> list[tuple[tuple[str, ...], Severity]]:
    """Return the rows of the table of lines, each with its severity: every line, and every I/O module."""
    lines = [(bus_cells(row), row.severity) for row in glance.buses]
    return lines + [(module_cells(row), row.severity) for row in glance.modules]


def headline(glance: RigGlance) -> str:
    """Return the rig in one line: who it is, and how much of it is wrong."""
    version = f"ldcnd {glance.version}" if glance.version else "no daemon"
    count = f"axes: {len(glance.axes)}, lines: {len(glance.buses)}"
    return "  ·  ".join((glance.rig, version, count, _verdict(glance), *glance.attention))


def _verdict(glance: RigGlance) -> str:
    if glance.trouble:
        return glance.trouble
    if wrong := glance.count(Severity.WRONG):
        return f"not working: {wrong}"
    if notices := glance.count(Severity.NOTICE):
        return f"notices: {notices}"
    return "nothing is wrong"


def as_text(glance: RigGlance) -> tuple[str, ...]:
    """Return everything as lines of plain text, for a terminal that is none."""
    axes = _table(AXIS_TITLES, [axis_cells(row) for row in glance.axes])
    buses = _table(BUS_TITLES, [cells for cells, _ in line_rows(glance)])
    return (headline(glance), "", *axes, "", *buses)


def _table(titles: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in (titles, *rows)
    ]
