"""How fast simulated lines of 1, 8 and 31 moving servo modules run.

Run as `python -m tests.bench.sim_speed`. Two questions:

* on a virtual clock: how much faster than real time, alone and while a host polls as fast as the line allows;
* behind a pseudo-terminal: which share of a processor core, with every drive moving and polled without a pause, and
  with nothing to do.
"""

import argparse
import asyncio
import os
import select
import subprocess
import sys
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

from ldcnd.drives.driver import AxisSpec, CountsMotion, Gains, Moves
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.network import ldcn_line
from ldcnd.drives.ldcn.packet import StatusItem
from ldcnd.drives.ldcn.profiles import LS_182AP
from ldcnd.line.settings import BusSettings
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import build_chain
from ldcnd.sim.ldcn.simulation import SimulatedModuleConfig, SimulationConfig
from ldcnd.sim.line import open_simulated_line
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.rough_host import enumeration, frame, jog, powered

COUNTS = (1, 8, 31)
GAINS = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1, deadband=0)
BAUD = 115_200
VIRTUAL_S = 5.0
REAL_S = 3.0
FAR = 1 << 29
REPLY_BYTES = 8
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Speed:
    """What was measured with one number of modules.

    Attributes:
        unpolled: virtual seconds per second of processor time with every drive moving and no traffic.
        saturated: the same while polls saturate the line.
        exchange_us: processor time of one such poll, host and simulation together.
        busy_core: share of a core of `ldcnd sim`, every drive moving and polled without a pause.
        quiet_core: the same with every drive at rest and no traffic.
    """

    modules: int
    unpolled: float
    saturated: float
    exchange_us: float
    busy_core: float
    quiet_core: float


def measure(modules: int) -> Speed:
    """Measure with so many modules; takes about ten seconds."""
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        unpolled, saturated, exchange_us = runner.run(_virtual(modules))
    busy_core, quiet_core = _terminal(modules)
    return Speed(modules, unpolled, saturated, exchange_us, busy_core, quiet_core)


def main() -> None:
    """Print a table."""
    print(
        f"{'modules':>8} {'unpolled':>10} {'saturated':>10} {'us/exchange':>12} {'core, busy':>11} {'core, quiet':>12}"
    )
    for count in COUNTS:
        speed = measure(count)
        print(
            f"{speed.modules:8} {speed.unpolled:9.1f}x {speed.saturated:9.1f}x {speed.exchange_us:12.1f} "
            f"{speed.busy_core:10.1%} {speed.quiet_core:11.1%}"
        )


def _chain(modules: int) -> Chain:
    return build_chain(SimulationConfig(module=(SimulatedModuleConfig(model="ls182ap"),) * modules).spec())


async def _virtual(modules: int) -> tuple[float, float, float]:
    chain = _chain(modules)
    specs = tuple(AxisSpec(f"a{number}", number, LS_182AP.name, GAINS) for number in range(1, modules + 1))
    bus, network = ldcn_line(BusSettings("bench", 19_200), lambda: open_simulated_line(chain), specs, BAUD)
    async with asyncio.TaskGroup() as group:
        running = group.create_task(bus.run(), name="bus")
        await bus.wait_opened()
        await network.bring_up()
        for drive in network.axes.values():
            assert isinstance(drive, Moves)
            await drive.power(on=True)
            await drive.load(CountsMotion(FAR, 20_000.0, 200_000.0))
            await drive.start()
        loop = asyncio.get_running_loop()

        began_s = time.process_time()
        for module in chain.modules:
            module.catch_up(loop.time() + VIRTUAL_S)
        unpolled = VIRTUAL_S / (time.process_time() - began_s)
        await asyncio.sleep(VIRTUAL_S)

        began_s, from_s, count = time.process_time(), loop.time(), 0
        for spec in cycle(specs):
            await bus.execute(
                commands.read_status(Node(spec.address, LS_182AP), StatusItem.POSITION | StatusItem.VELOCITY)
            )
            count += 1
            if loop.time() >= from_s + VIRTUAL_S:
                break
        took_s = time.process_time() - began_s
        running.cancel()
    return unpolled, VIRTUAL_S / took_s, took_s / count * 1e6


def _terminal(modules: int) -> tuple[float, float]:
    """Return the shares of a core, busy and quiet."""
    command = [sys.executable, "-m", "ldcnd", "sim", "--file", "/dev/stdin"]
    text = "[[module]]\nmodel = 'ls182ap'\n" * modules
    with subprocess.Popen(  # noqa: S603 - our own program
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin
        assert process.stdout
        process.stdin.write(text)
        process.stdin.close()
        port = os.open(process.stdout.readline().strip(), os.O_RDWR | os.O_NOCTTY)
        try:
            tty.setraw(port)
            for deed in enumeration(modules):
                _ask(port, deed.data, 2 if deed.data[2] & 0xF == 1 else 4)
            quiet = _core_share(process.pid, lambda: time.sleep(0.05))
            # the terminal carries no rate here: the chain runs at that of its modules
            os.write(port, frame(0xFF, 0xA, 0x0A))
            time.sleep(0.05)
            for address in range(1, modules + 1):
                for deed in (*powered(address), *jog(address, 3 << 16)):
                    _ask(port, deed.data, 2)
            polls = cycle([frame(address, 0x3, 0x05) for address in range(1, modules + 1)])
            busy = _core_share(process.pid, lambda: _ask(port, next(polls), REPLY_BYTES))
        finally:
            os.close(port)
            process.terminate()
    return busy, quiet


def _ask(port: int, request: bytes, reply_bytes: int) -> None:
    os.write(port, request)
    while reply_bytes > 0:
        if not select.select([port], [], [], 2.0)[0]:
            raise TimeoutError(f"no reply to {request.hex()}")
        reply_bytes -= len(os.read(port, reply_bytes))


def _core_share(process: int, work: Callable[[], object]) -> float:
    began_s, used_s = time.perf_counter(), _processor_s(process)
    while time.perf_counter() < began_s + REAL_S:
        work()
    return (_processor_s(process) - used_s) / (time.perf_counter() - began_s)


def _processor_s(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    main()
