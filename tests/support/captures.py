"""The captures that are kept as test data, and how they are recorded: `python -m tests.support.captures` does it anew.

NAME.toml is the rig, NAME.capture what was on its line, NAME.jsonl what its daemon published meanwhile.
"""

import argparse
import asyncio
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.capture import config_of, lines_of
from ldcnd.line.capture import Capture
from ldcnd.net.session import Publication
from ldcnd.testing.jumping_loop import JumpingLoop
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.replay import play, published_line, virtual_time

FOLDER = Path(__file__).parents[1] / "captures"
NAMES = ("clean_start", "power_loss", "corrupted_line")
EPOCH_NS = 1_700_000_000_000_000_000
STARTS_AT_S = 86_400.25
"""The recorded machine was up for a day already."""
POWERED_AT_S, MOVED_AT_S, LENGTH_S = 1.7503, 2.0007, 5.0
"""After the start of the daemon; what happens to the line in between is in the rigs' files."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A capture, its text, and what was published, one line each."""

    capture: Capture
    text: str
    published: tuple[str, ...]


def record(name: str) -> Recording:
    """Run the rig on the jumping clock: switch x on, move it, and watch it."""
    with asyncio.Runner(loop_factory=lambda: JumpingLoop(STARTS_AT_S)) as runner:
        return runner.run(_record(name))


def replayed(capture: Capture, config: RigConfig | None = None) -> tuple[str, ...]:
    """Play a capture on the jumping clock and return what was published, one line each."""
    lines: list[str] = []
    config = config or config_of(capture.header)
    with asyncio.Runner(loop_factory=lambda: virtual_time(capture)) as runner:
        runner.run(play(capture, config, lambda sample: lines.append(published_line(sample))))
    return tuple(lines)


async def _record(name: str) -> Recording:
    config = load_config(FOLDER / f"{name}.toml")
    loop = asyncio.get_running_loop()
    published: list[str] = []

    def now_ns() -> int:
        return EPOCH_NS + round(loop.time() * 1e9)

    def take(sample: Publication) -> None:
        published.append(published_line(sample))

    broker = MemoryBroker()
    async with broker.session() as clients, broker.session(overhear=take) as session, asyncio.TaskGroup() as group:
        daemon = build_daemon(config, session, now_ns, "recorded")
        running = group.create_task(daemon.run(), name="daemon")
        await daemon.wait_up()
        client = RigClient(clients, config.rig)
        await asyncio.sleep(STARTS_AT_S + POWERED_AT_S - loop.time())
        await client.command("x", Power(on=True))
        await asyncio.sleep(STARTS_AT_S + MOVED_AT_S - loop.time())
        await client.command("x", MoveAbsolute(position=15.0, client="bench"))
        await asyncio.sleep(STARTS_AT_S + LENGTH_S - loop.time())
        capture = daemon.capture("line0", "test data")
        kept = tuple(published)
        running.cancel()
    return Recording(capture, "".join(f"{line}\n" for line in lines_of(capture, config)), kept)


def _files() -> Iterator[tuple[Path, str]]:
    for name in NAMES:
        recording = record(name)
        yield FOLDER / f"{name}.capture", recording.text
        yield FOLDER / f"{name}.jsonl", "".join(f"{line}\n" for line in recording.published)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    for path, text in _files():
        path.write_text(text, encoding="utf-8")
