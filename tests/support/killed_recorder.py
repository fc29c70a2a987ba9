"""A process that records a rig on the jumping clock and kills itself, without any goodbye, in the middle.

Run as `python -m tests.support.killed_recorder FILE SECONDS AXES`; prints how many values it had recorded at its last
flush, and how many in all.
"""

import argparse
import asyncio
import os
import signal
from pathlib import Path

from ldcnd.lab.recording.mcap_file import McapFile
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.recordings import recorded_rig, thirty_one_axes

MOST_AXES = 31


async def record_and_die(path: Path, seconds: float, axes: int) -> None:
    """Record for so long, then die."""
    async with recorded_rig(path, thirty_one_axes(20.0) if axes == MOST_AXES else None) as recorded:
        flushed = 0
        flush = McapFile.flush

        def counted(file: McapFile) -> None:
            nonlocal flushed
            flush(file)
            flushed = recorded.recorder.messages

        setattr(McapFile, "flush", counted)  # noqa: B010 - a method; nobody else tells where the last chunk ended
        await asyncio.sleep(seconds)
        print(flushed, recorded.recorder.messages, flush=True)
        os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("seconds", type=float)
    parser.add_argument("axes", type=int)
    options = parser.parse_args()
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        runner.run(record_and_die(options.file, options.seconds, options.axes))
