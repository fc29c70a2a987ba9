"""Named positions and sequences of a configuration: refused where they name what is not there, and taught."""

from collections.abc import Collection, Iterable

from pydantic import ValidationError

from ldcnd.contract.catalogue import BY_VERB
from ldcnd.contract.commands import About
from ldcnd.contract.sequences import NamedPosition, SequenceConfig, SequenceStep
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.toml import refuse_duplicates


def check_sequences(
    positions: tuple[NamedPosition, ...], sequences: tuple[SequenceConfig, ...], buses: tuple[BusConfig, ...]
) -> None:
    """Refuse positions and sequences that name what is not there, and commands that cannot be made.

    Raises:
        ValueError: says which one, which name and what there is.
    """
    refuse_duplicates("position", [each.name for each in positions])
    refuse_duplicates("sequence", [each.name for each in sequences])
    axes = {axis.name for bus in buses for axis in bus.axis}
    outputs = {name for bus in buses for name in bus.outputs}
    lines = outputs | {name for bus in buses for name in bus.inputs}
    modules = {name for bus in buses for name in bus.module_names}
    by_number = {f"{name}.LINE" for name in modules}
    named = {each.name for each in positions}
    for position in positions:
        _known(f"position {position.name}", "axis", position.axes, axes)
    for sequence in sequences:
        for number, step in enumerate(sequence.step, 1):
            where = f"sequence {sequence.name}: step {number}"
            _known(where, "axis", [*filter(None, [step.axis]), *step.standstill], axes)
            _known(where, "position", filter(None, [step.go]), named)
            _known(where, "output", (name for name in step.set if not is_line_of(name, modules)), outputs | by_number)
            _known(where, "input or output", step.until, lines)
            _check_command(where, step)


def is_line_of(name: str, modules: Collection[str]) -> bool:
    """Tell whether a name is that of a line by its number, such as cabinet.10, of one of these modules."""
    module, _, line = name.partition(".")
    return module in modules and line.isdecimal()


def _known(where: str, what: str, names: Iterable[str], there: Iterable[str]) -> None:
    for name in names:
        if name not in there:
            raise ValueError(f"{where}: there is no {what} {name!r}; there are: {', '.join(sorted(there)) or 'none'}")


def _check_command(where: str, step: SequenceStep) -> None:
    if (step.do is None) != (step.axis is None) or (step.arguments and step.do is None):
        raise ValueError(f"{where}: do and axis go together, and arguments with both")
    if step.do is None:
        return
    command = BY_VERB[About.AXIS][step.do]
    unknown = sorted(set(step.arguments) - set(command.model_fields))
    missing = [
        name for name, field in command.model_fields.items() if field.is_required() and name not in step.arguments
    ]
    if unknown or missing:
        words = [f"has no {name}" for name in unknown] + [f"needs {name}" for name in missing]
        raise ValueError(f"{where}: {step.do} {' and '.join(words)}")
    try:
        command.model_validate(step.arguments)
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        raise ValueError(f"{where}: {'.'.join(map(str, wrong['loc'])) or step.do}: {wrong['msg']}") from None
