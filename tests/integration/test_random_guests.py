"""Whatever a program on a port, a client and the cable do: see `tests.support.random_guests`."""

from pathlib import Path

import pytest

from tests.support.guest_program import with_port
from tests.support.machine_rig import running_machine
from tests.support.random_guests import World

ROUNDS = 50


async def one_history(folder: Path, seed: int, rounds: int) -> None:
    async with running_machine(with_port(folder / "port", "control")) as rig:
        world = World(rig, folder / "port", seed)
        try:
            for _ in range(rounds):
                await world.round()
            await world.end()
        except BaseException:
            print(f"seed {seed}, round {len(world.history)}: {', '.join(world.history[-12:])}")
            raise


@pytest.mark.parametrize("seed", [*range(6), 1568])
async def test_nothing_moves_without_permission_whatever_a_program_does(tmp_path, seed):
    await one_history(tmp_path, seed, ROUNDS)


@pytest.mark.soak
@pytest.mark.timeout(7200)
async def test_nothing_moves_without_permission_in_many_histories(tmp_path, seeds):
    for seed in seeds:
        folder = tmp_path / str(seed)
        folder.mkdir()
        await one_history(folder, seed, ROUNDS)
