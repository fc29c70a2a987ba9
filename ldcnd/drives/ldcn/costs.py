"""The price list of an LDCN/NMC module: its exchanges, and the rate that its clock makes of a nominal one.

Sources: LS-182AP manual, "Command Description"; PIC-SERVO manual, 4.1 (the wait of one servo cycle),
5.2.
"""

from functools import partial
from types import MappingProxyType
from typing import Any

from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.addressing import NULLS, NULLS_SETTLE_S, read_identity
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.controls import HomingControl, StopControl
from ldcnd.drives.ldcn.packet import StatusItem
from ldcnd.drives.ldcn.profiles import CLOCK_HZ, PROFILES, Support, at_clock
from ldcnd.drives.ldcn.registers import BaudCodes, actual_baud, baud_divisor
from ldcnd.drives.ldcn.servo import reading_items
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.drives.price_list import PriceList
from ldcnd.line.exchange import Exchange

ANY_ADDRESS = 1
"""The price is the same at every address."""


def price_list(model: str, baud: int, codes: BaudCodes = BaudCodes.MANUAL, clock_hz: int = CLOCK_HZ) -> PriceList:
    """Return the exchanges of a module at a rate.

    Args:
        model: a key of `PROFILES`.
        baud: nominal rate.
        codes: the family of baud rate divisors in use.
        clock_hz: of the module.

    Raises:
        ValueOutOfRange: no divisor makes this rate.
    """
    profile = at_clock(PROFILES[model], clock_hz)
    node = Node(ANY_ADDRESS, profile)
    everything = StatusItem.POSITION | StatusItem.ADC | StatusItem.VELOCITY | StatusItem.AUX | StatusItem.HOME
    common = {
        "read status, all items": commands.read_status(node, everything | StatusItem(0xE0)),
        "no operation": commands.no_operation(node),
    }
    full = profile.support is Support.FULL
    return PriceList(
        node_baud=actual_baud(baud_divisor(baud, codes, clock_hz), clock_hz),
        reading=partial(_reading, node),
        commands=MappingProxyType(common | (_servo_commands(node) if full else {})),
        probe=read_identity(ANY_ADDRESS),
        stop=commands.stop_motor(node, StopControl.AMP_ENABLE | StopControl.SMOOTH) if full else None,
        flush=NULLS,
        settle_s=NULLS_SETTLE_S,
    )


def _reading(node: Node, items: frozenset[TelemetryItem]) -> Exchange[Any]:
    return commands.read_status(node, reading_items(node.profile, items))


def _servo_commands(node: Node) -> dict[str, Exchange[Any]]:
    trajectory = Trajectory(
        position=0,
        velocity=0,
        acceleration=1,
        pwm_or_target=0,
        servo=True,
        mode=ProfileMode.TRAPEZOIDAL,
        reverse=False,
        start_now=False,
    )
    gains = Gains(kp=1, kd=0, ki=0, il=0, ol=255, cl=0, el=1, sr=1, deadband=0)
    return {
        "load trajectory": commands.load_trajectory(node, trajectory),
        "start motion": commands.start_motion(node),
        "set gain": commands.set_gain(node, gains),
        "stop motor": commands.stop_motor(node, StopControl.AMP_ENABLE | StopControl.SMOOTH),
        "set homing": commands.set_homing(node, HomingControl(0)),
        "clear sticky bits": commands.clear_sticky_bits(node),
        "save home": commands.save_home(node),
    }
