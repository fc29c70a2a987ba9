"""What each command is called: the table of the program with its groups and examples, and how a remedy is typed."""

import shlex
from collections.abc import Mapping
from contextvars import ContextVar
from typing import Final

from ldcnd.contract.errors import Argument, RemedyCommand

GROUPS: Final[Mapping[str, Mapping[str, tuple[str, str]]]] = {
    "Run": {
        "run": ("ldcnd.cli.run", "Run the daemon."),
        "check-config": ("ldcnd.cli.plan:check_config", "Validate a configuration without opening anything."),
        "plan": (
            "ldcnd.cli.plan:plan",
            "Show what the lines of a configuration promise, before any hardware is there.",
        ),
        "reload": ("ldcnd.cli.rig:reload", "Have a daemon read its configuration again."),
        "sim": ("ldcnd.sim.cli", "Simulate a line of drives behind a pseudo-terminal."),
        "twin": ("ldcnd.testing.cli:twin", "Rehearse a program on a simulated rig that stands as the running one."),
    },
    "Operate": {
        "list": ("ldcnd.cli.looking:list_axes", "Show every axis: where it is, its state, what is wrong with it."),
        "move": ("ldcnd.cli.axis:move", "Move an axis to a position, by a distance or at a velocity."),
        "jog": ("ldcnd.cli.axis:jog", "Run an axis while the space bar is held, or for a time."),
        "home": ("ldcnd.cli.axis:home", "Find the reference position of an axis."),
        "halt": ("ldcnd.cli.axis:halt", "Decelerate an axis to standstill; another command may follow."),
        "stop": ("ldcnd.cli.rig:stop", "Stop every axis of a rig, or one, and latch."),
        "reset": ("ldcnd.cli.rig:reset", "Clear stop latches and faults of all axes, or of some."),
        "power": ("ldcnd.cli.rig:power", "Close or open the position loops of all axes, or of some."),
        "speed": ("ldcnd.cli.rig:speed", "Show or set the speed override of the rig."),
        "group": ("ldcnd.cli.rig:group", "Move several axes together."),
        "position": ("ldcnd.cli.sequence:position", "Teach named positions, and go to them."),
        "sequence": ("ldcnd.cli.sequence:sequence", "Carry out a sequence of the configuration."),
        "axis": ("ldcnd.cli.axis", "Send any other command to an axis: probe, set its position, read its drive."),
        "lease": ("ldcnd.cli.rig:lease", "See who controls which axis; hold control."),
    },
    "Look": {
        "watch": ("ldcnd.cli.looking:watch", "Show the telemetry of an axis as it comes."),
        "top": ("ldcnd.lab.cli.top", "Show every axis and line of a rig, what is wrong first."),
        "why": ("ldcnd.cli.looking:why", "Tell why an axis cannot move, and what would clear that."),
        "fault": ("ldcnd.cli.looking:fault", "Explain a fault or an error code: what to check, how to clear it."),
        "log": ("ldcnd.cli.log:log", "Show what happened: who moved what, faults, losses, in one order."),
        "fleet": ("ldcnd.cli.looking:fleet", "Show every rig, axis, version and health that can be reached."),
        "bus": ("ldcnd.cli.bus", "Show the lines of a running daemon, and what was on them."),
        "trace": ("ldcnd.cli.trace", "Record an axis against time, and show the result."),
        "record": ("ldcnd.lab.cli.record:record", "Record a rig to MCAP; recover and convert recordings."),
        "plot": ("ldcnd.lab.cli.record:plot", "Draw a trace, or an axis of a recording."),
        "shadow": (
            "ldcnd.bench.cli.commission:shadow",
            "Watch axes for growing friction, a changed load, a coupling that slips.",
        ),
    },
    "Set up": {
        "scan": (
            "ldcnd.bench.cli.examine:scan",
            "Find out which drives are on a port, at which rate and in which state.",
        ),
        "doctor": ("ldcnd.bench.cli.examine:doctor", "Examine a line by reading only, before a daemon uses it."),
        "commission": (
            "ldcnd.bench.cli.commission:commission",
            "Go through the checklist of an axis: from its first motion to a report.",
        ),
        "tune": (
            "ldcnd.bench.cli.commission:tune",
            "Find gains for an axis: move it a little, identify it, apply, verify.",
        ),
        "params": ("ldcnd.cli.params", "Read, write, save and compare the parameters of a drive."),
        "accept": (
            "ldcnd.bench.cli.examine:accept",
            "Try real drives against what the documents say, and keep a report of it.",
        ),
        "drill": ("ldcnd.cli.rig:drill", "Rehearse the loss of a client, a line or the daemon."),
    },
    "Connect": {
        "console": ("ldcnd.console.cli:console", "Show rigs in a browser."),
        "metrics": ("ldcnd.lab.cli.serve:metrics", "Serve the health of a running daemon to Prometheus."),
        "epics": ("ldcnd.lab.cli.serve:epics", "Serve axes as EPICS motor records."),
        "secop": ("ldcnd.lab.cli.serve:secop", "Serve axes as modules of a SECoP node."),
        "ros2": ("ldcnd.lab.cli.serve:ros2", "Publish joint states and diagnostics to a ROS 2 graph."),
        "foxglove": ("ldcnd.lab.cli.serve:foxglove", "Show a running rig live in Foxglove, read-only."),
        "pki": ("ldcnd.ops.cli", "Make certificates and access rules for a network with mutual TLS."),
    },
}
"""Every command by its group, in the order of the help: its module, behind a colon its name there (`command`
otherwise), and what it does."""
COMMANDS: Final[Mapping[str, tuple[str, str]]] = {
    name: entry for group in GROUPS.values() for name, entry in group.items()
}

