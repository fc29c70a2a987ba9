"""`ldcnd check-config`: would this configuration run?"""

import json
import sys
from pathlib import Path

import click

from ldcnd.config.plan import require_plan
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.daemon.assembly import session_settings
from ldcnd.net.zenoh_config import zenoh_config


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def command(config: Path, *, as_json: bool) -> None:
    """Validate CONFIG whole, without opening anything; exits with 78 when it cannot work."""
    try:
        rig = load_config(config)
        require_plan(rig)
        zenoh_config(session_settings(rig))
    except ConfigError as error:
        if not as_json:
            raise
        print(json.dumps({"valid": False, "errors": error.message.splitlines()}))
        sys.exit(78)
    axes = [axis.name for bus in rig.bus for axis in bus.axis]
    if as_json:
        print(json.dumps({"valid": True, "rig": rig.rig, "buses": [bus.name for bus in rig.bus], "axes": axes}))
    else:
        print(f"{config}: rig {rig.rig}, {len(rig.bus)} bus(es), axes {', '.join(axes)}: valid")
