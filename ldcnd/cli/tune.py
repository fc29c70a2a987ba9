"""`ldcnd tune`: gains for an axis, as the family of its drive finds them."""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.typed import Finite, axis_of
from ldcnd.client.kept_gains import KeptGains, file_of, kept_for
from ldcnd.client.kept_gains import put_back as put_back_gains
from ldcnd.client.lease import program_name
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import NotSupported, WrongState
from ldcnd.drives.known import FAMILIES


@dataclass(frozen=True, slots=True)
class TuneOptions:
    """What was typed; a family refuses what means nothing to its drives.

    Attributes:
        bandwidth_hz: wanted crossover of the loop.
        within: distance from where the axis stands, in its unit.
        values: parameters to try, as `NAME=VALUE`.
        record_s: duration of a record of a motion, seconds.
        plot: picture to be drawn.
        dry_run: only say what would be done.
        yes: do not ask.
    """

    bandwidth_hz: float | None
    within: float | None
    values: tuple[str, ...]
    record_s: float | None
    plot: Path | None
    dry_run: bool
    yes: bool

    def refuse(self, why: str, *names: str) -> None:
        """Refuse options that were typed.

        Raises:
            click.BadParameter: one of them was; says why it means nothing.
        """
        options = {"bandwidth_hz": "--bandwidth", "within": "--within", "values": "--set", "record_s": "--record"}
        for name in names:
            if getattr(self, name):
                raise click.BadParameter(why, param_hint=options.get(name, f"--{name}"))


@click.command()
@click.argument("axis", type=AXIS)
@click.option(
    "--bandwidth",
    "bandwidth_hz",
    type=Finite(1, 200),
    help="Wanted crossover of the loop, Hz; that which settles soonest when missing.",
)
@click.option(
    "--within",
    type=Finite(0, min_open=True),
    help="Stay within this distance of where the axis stands, in its unit; 2000 counts when missing.",
)
@click.option(
    "--set",
    "values",
    multiple=True,
    metavar="NAME=VALUE",
    help="Try this value of a parameter (drives whose gains are parameters).",
)
@click.option(
    "--record",
    "record_s",
    type=Finite(0.5, 60),
    help="Duration of a record of a motion, seconds (drives whose gains are parameters); 2 when missing.",
)
@click.option("--dry-run", is_flag=True, help="Say what it would do, and do nothing.")
@click.option("--yes", is_flag=True, help="Do not ask before moving, nor before applying.")
@click.option(
    "--plot",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Draw the test moves, measured beside predicted, to a picture such as a PNG; needs the extra `plot`.",
)
@click.option("--put-back", is_flag=True, help="Put back the gains that a tuning has left behind that was cut short.")
@with_target
def command(
    target: Target,
    axis: str,
    bandwidth_hz: float | None,
    within: float | None,
    values: tuple[str, ...],
    record_s: float | None,
    plot: Path | None,
    *,
    dry_run: bool,
    yes: bool,
    put_back: bool,
) -> None:
    """Find gains for AXIS: move it a little, identify it, propose, apply, verify.

    An axis whose gains are registers must be off and stay where it is then. It is off afterwards. What it will do is
    said before it moves; it moves within the stated distance only. The old gains come back at Ctrl-C, on any fault, and
    when the new ones are not better; if this program or its host dies, --put-back restores them. It needs the extra
    `tune`.

    A drive that tunes itself shows its auto-tuning and its gains. Those of --set are tried in its RAM, with a record of
    a move before and after; the moves come from the machine.
    """
    info = target.run(lambda client: axis_of(client, axis))
    if put_back:
        kept = target.run(lambda client: _put_back(client, axis))
        gains = ", ".join(f"{name} = {value}" for name, value in kept.gains.items())
        how = "off, with its old gains" if kept.are_registers else "its old gains are in RAM"
        target.show(kept, f"{axis}: {how}: {gains}")
        return
    family = FAMILIES.get(info.family)
    if family is None or family.tuning is None:
        raise NotSupported(f"axis {axis}: nothing is known here of tuning a {info.model}", axis=axis)
    tune = import_module(family.tuning.command).tune
    tune(target, info, TuneOptions(bandwidth_hz, within, values, record_s, plot, dry_run, yes))


async def _put_back(client: RigClient, axis: str) -> KeptGains:
    rig = Rig(client, await client.daemon())
    kept = kept_for(rig.name, axis)
    if kept is None:
        raise WrongState(
            f"axis {axis}: no gains of an unfinished tuning are kept on this host ({file_of(rig.name, axis)})",
            axis=axis,
            remedy="type it on the host that tuned; or restart the daemon, which loads the configured gains",
        )
    await put_back_gains(rig, kept, program_name("ldcnd tune"))
    return kept