EXAMPLES: Final[Mapping[str, str]] = {
    "run": "--config config/simulated.toml --console",
    "reload": "--dry-run",
    "check-config": "rig.toml",
    "plan": "rig.toml",
    "sim": "--pty ./port --chain pic-servo-sc,pic-io",
    "twin": "rig.toml --at tcp/127.0.0.1:7600 --report night.json",
    "list": "",
    "move": "x 10 --wait",
    "jog": "x -5",
    "home": "x --wait",
    "halt": "x",
    "stop": "",
    "reset": "x",
    "power": "on x",
    "speed": "50",
    "group": "move x=10 y=20 --wait",
    "group move": "x=10 y=20 --wait",
    "group path": "z=20,20,0 c=0,15,0",
    "position": "go rig.toml park",
    "position go": "rig.toml park",
    "position teach": "rig.toml park z x",
    "sequence": "run rig.toml load",
    "sequence run": "rig.toml load --record load.jsonl",
    "axis": "probe x --source index --distance 5 --wait",
    "axis alarms": "feed",
    "axis at": "x --ago 2.5",
    "axis clear-counter": "feed feedback",
    "axis gains": "x --kp 400",
    "axis monitors": "feed --read",
    "axis move-analog": "x 512",
    "axis outputs": "x --limit1 high",
    "axis preview": "x --position 10",
    "axis probe": "x --source index --distance 5 --wait",
    "axis pwm": "x 0.1 0.5",
    "axis quick-stop": "x",
    "axis set-position": "x 0",
    "axis track": "x 10.01",
    "lease": "hold --axis x -- python move.py",
    "lease hold": "--axis x -- python move.py",
    "lease list": "",
    "watch": "x --item position",
    "top": "",
    "why": "x",
    "fault": "not_referenced",
    "log": "--since 10m --axis x",
    "fleet": "--watch 2",
    "bus": "list",
    "bus list": "",
    "bus send-away": "labview",
    "bus set-io": "io 4=high 9=low",
    "bus set-io-timer": "io counter --prescale 4",
    "bus override-interlock": "door_shut --seconds 60 --reason service --lease 0123456789abcdef",
    "bus snapshot": "line0",
    "bus wire-log": "line0 --seconds 2 --format words",
    "trace": "take x -c position --samples 200 --out x.csv",
    "trace abort": "x",
    "trace show": "x.csv",
    "trace take": "x -c position --samples 200 --out x.csv",
    "record": "--out run.mcap",
    "record export": "run.mcap run.csv",
    "record recover": "run.mcap whole.mcap",
    "plot": "run.mcap x -o x.png",
    "shadow": "x",
    "scan": "/dev/ttyUSB0 --write rig.toml",
    "doctor": "--config rig.toml --bus line0",
    "doctor verify": "--config rig.toml --bus line1 --axis feed",
    "commission": "x --config rig.toml",
    "tune": "x --within 5",
    "params": "get feed Pn100",
    "params check": "feed.toml",
    "params clone": "feed spare --dry-run",
    "params diff": "feed feed.toml",
    "params dump": "feed feed.toml",
    "params get": "feed Pn100",
    "params list": "feed",
    "params restart-count": "feed",
    "params restore": "feed feed.toml --dry-run",
    "params save": "feed --dry-run",
    "params set": "feed Pn100 50",
    "accept": "/dev/ttyUSB0 --out acceptance",
    "drill": "client-loss x --velocity 5 --yes",
    "console": "--listen 127.0.0.1:8470",
    "metrics": "--listen 127.0.0.1:9470",
    "epics": "--prefix rig:",
    "secop": "x y --moves",
    "ros2": "--router tcp/127.0.0.1:7447",
    "foxglove": "",
    "pki": "init ./pki",
    "pki add": "./pki ada --role operator",
    "pki init": "./pki",
    "pki list": "./pki",
    "pki renew": "./pki ada",
    "pki revoke": "./pki ada",
}
"""One example of each command, as it is typed behind its name."""

