"""`ldcnd axis`: show axes and move them."""

import click

from ldcnd.cli.lazy_group import LazyGroup

COMMANDS = {
    "alarms": "ldcnd.cli.axis_drive:alarms",
    "clear-counter": "ldcnd.cli.axis_drive:clear_counter",
    "faults": "ldcnd.cli.axis_state:faults",
    "gains": "ldcnd.cli.axis_motion:GAINS",
    "halt": "ldcnd.cli.axis_motion:halt",
    "home": "ldcnd.cli.axis_motion:home",
    "jog": "ldcnd.cli.jog:jog",
    "list": "ldcnd.cli.axis_state:list_axes",
    "monitors": "ldcnd.cli.axis_drive:monitors",
    "move": "ldcnd.cli.axis_motion:move",
    "move-analog": "ldcnd.cli.axis_motion:MOVE_ANALOG",
    "outputs": "ldcnd.cli.axis_motion:OUTPUTS",
    "power": "ldcnd.cli.axis_motion:power",
    "preview": "ldcnd.cli.axis_motion:preview",
    "probe": "ldcnd.cli.axis_motion:probe",
    "profile": "ldcnd.cli.axis_drive:profile",
    "pwm": "ldcnd.cli.axis_motion:PWM",
    "quick-stop": "ldcnd.cli.axis_motion:QUICK_STOP",
    "read-monitors": "ldcnd.cli.axis_drive:read_monitors",
    "reset": "ldcnd.cli.axis_motion:reset",
    "set-position": "ldcnd.cli.axis_motion:SET_POSITION",
    "stop": "ldcnd.cli.axis_motion:stop",
    "track": "ldcnd.cli.axis_motion:TRACK",
    "watch": "ldcnd.cli.axis_state:watch",
}


@click.group(cls=LazyGroup, homes=COMMANDS)
def command() -> None:
    """List, watch, move, stop and home axes of a running daemon."""
