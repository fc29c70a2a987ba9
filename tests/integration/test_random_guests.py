"""Whatever a program on a port, a client and the cable do: see `tests.support.random_guests`."""

import pytest

from tests.support.guest_program import with_port
from tests.support.machine_rig import running_machine
from tests.support.random_guests import World

ROUNDS = 50


@pytest.mark.parametrize(
    ("seed", "rounds"),
    [
        *((seed, ROUNDS) for seed in range(3)),
        pytest.param(100, 20_000, marks=[pytest.mark.soak, pytest.mark.timeout(7200)]),
    ],
)
async def test_nothing_moves_without_permission_whatever_a_program_does(tmp_path, seed, rounds):
    async with running_machine(with_port(tmp_path / "port", "control")) as rig:
        world = World(rig, tmp_path / "port", seed)
        try:
            for _ in range(rounds):
                await world.round()
            await world.end()
        except BaseException:
            print(f"seed {seed}, round {len(world.history)}: {', '.join(world.history[-12:])}")
            raise
