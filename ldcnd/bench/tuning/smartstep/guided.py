"""Trying gains with a person: what the drive says of its tuning is shown, records and values are agreed to."""

from collections.abc import Mapping

from ldcnd.bench.person import Left, Person
from ldcnd.bench.tuning.smartstep.session import GAINS, SmartStepTuning, try_gains
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.number_text import NotANumber, read_word
from ldcnd.drives.smartstep.parameters import find_parameter

EXAMPLE = f"NAME=VALUE, such as {GAINS[0]}=80"
RECORD_S = 2.0
"""Usual duration of a record of a motion, seconds."""
RECORDED_S = (0.5, 60.0)
"""Shortest and longest record, seconds."""


async def tune(
    client: RigClient,
    person: Person,
    found: SmartStepTuning,
    wanted: Mapping[str, int],
    record_s: float,
    *,
    asks: bool = True,
) -> SmartStepTuning | None:
    """Try gains between two records, and keep them when the person agrees; None when they were not to be tried.

    Args:
        client: of the rig.
        person: sees and decides.
        found: by `read_tuning`, just now.
        wanted: values by the numbers of their parameters.
        record_s: duration of a record, seconds.
        asks: otherwise nothing is asked, and gains are kept when nothing speaks against them.

    Raises:
        Left: the person has left; the old gains are back.
        LdcndError: as the daemon refused it; likewise, unless control was lost.
    """
    axis = found.axis
    if asks and not await person.confirm(f"try these gains on {axis} now"):
        return None

    async def moves(what: str) -> None:
        person.tell(f"{axis}: let the machine move it for {record_s:g} s; recorded with {what}")
        if asks and not await person.confirm(f"record it with {what} now"):
            raise Left("it was not recorded")

    async def accepted(tried: SmartStepTuning) -> bool:
        if not asks:
            return tried.objection is None
        person.tell(*table(tried), *([tried.objection] if tried.objection else []))
        return await person.confirm(f"keep them in the RAM of {axis}")

    return await try_gains(client, found, wanted, record_s, moves, accepted, person.tell)


def typed(text: str) -> tuple[str, int] | None:
    """Return number and value of a parameter from `EXAMPLE`; None from anything else."""
    name, _, value = text.partition("=")
    parameter = find_parameter(name)
    try:
        return (parameter.label, read_word(value)) if parameter else None
    except NotANumber:
        return None


def plan(wanted: Mapping[str, int]) -> str:
    """Return what would be done with gains."""
    return (
        f"It would write {listed(wanted)} to RAM, between two records of a move that the machine makes, and put the old"
        " values back unless they are kept. Nothing here moves the motor."
    )


def shown(found: SmartStepTuning) -> list[str]:
    """Return what the drive says of its tuning."""
    result = found.auto_tuning_result_percent
    lines = [*found.auto_tuning, f"auto-tuning result (Fn007): {'not read' if result is None else f'{result} %'}"]
    if found.auto_tuning_runs:
        lines.append("Online auto-tuning runs: the drive goes on changing what it uses of these gains.")
    if found.switches_rule:
        lines.append(f"Its gain switch decides ({found.gain_switch:X}), not these parameters.")
    for name, value in found.gains.items():
        stored = f" ({value.stored} is stored)" if value.differs else ""
        lines.append(f"{name} = {value.active}  {value.name}{stored}")
    return lines


def table(tried: SmartStepTuning) -> list[str]:
    """Return the figures of both moves side by side."""
    old = {name: tried.gains[name].active for name in tried.tried}
    rows: list[tuple[str, ...]] = [("", "old gains", "new gains")]
    for title, name, form in (
        ("top speed", "top_speed_rpm", "{:.0f} r/min"),
        ("largest deviation", "largest_deviation", "{:.0f} units"),
        ("typical deviation", "typical_deviation", "{:.1f} units"),
        ("in position", "in_position", "{:.0%}"),
    ):
        cells = ["-" if each is None else form.format(getattr(each, name)) for each in (tried.before, tried.after)]
        rows.append((title, *cells))
    return [
        f"old gains: {listed(old)}",
        f"new gains: {listed(tried.tried)}",
        *("  " + " ".join(f"{cell:>18}" for cell in row) for row in rows),
    ]


def ending(tried: SmartStepTuning) -> str:
    """Return which gains the drive has now, and why."""
    if not tried.kept:
        return f"{tried.axis}: {tried.objection or 'not wanted'}; its old gains are back in RAM"
    commands = [f"ldcnd params set {tried.axis} {name} {value} --eeprom" for name, value in tried.tried.items()]
    return f"{tried.axis}: the new gains are in RAM until it is powered off; to store them: {'; '.join(commands)}"


def listed(gains: Mapping[str, int]) -> str:
    """Return gains in one line."""
    return ", ".join(f"{name} = {value}" for name, value in gains.items())
