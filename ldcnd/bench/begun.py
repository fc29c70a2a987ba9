"""Beginning a configuration with what a scan of a port has found; what is in a file already stays as it is."""

import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from ldcnd.bench.family import BenchFamily, ScannedDrive
from ldcnd.bench.known import BENCHES, show_findings
from ldcnd.config.edit import draft_of, write_over
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.health import Finding
from ldcnd.drives.line_config import BusConfig

NEW = """# Begun by `ldcnd scan`; every key is described in docs/reference/configuration.md.
rig = "rig"
"""


async def scan_port(
    family: BenchFamily[Any], port: str, show: Callable[[Finding], None], *, give_addresses: bool = False
) -> Sequence[ScannedDrive]:
    """Open a port, scan it for drives of a family, and close it.

    Raises:
        BusDown: the port does not open.
    """
    look = family.scan(port, give_addresses=give_addresses)
    await show_findings(look.bus, port, look.findings, show)
    return look.drives


@dataclass(frozen=True, slots=True)
class Begun:
    """A configuration as it would be.

    Attributes:
        file: where it goes.
        before: the text of the file as it is; empty without one.
        text: as it would be.
        remarks: in words what is added, and how what was found differs from what is in the file.
    """

    file: Path
    before: str
    text: str
    remarks: tuple[str, ...]


def begun_with(file: Path, family_name: str, port: str, drives: Sequence[ScannedDrive]) -> Begun:
    """Return a configuration with drives added that are not in it yet, or a new one; the file stays as it is.

    Raises:
        ConfigError: what is in the file is no configuration, or with these drives it would be none.
    """
    family = BENCHES[family_name]
    known = [drive for drive in drives if drive.model]
    said = [f"address {drive.address} is left out: {drive.text}" for drive in drives if not drive.model]
    rig = load_config(file) if file.exists() else None
    lines = list(rig.bus) if rig else []
    line = next((each for each in lines if each.port == port and each.family == family_name), None)
    text = file.read_text(encoding="utf-8") if rig else NEW
    if line:
        said += _differences(line, known)
        new = [drive for drive in known if drive.address not in line.models]
        place = _end_of(text, port)
    else:
        new, place = known, len(text)
        text = f"{text.rstrip()}\n{family.configured_line(_free('line', [each.name for each in lines]), port, new)}"
        place = len(text)
    names = [axis.name for each in lines for axis in each.axis]
    tables = ""
    for drive in new:
        names.append(name := _free("axis", names, drive.address))
        tables += family.configured_drive(name, drive)
    whole = text[:place].rstrip("\n") + "\n" + tables + text[place:]
    with draft_of(file) as draft:
        _write_checked(draft, file, whole)
    said.append(f"{file}: {len(new)} of {len(drives)} added; `ldcnd check-config {file}` says what it promises")
    return Begun(file, file.read_text(encoding="utf-8") if rig else "", whole, tuple(said))


def write(begun: Begun) -> tuple[str, ...]:
    """Write a configuration; return the remarks on it.

    Raises:
        ConfigError: it cannot be written, or was changed since; it is as it is.
    """
    write_over(begun.file, begun.before, begun.text)
    return begun.remarks


def _write_checked(draft: Path, file: Path, text: str) -> None:
    try:
        draft.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error.strerror}") from error
    try:
        load_config(draft)
    except ConfigError as error:
        message = f"{file}: not written, it would not be valid: {error.message}"
        raise ConfigError(message, remedy="put it in by hand, or write to a new file") from error


def _differences(line: BusConfig, found: Sequence[ScannedDrive]) -> list[str]:
    """Return in words how a line differs from what was found on it."""
    models = {drive.address: drive.model for drive in found}
    return [
        f"address {address} is configured as {model}; "
        + (f"a {models[address]} was found there" if address in models else "nothing answers there")
        for address, model in line.models.items()
        if models.get(address) != model
    ]


def _free(stem: str, taken: Sequence[str], first: int = 0) -> str:
    return next(name for number in count(first) if (name := f"{stem}{number}") not in taken)


def _end_of(text: str, port: str) -> int:
    """Return where the tables of a line end: at the next one that is not about it; remarks before that are its own."""
    lines = text.splitlines(keepends=True)
    begin = next((n for n, line in enumerate(lines) if _names_port(line, port)), None)
    if begin is None:
        raise ConfigError(f"the line on {port} was not found in the file", remedy="put the drives in by hand")
    others = (n for n in range(begin + 1, len(lines)) if re.match(r"\[(?!\[?bus\.)", lines[n]))
    end = next(others, len(lines))
    while end > begin and (not lines[end - 1].strip() or lines[end - 1].startswith("#")):
        end -= 1
    return sum(map(len, lines[:end]))


def _names_port(line: str, port: str) -> bool:
    if not re.match(r"\s*port\s*=", line):
        return False
    try:
        return tomllib.loads(line).get("port") == port
    except tomllib.TOMLDecodeError:
        return False
