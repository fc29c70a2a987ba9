"""`ldcnd scan`: find out what is on a port of which nothing is known, and begin a configuration with it."""

import asyncio
import re
import sys
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path

import click

from ldcnd.config.bus import BusConfig
from ldcnd.config.edit import draft_of
from ldcnd.config.rig import load_config
from ldcnd.errors import ConfigError
from ldcnd.families.family import ScannedDrive, Scans
from ldcnd.families.known import FAMILIES
from ldcnd.families.opened import show_findings
from ldcnd.log import configure_logging
from ldcnd.model.health import Finding, Verdict

NOTHING_FOUND = 1
"""Exit code: no drive answers, or something must be put right first."""
SCANNED = {name: family for name, family in FAMILIES.items() if isinstance(family, Scans)}
NEW = """# Begun by `ldcnd scan`; every key is described in docs/reference/configuration.md.
rig = "rig"
"""


@click.command()
@click.argument("port")
@click.option("--family", type=click.Choice(list(SCANNED)), help="Search for drives of this family only.")
@click.option(
    "--address",
    "give_addresses",
    is_flag=True,
    help="Reset and address a chain on which nothing can be moving; the motors lose their positions.",
)
@click.option(
    "--write",
    "file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Add what was found and is not in it yet to a configuration, or begin one.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines.")
def command(port: str, family: str | None, file: Path | None, *, give_addresses: bool, as_json: bool) -> None:
    """Find out which drives are on PORT, at which rate and in which state; no daemon may use it meanwhile.

    Listens, then probes addresses 1 to 32, or units 0 to F, at every rate: 10 to 20 seconds. It only reads: nothing
    moves, nothing is reset, nothing gets an address, unless --address says so. Exits with 1 when no drive is found.
    """
    configure_logging(level="error")  # findings say the rest
    wrong = False

    def show(finding: Finding) -> None:
        nonlocal wrong
        wrong = wrong or finding.verdict is Verdict.WRONG
        remedy = f"\n{'':28}> {finding.remedy}" if finding.remedy else ""
        text = f"{finding.axis:8} {finding.verdict:5} {finding.what:12} {finding.text}{remedy}"
        print(finding.model_dump_json() if as_json else text, flush=True)

    for name in (family,) if family else SCANNED:
        if not as_json:
            print(f"searching for {name} drives", file=sys.stderr, flush=True)
        wrong = False
        drives = asyncio.run(scan_port(SCANNED[name], port, show, give_addresses=give_addresses))
        if drives:
            if file:
                print("\n".join(write(file, name, port, drives)), file=sys.stderr)
            break
    sys.exit(NOTHING_FOUND if wrong or not drives else 0)


async def scan_port(
    family: Scans, port: str, show: Callable[[Finding], None], *, give_addresses: bool = False
) -> Sequence[ScannedDrive]:
    """Open a port, scan it for drives of a family, and close it.

    Raises:
        BusDown: the port does not open.
    """
    look = family.scan(port, give_addresses=give_addresses)
    await show_findings(look.bus, port, look.findings, show)
    return look.drives


def write(file: Path, family_name: str, port: str, drives: Sequence[ScannedDrive]) -> list[str]:
    """Add drives to a configuration, or begin one; what is in it stays as it is.

    Returns:
        In words what was added, and how what was found differs from what is in the file.

    Raises:
        ConfigError: with these drives it would be no configuration; the file stays as it was.
    """
    family = SCANNED[family_name]
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
    with draft_of(file) as draft:
        draft.write_text(text[:place].rstrip("\n") + "\n" + tables + text[place:], encoding="utf-8")
        try:
            load_config(draft)
        except ConfigError as error:
            message = f"{file}: not written, it would not be valid: {error.message}"
            raise ConfigError(message, remedy="put it in by hand, or write to a new file") from error
        draft.replace(file)
    return [*said, f"{file}: {len(new)} of {len(drives)} added; `ldcnd check-config {file}` says what it promises"]


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
    wanted = f'port="{port}"'
    begin = next(n for n, line in enumerate(lines) if line.split("#")[0].replace(" ", "").strip() == wanted)
    others = (n for n in range(begin + 1, len(lines)) if re.match(r"\[(?!\[?bus\.)", lines[n]))
    end = next(others, len(lines))
    while end > begin and (not lines[end - 1].strip() or lines[end - 1].startswith("#")):
        end -= 1
    return sum(map(len, lines[:end]))
