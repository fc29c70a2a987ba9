"""What a newcomer runs, against a daemon in its own process over loopback TCP."""

import asyncio
import os
import struct
import sys
import time
from asyncio.subprocess import PIPE

import pytest

from tests.support.process import ROOT, daemon

pytestmark = [pytest.mark.system, pytest.mark.real_time]

EXAMPLE = ROOT / "examples" / "move_and_watch.py"


async def test_the_example_follows_a_moving_axis_to_its_target():
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        example = await asyncio.create_subprocess_exec(sys.executable, str(EXAMPLE), endpoint, stdout=PIPE)
        async with asyncio.timeout(30):
            printed, _ = await example.communicate()

    lines = printed.decode().splitlines()
    assert example.returncode == 0
    assert lines[0].startswith("accepted:")
    positions = [float(line.split()[0]) for line in lines[1:]]
    assert len(positions) > 5
    assert positions[-1] == pytest.approx(10.0, abs=0.005)
    assert any(0.5 < position < 9.5 for position in positions)


async def test_both_clients_move_under_a_lease_follow_the_motion_and_hear_why_they_are_refused():
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        programs = [
            await asyncio.create_subprocess_exec(
                sys.executable, str(ROOT / "examples" / f"client_{kind}.py"), endpoint, axis, stdout=PIPE
            )
            for kind, axis in (("asyncio", "x"), ("blocking", "y"))
        ]
        async with asyncio.timeout(45):
            told = [(await program.communicate())[0].decode().splitlines() for program in programs]

    assert [program.returncode for program in programs] == [0, 0]
    for *steps, ended, refused in told:
        left = [float(step.split()[2]) for step in steps]
        assert left  # of 2.5 s
        assert left[0] >= left[-1]
        assert ended.startswith("ended: standstill (")
        assert refused.startswith("refused: position_limit")


async def test_a_joystick_jogs_while_its_button_and_stick_are_held(tmp_path):
    device = tmp_path / "js0"
    os.mkfifo(device)
    stick, button = (struct.Struct("=IhBB").pack for _ in range(2))
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        example = await asyncio.create_subprocess_exec(
            sys.executable, str(ROOT / "examples" / "jog_by_joystick.py"), str(device), endpoint, "x", stdout=PIPE
        )
        with await asyncio.to_thread(device.open, "wb", buffering=0) as hand:
            hand.write(button(0, 1, 0x81, 0))  # as the kernel does when the device is opened
            hand.write(stick(0, -16_000, 0x82, 0))
            await tremble(hand, stick, 1.0)  # without the button nothing moves
            hand.write(button(0, 1, 1, 0))
            async with asyncio.timeout(30):
                assert await example.stdout.readline() == b"jogs\n"
                await tremble(hand, stick, 1.0)
                hand.write(button(0, 0, 1, 0))
                halted = await example.stdout.readline()
                hand.write(button(0, 1, 1, 0))
                assert await example.stdout.readline() == b"jogs\n"
                silent = await example.stdout.readline()  # its radio is gone
                began = time.monotonic()
                await tremble(hand, stick, 1.0)
                hand.write(button(0, 1, 1, 0))
                assert await example.stdout.readline() == b"jogs\n"
                assert time.monotonic() - began >= 1.0  # it did not go on by itself
        async with asyncio.timeout(30):
            unplugged, _ = await example.communicate()

    assert example.returncode == 0
    first, second, third = (float(line.split()[-1]) for line in (halted, silent, unplugged))
    assert -1.0 > first > -8.0
    assert first > second > first - 8.0
    assert second >= third > second - 8.0


async def tremble(hand, stick, seconds):
    """Hold the stick as a hand does: never quite still."""
    for number in range(int(seconds / 0.05)):
        hand.write(stick(0, -16_000 + number % 2, 2, 0))
        await asyncio.sleep(0.05)
