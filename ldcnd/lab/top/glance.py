"""A rig at one moment, as `ldcnd top` shows it and prints it with `--json`."""

from ldcnd.client.overview import AxisSeen
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.troubles import Severity


class Glance(Frozen):
    """The common fields of rows."""

    severity: Severity
    """The severity of the trouble."""
    trouble: str
    """The worst trouble, in words; empty when there is none."""


class AxisGlance(Glance, AxisSeen):
    """One axis; what is not known is null."""

    axis: str
    """Its name."""
    bus: str
    """The line it is on."""
    unit: str
    """Unit of position and target."""
    cause: str
    """What several axes have in common that is wrong, such as their line; empty where the trouble is its own."""
    shown_position: str
    """The position in words: in brackets and with its mark where it does not say where the axis is."""
    shown_state: str
    """The state in words."""
    target: float | None
    """Where its command ends."""
    adc_volts: float | None
    """Its analog input."""
    rate_hz: float | None
    """How often the position came in the last second."""
    rate_wanted_hz: float | None
    """The configured rate."""
    control: str | None
    """Who controls or moves it, in words; null where that is not known."""


class ModuleGlance(Glance):
    """One I/O module that has a name."""

    module: str
    """Its name."""
    bus: str
    """The line it is on."""
    cause: str
    """As that of an axis."""
    shown_state: str
    """Whether it answers, in words."""


class BusGlance(Glance):
    """One line."""

    bus: str
    """Its name."""
    cause: str
    """As that of the axes that it concerns."""
    up: bool
    """Its drives are polled."""
    utilisation: float
    """Share of the last second for which bytes were on the wire."""
    exchanges_per_s: float | None
    """Requests in a second; null before the second report."""
    errors: int
    """Exchanges that brought nothing to be trusted, since the daemon started."""
    resent: int
    """Exchanges sent again, since then."""
    poll_p99_s: float | None
    """99 % of its polls ended within this time after they were due, seconds."""
    stop_longest_s: float | None
    """The longest that a stop has taken."""


class RigGlance(Frozen):
    """A rig; axes and lines with the highest severity come first."""

    rig: str
    """Its name."""
    version: str | None
    """Of its daemon; null when none answers."""
    trouble: str
    """Troubles of the rig as a whole; empty when there are none."""
    attention: tuple[str, ...] = ()
    """What is to be seen to of the daemon itself, though it works."""
    axes: tuple[AxisGlance, ...]
    """All of them."""
    buses: tuple[BusGlance, ...]
    """All of them."""
    modules: tuple[ModuleGlance, ...] = ()
    """All of them that have a name."""

    def count(self, severity: Severity) -> str:
        """Return what has this severity, in words; empty where nothing has.

        Everything is counted, and the causes where they are fewer: several axes may have one in common.
        """
        axes = [row.cause or f"axis {row.axis}" for row in self.axes if row.severity is severity]
        modules = [row.cause or f"module {row.module}" for row in self.modules if row.severity is severity]
        lines = [row.cause for row in self.buses if row.severity is severity]
        kinds = (("axis", "axes", axes), ("module", "modules", modules), ("line", "lines", lines))
        parts = [f"{len(found)} {one if len(found) == 1 else many}" for one, many, found in kinds if found]
        causes = len({*axes, *modules, *lines})
        fewer = causes < len(axes) + len(modules) + len(lines)
        return ", ".join(parts) + (f" ({causes} cause{'s' if causes > 1 else ''})" if fewer else "")
