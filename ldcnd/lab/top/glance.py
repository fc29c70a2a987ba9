"""A rig at one moment, as `ldcnd top` shows it and prints it with `--json`."""

from ldcnd.client.overview import AxisSeen
from ldcnd.contract.condition import Severity
from ldcnd.contract.frozen import Frozen


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
    """Unit of position and target; velocity is a second of it."""
    cause: str
    """What several axes have in common that is wrong, such as their line; empty where the trouble is its own."""
    shown_position: str
    """The position in words: in brackets and with its mark where it does not say where the axis is."""
    shown_state: str
    """The state in words."""
    velocity: float | None
    """How fast it moves."""
    shown_velocity: str
    """The same in the unit that is configured for velocities; empty while it is not known."""
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
    axes: tuple[AxisGlance, ...]
    """All of them."""
    buses: tuple[BusGlance, ...]
    """All of them."""

    def count(self, severity: Severity) -> int:
        """Return how many causes have this severity: what several axes have in common counts once."""
        causes = {row.cause or f"{row.axis}: {row.trouble}" for row in self.axes if row.severity is severity}
        return len(causes | {row.cause for row in self.buses if row.severity is severity})
