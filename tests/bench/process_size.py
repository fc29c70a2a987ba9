"""How soon a daemon publishes, and how large its process is and stays, with 4 and with 31 axes at their default rates.

Run as `python -m tests.bench.process_size` for the first, with `--minutes 60 --log FILE` for the second. The drives are
simulated in the daemon's own process, which makes it larger, and one remote client takes all samples. Starts are those
of an installed daemon, whose bytecode is there: a first one that does not count writes it. By how much it grows is what
a least-squares line through the second half of the minutes says: the first five fill the flight recorder.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from ldcnd.drives.line_config import BusConfig
from tests.bench.processes import ROOT, free_endpoint
from tests.bench.report import Row, table

AXES = (4, 31)
MOST_MB = {4: 75.0, 31: 95.0}
MOST_GROWTH_MB_PER_HOUR = 1.0
FIRST_SAMPLE_S = 1.0
STARTS = 5
PATIENCE_S = 600.0
KEY = "ldcn/size/tele/**"
TOKENS = "ldcn/size/alive/*"
BUSY_MARGIN_MS = 50
"""For hours on a machine that has other work; bring-up takes up to half a second longer with it."""


def rig_text(axes: int, margin_ms: float) -> str:
    """Return the configuration of a rig with one simulated line of so many drives, at the default rates."""
    text = f'rig = "size"\n[[bus]]\nname = "line0"\nport = "sim:line0"\nbaud = 115200\nmargin_ms = {margin_ms:g}\n'
    text += 'overload = "skip"\n'
    for number in range(1, axes + 1):
        text += f'[[bus.axis]]\nname = "a{number}"\naddress = {number}\nmodel = "ls-182ap"\n'
        text += "velocity = 1\nacceleration = 1\n"
    modules = ", ".join(['{ model = "ls-182ap" }'] * axes)
    return f'{text}[[sim]]\nname = "line0"\nmodule = [{modules}]\n'


@dataclass
class Watched:
    """A daemon, what a client has of it, and its size at each minute.

    Attributes:
        serving_s: from the start of its process until it opens its lines and answers.
        first_s: from the start of its process to its first sample in the client.
        sizes_mb: resident size.
    """

    axes: int
    running: subprocess.Popen
    first: threading.Event
    serving_s: float = 0.0
    first_s: float = 0.0
    received: int = 0
    sizes_mb: list[float] = field(default_factory=list)

    def look(self) -> None:
        """Note its resident size."""
        pages = int(Path(f"/proc/{self.running.pid}/statm").read_text().split()[1])
        self.sizes_mb.append(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)

    @property
    def growth_mb_per_hour(self) -> float:
        """By how much it grows, in the second half of the minutes."""
        later = self.sizes_mb[len(self.sizes_mb) // 2 :]
        if len(later) < 2:
            return 0.0
        return statistics.linear_regression(range(len(later)), later).slope * 60


@contextmanager
def watched(axes: int, folder: Path, margin_ms: float) -> Iterator[Watched]:
    """Run a daemon that connects to a client that waits for it."""
    endpoint = free_endpoint()
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    bytecode = {"PYTHONPYCACHEPREFIX": str(folder / "bytecode"), "PYTHONDONTWRITEBYTECODE": ""}
    path = folder / f"{axes}.toml"
    path.write_text(rig_text(axes, margin_ms))
    own = free_endpoint()
    command = (sys.executable, "-m", "ldcnd", "run", "--log-level", "error", "--config", str(path))
    with zenoh.open(config) as session:
        found: list[Watched] = []
        first = threading.Event()
        began_s = 0.0

        def take(_sample: zenoh.Sample) -> None:
            if not first.is_set():
                found[0].first_s = time.monotonic() - began_s
                first.set()
            found[0].received += 1

        def see(_token: zenoh.Sample) -> None:
            if not first.is_set():
                found[0].serving_s = time.monotonic() - began_s

        subscriber = session.declare_subscriber(KEY, take)
        watch = session.liveliness().declare_subscriber(TOKENS, see)
        began_s = time.monotonic()
        listening = (*command, "--listen", own, "--connect", endpoint)
        with subprocess.Popen(listening, cwd=ROOT, env=os.environ | bytecode) as running:  # noqa: S603
            found.append(Watched(axes, running, first))
            try:
                if not first.wait(PATIENCE_S):
                    raise RuntimeError(f"no sample of {axes} axes within {PATIENCE_S:g} s")
                yield found[0]
            finally:
                running.terminate()
                del subscriber, watch


def first_sample_rows(folder: Path) -> list[Row]:
    """Start a daemon of four axes a few times."""
    serving, taken = [], []
    for _ in range(1 + STARTS):
        with watched(4, folder, BusConfig.model_fields["margin_ms"].default) as daemon:
            serving.append(daemon.serving_s)
            taken.append(daemon.first_s)
    del serving[0], taken[0]
    what = "from the start of a daemon with 4 axes"
    return [
        Row(f"{what} until it opens its line, best of {STARTS}", min(serving), "s"),
        Row(f"{what} to its first sample, best of {STARTS}", min(taken), "s", FIRST_SAMPLE_S, at_most=True),
        Row(f"{what} to its first sample, median", statistics.median(taken), "s"),
    ]


def size_rows(folder: Path, minutes: int, log: Path | None) -> list[Row]:
    """Watch both sizes side by side."""
    with ExitStack() as stack:
        daemons = [stack.enter_context(watched(axes, folder, BUSY_MARGIN_MS)) for axes in AXES]
        for minute in range(minutes):
            time.sleep(60)
            for daemon in daemons:
                daemon.look()
            if log:
                with log.open("a") as stream:
                    sizes = " ".join(f"{daemon.sizes_mb[-1]:.2f} MB ({daemon.received})" for daemon in daemons)
                    stream.write(f"{minute + 1} {sizes}\n")
        rows = []
        for daemon in daemons:
            what = f"{daemon.axes} axes, {minutes} minutes"
            growth = daemon.growth_mb_per_hour
            rows += [
                Row(f"{what}: resident size", daemon.sizes_mb[-1], "MB", MOST_MB[daemon.axes], at_most=True),
                Row(f"{what}: growth in the second half", growth, "MB/h", MOST_GROWTH_MB_PER_HOUR, at_most=True),
            ]
        return rows


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=int, default=0, help="watch the sizes for so long; otherwise the starts")
    parser.add_argument("--log", type=Path, help="append the sizes of each minute here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        rows = size_rows(Path(name), options.minutes, options.log) if options.minutes else first_sample_rows(Path(name))
        print(table(rows))


if __name__ == "__main__":
    main()
