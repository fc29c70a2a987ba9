"""Two hundred clients hammer one axis while stop is called every second, on the jumping clock."""

import asyncio
import random
from collections import Counter

import pytest

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import Halt, MoveAbsolute, MoveRelative, MoveVelocity, Power, Reset
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import AxisState
from tests.support.rig import running_rig

CLIENTS = 200
LONGEST_EXCHANGE_S = (5 + 12) * 10 / 115_200 + 0.000512 + 0.0015
"""A poll of position, velocity, state and A/D on the wire, one servo cycle, and the time a start is lingered over."""
STOP_EXCHANGES = 2
"""The stop itself, and disarming a homing."""
REQUESTS = (
    Power(on=True),
    MoveAbsolute(position=20.0),
    MoveRelative(distance=-1.0),
    MoveVelocity(velocity=-10.0),
    Halt(),
    Reset(),
)


@pytest.mark.parametrize("duration_s", [5.0, pytest.param(20.0, marks=pytest.mark.soak)])
@pytest.mark.long
async def test_every_query_gets_one_answer_and_every_stop_keeps_its_bound(duration_s):
    dice = random.Random(5)
    answers: Counter[str] = Counter()
    waits_s = []

    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link == "up")
        loop = asyncio.get_running_loop()
        until_s = loop.time() + duration_s

        async def hammer(number: int) -> None:
            async with rig.broker.session() as session:
                client = RigClient(session, "sim")
                while loop.time() < until_s:
                    request = dice.choice(REQUESTS)
                    answers["sent"] += 1
                    try:
                        await client.command("x", request.model_copy(update={"client": f"client {number}"}))
                        answers["accepted"] += 1
                    except LdcndError as error:
                        answers[error.code.value] += 1
                    await asyncio.sleep(dice.uniform(1.0, 5.0))

        async def stop() -> None:
            while loop.time() < until_s:
                await asyncio.sleep(1.0)
                asked_s = loop.time()
                reply = await rig.client.stop("x")
                waits_s.append(loop.time() - asked_s)
                assert reply.confirmed == ("x",)

        async with asyncio.TaskGroup() as group:
            group.create_task(stop(), name="stop")
            for number in range(CLIENTS):
                group.create_task(hammer(number), name=f"client {number}")
        await rig.until("x", lambda state: state.state in (AxisState.STANDSTILL, AxisState.DISABLED))

    print(answers, f"longest stop {max(waits_s) * 1e3:.2f} ms")
    assert answers["sent"] == sum(answers.values()) - answers["sent"]
    assert answers["sent"] > 60 * duration_s
    assert answers["accepted"] > duration_s
    assert answers["internal"] == answers["outcome_unknown"] == 0
    assert len(waits_s) >= duration_s - 2
    assert max(waits_s) <= (1 + STOP_EXCHANGES) * LONGEST_EXCHANGE_S
