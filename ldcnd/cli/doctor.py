"""`ldcnd doctor`: examine a line before a daemon uses it; opens the port itself, only reads by default."""

import asyncio
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from ldcnd.config.edit import set_for_axis
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import ConfigError, NotSupported
from ldcnd.contract.health import Finding, Verdict
from ldcnd.drives.family import ConfigFiles, Examines
from ldcnd.drives.known import FAMILIES, chain_of
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.opened import show_findings
from ldcnd.log import configure_logging

FILES = ConfigFiles(
    lambda file: load_config(file).bus, lambda file, settings: chain_of(settings, load_config(file).sim), set_for_axis
)


class Examinations(click.Group):
    """One command for each family, and what else a family can examine."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Return the names of all commands."""
        return list(self._commands())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Return the command of that name."""
        return self._commands().get(cmd_name)

    @staticmethod
    def _commands() -> dict[str, click.Command]:
        commands = {
            name: _examination(name, family) for name, family in FAMILIES.items() if isinstance(family, Examines)
        }
        more = {
            str(each.name): each
            for family in FAMILIES.values()
            if isinstance(family, Examines)
            for each in family.commands(FILES)
        }
        return commands | more


@click.command(cls=Examinations)
def command() -> None:
    """Examine a line; only reads by default. No daemon may use it meanwhile."""


def _examination(family_name: str, family: Examines[Any]) -> click.Command:
    """Return the command that examines lines of a family."""

    def examine(config: Path, name: str, *, as_json: bool) -> None:
        rig = load_config(config)
        settings = next((bus for bus in rig.bus if bus.name == name and bus.family == family_name), None)
        if settings is None:
            raise ConfigError(f"{config}: no {family_name} line {name!r}")
        wrong = False

        def show(finding: Finding) -> None:
            nonlocal wrong
            wrong = wrong or finding.verdict is Verdict.WRONG
            assumption = f"  [{finding.verifies}]" if finding.verifies else ""
            remedy = f"\n{'':31}> {finding.remedy}" if finding.remedy else ""
            text = f"{finding.axis:8} {finding.verdict:5} {finding.what:16} {finding.text}{assumption}{remedy}"
            print(finding.model_dump_json() if as_json else text, flush=True)

        configure_logging(level="error")  # findings say the rest
        asyncio.run(examine_line(rig, settings, show))
        sys.exit(1 if wrong else 0)

    options: list[click.Parameter] = [
        click.Option(
            ["--config"], type=click.Path(path_type=Path), required=True, help="The rig's configuration (TOML)."
        ),
        click.Option(["--bus", "name"], required=True, help="The line to examine."),
        click.Option(["--json", "as_json"], is_flag=True, help="Print JSON lines."),
    ]
    return click.Command(family_name, callback=examine, params=options, help=family.examination)


async def examine_line(rig: RigConfig, settings: BusConfig, show: Callable[[Finding], None]) -> None:
    """Open a line, examine it and every configured drive on it, and close it.

    Raises:
        BusDown: the port does not open.
    """
    family = FAMILIES[settings.family]
    if not isinstance(family, Examines):
        raise NotSupported(f"bus {settings.name}: lines of family {settings.family} are not examined")
    line = family.open_lines(None)(settings, None, chain_of(settings, rig.sim))
    line.bus.resync = line.network.resync
    await show_findings(line.bus, settings.port, family.examine(line, settings), show)
