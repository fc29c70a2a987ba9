"""Clients on bare Zenoh that read as much as they can, or ask and then stop reading; each in a process of its own.

Run as `python -m tests.bench.reading_clients ENDPOINT SELECTOR LINKS OUTSTANDING [--freeze SECONDS]`. Prints `reading`
once every link has had an answer. With `--freeze` each link asks all at once, reads nothing for so long, and is then
replaced by a new one.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import zenoh
from zenoh.handlers import Callback


def session(endpoint: str) -> zenoh.Session:
    """Connect as a client and nothing else."""
    client = {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(client)))


def _ignore(_reply: zenoh.Reply) -> None:
    """Have the link read an answer and nothing else."""


def read(link: zenoh.Session, selector: str, outstanding: int, answered: threading.Semaphore) -> None:
    """Keep so many queries unanswered for good."""
    ended = threading.Semaphore(0)
    while True:
        for _ in range(outstanding):
            link.get(selector, Callback(_ignore, ended.release, indirect=False), timeout=10.0)
            outstanding = 0
        ended.acquire()
        answered.release()
        outstanding = 1


def ask_and_freeze(endpoint: str, selector: str, outstanding: int) -> None:
    """Ask so many times, then stop as a whole: nothing is read any more."""
    link = session(endpoint)
    for _ in range(outstanding):
        link.get(selector, Callback(_ignore, lambda: None, indirect=False), timeout=10.0)
    print("asked", flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)


def replace_for_good(command: list[str], freeze_s: float, frozen: threading.Semaphore) -> None:
    """Run frozen links one after another."""
    while True:
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as link:  # noqa: S603
            assert link.stdout
            link.stdout.readline()
            frozen.release()
            time.sleep(freeze_s)
            link.kill()


def main() -> None:
    """Read until killed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("endpoint")
    parser.add_argument("selector")
    parser.add_argument("links", type=int)
    parser.add_argument("outstanding", type=int)
    parser.add_argument("--freeze", type=float)
    options = parser.parse_args()
    if options.freeze == 0:
        ask_and_freeze(options.endpoint, options.selector, options.outstanding)
        return
    begun = threading.Semaphore(0)
    for _ in range(options.links):
        run: Callable[..., None]
        arguments: tuple[object, ...]
        if options.freeze:
            one = (options.endpoint, options.selector, "1", str(options.outstanding), "--freeze", "0")
            run, arguments = replace_for_good, ([sys.executable, "-m", __spec__.name, *one], options.freeze, begun)
        else:
            run, arguments = read, (session(options.endpoint), options.selector, options.outstanding, begun)
        threading.Thread(target=run, args=arguments, daemon=True).start()
    for _ in range(options.links):
        begun.acquire()
    print("reading", flush=True)
    signal.pause()


if __name__ == "__main__":
    main()
