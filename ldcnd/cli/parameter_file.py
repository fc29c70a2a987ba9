"""Files of parameters: TOML that says from which drive they are, when they were read, and what both memories held."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.parameters import ParameterDump
from ldcnd.drives.family import HasParameters
from ldcnd.drives.known import FAMILIES

LARGEST = 0xFFFF
FAMILY = next(family for family in FAMILIES.values() if isinstance(family, HasParameters))
"""Whose drives files are about: there is one such family, so that files need not name it."""


@dataclass(frozen=True, slots=True)
class ParameterFile:
    """The contents of a file.

    Attributes:
        values: what was stored, by the names of the file.
        in_use: what was in use; empty in files of earlier versions.
        driver_type: of the drive; None where the file does not say.
    """

    values: Mapping[str, int]
    in_use: Mapping[str, int]
    driver_type: int | None

    def named(self) -> dict[str, int]:
        """Return the stored values by their numbers; what the manual does not list keeps its name."""
        return {FAMILY.parameter(name, value)[0]: value for name, value in self.values.items()}

    def check(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return what is wrong with the values, and what deserves attention; sends nothing to a drive."""
        return FAMILY.check_parameters(self.values)


def as_toml(axis: str, reply: ParameterDump, read_at: datetime) -> str:
    """Return a dump as TOML, the digits of parameters that have some in remarks."""
    facts = reply.facts
    lines = [f'axis = "{axis}"', f"read_at = {read_at.isoformat(timespec='seconds')}"]
    if facts:
        switches = ", ".join(f'"{switch.lower()}"' for switch in facts.switches)
        lines += [
            f"driver_type = 0x{facts.driver_type:04X}",
            f"software_version = 0x{facts.software_version:04X}",
            f"unit = {facts.unit}",
            f"gain_switch = {facts.gain_switch}",
            f"switches_on = [{switches}]",
        ]
    lines += ["", "# in EEPROM", "[parameters]"]
    for value in reply.values:
        _, word, remarks = FAMILY.parameter(value.parameter, value.stored)
        lines.append(f"{value.parameter} = {word}  # {value.name}")
        lines += [f"#   {text}" for text in remarks]
    lines += ["", "# in RAM", "[in_use]"]
    lines += [f"{value.parameter} = {value.active}" for value in reply.values]
    return "\n".join(lines) + "\n"


def load_parameters(file: Path) -> ParameterFile:
    """Return what a file of parameters says.

    Raises:
        ConfigError: it is none.
    """
    try:
        document = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: not a file of parameters: {error}") from error
    if "parameters" not in document:
        raise ConfigError(f"{file}: not a file of parameters: there is no table [parameters]")
    driver_type = document.get("driver_type")
    if driver_type is not None and type(driver_type) is not int:
        raise ConfigError(f"{file}: driver_type: {driver_type!r} is not a number")
    return ParameterFile(
        _words(file, "parameters", document["parameters"]),
        _words(file, "in_use", document.get("in_use", {})),
        driver_type,
    )


def _words(file: Path, table: str, values: object) -> dict[str, int]:
    if not isinstance(values, dict):
        raise ConfigError(f"{file}: [{table}] is not a table")
    for name, value in values.items():
        if type(value) is not int or not 0 <= value <= LARGEST:
            raise ConfigError(f"{file}: {name}: {value!r} is not a word from 0 to {LARGEST}")
    return values
