"""`ldcnd scan`: find out what is on a port of which nothing is known, and begin a configuration with it."""

import asyncio
import sys
from pathlib import Path

import click

from ldcnd.bench.begun import SCANNED, begun_with, scan_port, write
from ldcnd.contract.health import Finding, Verdict
from ldcnd.log import configure_logging

NOTHING_FOUND = 1
"""Exit code: no drive answers, or something must be put right first."""


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
                print("\n".join(write(begun_with(file, name, port, drives))), file=sys.stderr)
            break
    sys.exit(NOTHING_FOUND if wrong or not drives else 0)
