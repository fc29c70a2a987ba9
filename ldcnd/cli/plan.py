"""`ldcnd check-config` and `ldcnd plan`: what a configuration is, before it runs."""

import json
import sys
import time
from pathlib import Path

import click

from ldcnd.cli.output import show_lines
from ldcnd.cli.typed import CONFIGURATION
from ldcnd.config.plan import plan_rig, require_plan
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.plan import BusPlan
from ldcnd.contract.troubles import certificate_troubles
from ldcnd.net.zenoh_config import certificate_in_use, zenoh_config

EXIT_OVERFULL = 1


@click.command()
@click.argument("config", type=CONFIGURATION)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def check_config(config: Path, *, as_json: bool) -> None:
    """Validate CONFIG whole, without opening anything; exits with 78 when it cannot work."""
    try:
        rig = load_config(config)
        require_plan(rig)
        certificate = certificate_in_use(zenoh_config(rig.zenoh.session()))
    except ConfigError as error:
        if not as_json:
            raise
        print(json.dumps({"valid": False, "errors": error.message.splitlines()}))
        sys.exit(78)
    axes = [axis.name for bus in rig.bus for axis in bus.axis]
    warnings = certificate_troubles(certificate, time.time_ns())
    if as_json:
        buses = [bus.name for bus in rig.bus]
        print(json.dumps({"valid": True, "rig": rig.rig, "buses": buses, "axes": axes, "warnings": warnings}))
    else:
        for each in warnings:
            show_lines(f"warning: {each}", err=True)
        print(f"{config}: rig {rig.rig}, {len(rig.bus)} bus(es), axes {', '.join(axes)}: valid")


@click.command()
@click.argument("config", type=CONFIGURATION)
@click.option("--json", "as_json", is_flag=True, help="Print the plan as JSON.")
def plan(config: Path, *, as_json: bool) -> None:
    """Show how much of each line CONFIG uses and how late polls and stops can be; exits with 1 when it cannot hold."""
    plan = plan_rig(load_config(config))
    if as_json:
        print(plan.model_dump_json())
    else:
        print("\n\n".join(_table(bus) for bus in plan.buses))
    if not plan.holds:
        sys.exit(EXIT_OVERFULL)


def _table(bus: BusPlan) -> str:
    assumed = f"{_ms(bus.turnaround_s)} host, {_ms(bus.adapter_latency_s)} adapter, for each exchange"
    stops = [
        f"  stop         {_ms(bus.stop_wait_s)} to its first bit, {_ms(bus.stop_s)} to the drive's answer",
        f"               {_ms(bus.stop_after_loss_s)} to the answer after a lost reply",
    ]
    lines = [
        f"bus {bus.bus}, {bus.baud} baud (drives: {bus.node_baud:.0f}): {'holds' if bus.holds else 'CANNOT HOLD'}",
        f"  load         {bus.load:6.1%} at worst, {bus.mean_load:.1%} on average",
        f"  commands     {bus.commands_per_s:6.0f} /s before a poll misses its turn",
        *(stops if bus.stops else ["  stop         nothing on this line can move or stop a drive"]),
        f"  assumed      {assumed}",
        f"  {'axis':12} {'item':20} {'rate':>8} {'bytes':>7} {'on line':>10} {'read within':>12}",
    ]
    for poll in bus.polls:
        size = f"{poll.request_bytes}/{poll.reply_bytes}"
        remarks = f"{'' if poll.priority == 'normal' else f'  {poll.priority}'}{'' if poll.holds else '  late'}"
        lines += [
            f"  {poll.axis:12} {item.item:20} {item.rate_hz:5g} Hz {size:>7} {_ms(poll.longest_s):>10}"
            f" {_ms(item.response_s):>12}{remarks}"
            for item in poll.items
        ]
    if bus.remedies:
        lines += ["  would hold with any of:", *(f"    {remedy}" for remedy in bus.remedies)]
    return "\n".join(lines)


def _ms(seconds: float | None) -> str:
    return "unbounded" if seconds is None else f"{seconds * 1e3:.2f} ms"