RENAMED: Final[Mapping[str, str]] = {
    "events": "log",
    "trace plot": "plot",
    "trace last": "trace show",
    "position list": "position go --list",
    "sequence list": "sequence run --list",
    "group preview": "group move --dry-run --straight",
    "bus convert": "bus wire-log",
    "bus guests": "bus list --guests",
    "doctor ldcn": "doctor",
    "doctor smartstep": "doctor",
}
"""Commands that had another name."""


def example_of(path: str) -> str | None:
    """Return the line of the help that shows a command at work; None for one without an example.

    Args:
        path: its words behind `ldcnd`.
    """
    given = EXAMPLES.get(path)
    return None if given is None else f"Example: ldcnd {path} {given}".rstrip()


TYPED = {
    "stop": "stop",
    "reload": "reload",
    "list_lines": "bus list",
    "put_back_gains": "tune {axis} --put-back",
    "power": "power {on} {axis}",
    "set_position": "axis set-position {axis} POSITION",
    "set_speed_override": "speed PERCENT",
    "set_gains": "axis gains {axis} --kp KP --el EL",
    "set_io": "bus set-io {module} {lines}",
    "set_outputs": "axis outputs {axis} --limit1 input --limit2 input",
    "move_relative": "move {axis} DISTANCE --relative",
    "jog": "jog {axis} VELOCITY",
    "trace_abort": "trace abort {axis}",
    "clear_counter": "axis clear-counter {axis} COUNTER",
    "restart_eeprom_count": "params restart-count {axis}",
    "list_parameters": "params list {axis}",
    "acquire": "lease hold --axis {axis} -- COMMAND",
    "events": "log",
}
"""How a command that a remedy names is typed; what is missing is its verb, behind `axis` if the program has it not."""
OPTIONS_TYPED: ContextVar[str] = ContextVar("options that name daemon and rig", default="")
"""Those of the `Target` of the command that runs, which sets them: a remedy without them would reach another rig."""


def typed(step: RemedyCommand, axis: str | None) -> str:
    """Return a step of a remedy as it is typed, for the rig that it is about.

    Args:
        step: the command.
        axis: what it is about; None when it is not about one axis.
    """
    name = step.verb.replace("_", "-")
    words = TYPED.get(step.verb, f"{name} {{axis}}" if name in COMMANDS else f"axis {name} {{axis}}")
    given = step.arguments
    lines = " ".join(f"{line}={level}" for level in ("high", "low") for line in _lines(given.get(level)))
    words, separator, program = words.format(
        axis=shlex.quote(axis) if axis else "AXIS",
        on="on" if given.get("on", True) else "off",
        module=given.get("module", "MODULE"),
        lines=lines,
    ).partition(" -- ")
    force = " --force" if step.arguments.get("force") else ""
    return f"ldcnd {words}{force}{OPTIONS_TYPED.get()}{separator}{program}"


def _lines(given: Argument | None) -> tuple[str, ...]:
    return given if isinstance(given, tuple) else ()


def whose(rig: str, among: int = 1) -> str:
    """Return a rig in front of a line that tells what was done, where it could be meant of another one.

    Args:
        rig: its name.
        among: how many rigs the command has reached.
    """
    return f"{rig}: " if among > 1 or OPTIONS_TYPED.get() else ""
