"""What twenty interlocks cost a move and a poll, beside the same machine with none."""

import asyncio

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Halt, MoveVelocity, Power
from ldcnd.contract.rig_commands import SetIo
from ldcnd.contract.samples import AxisState
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.bench.counts import counted
from tests.bench.report import Row
from tests.support.machine_rig import Machine, machine, running_machine

KINDS: tuple[tuple[str, float | None, dict[str, object]], ...] = (
    ("rotor", None, {"input": "door_closed"}),
    ("rotor", 1.0, {"output": "lock"}),
    ("table", None, {"axis": "rotor", "below": 50.0}),
    ("lock", None, {"axis": "rotor", "standstill": True}),
)
RULES: list[dict[str, object]] = [
    {"name": f"{of}{number}", "of": of, "above": above, "requires": [requirement]}
    for number, (of, above, requirement) in enumerate(KINDS * 5)
]
MOVES, POLLS_S = 20, 4.0
MOST_RATIO = 1.05


def rows() -> list[Row]:
    """Return the bytecodes and calls of a move and a poll with rules and without, and their ratios."""
    with_rules, without = _measure(machine(*RULES)), _measure(machine())
    return [
        row
        for what, value in with_rules.items()
        for row in (
            Row(f"{what}, 20 interlocks", value, exact=True),
            Row(f"{what}, none", without[what], exact=True),
            Row(f"{what}, 20 interlocks / none", value / without[what], "", MOST_RATIO, at_most=True, exact=True),
        )
    ]


def _measure(config: RigConfig) -> dict[str, float]:
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        return runner.run(_costs(config))


async def _costs(config: RigConfig) -> dict[str, float]:
    async with running_machine(config) as rig:
        await asyncio.sleep(1.0)  # until the rotor is known to stand
        await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
        await rig.named(lock=True)
        await rig.client.command("rotor", Power(on=True))
        moves = [await _move(rig) for _ in range(MOVES)]
        statistics = rig.daemon.rig.buses[0].bus.statistics
        await rig.client.command("rotor", MoveVelocity(velocity=5.0))
        await asyncio.sleep(1.0)
        replies = statistics.replies
        with counted() as polls:
            await asyncio.sleep(POLLS_S)
        replies = statistics.replies - replies
    return {
        "calls of a move": sum(calls for calls, _ in moves) / MOVES,
        "bytecodes of a move": sum(codes for _, codes in moves) / MOVES,
        "calls of a poll in motion": polls.calls / replies,
        "bytecodes of a poll in motion": polls.bytecodes / replies,
    }


async def _move(rig: Machine) -> tuple[int, int]:
    with counted() as count:
        await rig.client.command("rotor", MoveVelocity(velocity=5.0))
    await rig.client.command("rotor", Halt())
    await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL)
    return count.calls, count.bytecodes
