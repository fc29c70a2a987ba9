"""A daemon in a process of its own behind one of the set-ups of config/zenoh, and logins to it."""

import contextlib
import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from tests.support.process import LDCND, ROOT

SETUPS = ROOT / "config" / "zenoh"
START_TIME_S = 30.0
END_TIME_S = 15.0


@dataclass(frozen=True, slots=True)
class SecuredRig:
    """A running daemon.

    Attributes:
        folder: with the Zenoh configurations of its logins.
        endpoints: where a login connects; the first of them when it is not named here.
    """

    folder: Path
    endpoint: str
    endpoints: dict[str, str] = field(default_factory=dict)

    def endpoint_of(self, login: str) -> str:
        """Return where a login connects."""
        return self.endpoints.get(login, self.endpoint)

    def config(self, login: str) -> zenoh.Config:
        """Return the configuration of a login, with the endpoint of this test."""
        config = zenoh.Config.from_file(self.folder / f"{login}.json5")
        config.insert_json5("connect/endpoints", json.dumps([self.endpoint_of(login)]))
        return config

    @contextlib.contextmanager
    def login(self, name: str) -> Iterator[zenoh.Session]:
        """Connect with a login."""
        with zenoh.open(self.config(name)) as session:
            yield session


def copy_setup(name: str, folder: Path) -> Path:
    """Copy one of the set-ups of config/zenoh, with file names that hold wherever the test runs."""
    copied = folder / name
    shutil.copytree(SETUPS / name, copied)
    for file in copied.glob("*.json5"):
        text = re.sub(r'"([a-z]+\.(?:pem|key|txt))"', rf'"{copied}/\1"', file.read_text())
        file.write_text(text)
    return copied


@contextlib.contextmanager
def serving(zenoh_file: Path, listen: Sequence[str], ready: zenoh.Config) -> Iterator[subprocess.Popen[bytes]]:
    """Run the simulated rig behind a Zenoh configuration until the context ends.

    Args:
        zenoh_file: its configuration.
        listen: where it listens instead.
        ready: of a login that can read; the daemon serves when it gets an answer.
    """
    rig = zenoh_file.parent / "rig.toml"
    text = (ROOT / "config" / "simulated.toml").read_text()
    assert 'listen = ["tcp/127.0.0.1:7447"]' in text
    rig.write_text(text.replace('listen = ["tcp/127.0.0.1:7447"]', f'config_file = "{zenoh_file.name}"'))
    options = [word for endpoint in listen for word in ("--listen", endpoint)]
    log = (zenoh_file.parent / "daemon.log").open("wb")
    daemon = subprocess.Popen(  # noqa: S603 - our own program
        [*LDCND, "run", "--config", str(rig), *options], cwd="/", stdout=log, stderr=subprocess.STDOUT
    )
    try:
        until_serving(ready, daemon, zenoh_file.parent / "daemon.log")
        yield daemon
    finally:
        daemon.terminate()
        try:
            daemon.wait(END_TIME_S)
        finally:
            daemon.kill()
            daemon.wait()
            log.close()


def until_serving(login: zenoh.Config, daemon: "subprocess.Popen[bytes]", log: Path) -> None:
    """Wait until a login sees that every axis of the rig answers."""
    deadline_s = time.monotonic() + START_TIME_S
    while time.monotonic() < deadline_s:
        assert daemon.poll() is None, f"the daemon has ended: {log.read_text()}"
        with contextlib.suppress(zenoh.ZError), zenoh.open(login) as session:
            states = answers(session, "ldcn/sim/tele/*/state")
            if len(states) == 4 and all(json.loads(state)["link"] == "up" for state in states.values()):
                return
        time.sleep(0.1)  # nothing tells a client that a port has begun to listen
    raise TimeoutError(f"the daemon does not serve: {log.read_text()}")


def answers(session: zenoh.Session, selector: str, payload: object = None, timeout_s: float = 5.0) -> dict[str, str]:
    """Return the good answers by key, as text."""
    text = None if payload is None else json.dumps(payload)
    replies = session.get(selector, payload=text, encoding="application/json", timeout=timeout_s)
    return {str(reply.ok.key_expr): reply.ok.payload.to_string() for reply in replies if reply.ok is not None}


def refusals(session: zenoh.Session, selector: str, payload: object = None) -> list[str]:
    """Return the error answers, as text."""
    replies = session.get(selector, payload=json.dumps(payload), encoding="application/json", timeout=5)
    return [reply.err.payload.to_string() for reply in replies if reply.err is not None]
