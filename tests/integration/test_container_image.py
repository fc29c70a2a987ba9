"""The image, built and run by the engine that this machine has; skipped with the reason where it has none.

`CONTAINER_ENGINE` names another engine, with its options; `CONTAINER_BUILD` and `CONTAINER_RUN` are more options of the
build, such as another base image, and of the run.
"""

import asyncio
import os
import shlex
import shutil
import subprocess
import uuid
from collections.abc import Iterator

import pytest

from ldcnd.model.samples import LinkState
from tests.support.process import ROOT, START_TIME_S, client, free_port

pytestmark = [pytest.mark.soak, pytest.mark.real_time, pytest.mark.timeout(2400)]

NAME = f"ldcnd-{uuid.uuid4().hex[:8]}"
BUILD_S = 1800.0
CONFINED = (
    "--network",
    "host",
    "--read-only",
    "--cap-drop",
    "ALL",
    "--security-opt",
    "no-new-privileges",
    "--tmpfs",
    "/tmp",  # noqa: S108 - of the container
)
UNREACHABLE = (
    "no such host",
    "dial tcp",
    "i/o timeout",
    "connection refused",
    "toomanyrequests",
    "certificate",
    "denied",
)


def options(name: str, default: str = "") -> list[str]:
    return shlex.split(os.environ.get(name, default))


def engine() -> list[str]:
    """Return the command of an engine that answers; skips without one."""
    why = "no docker and no podman"
    for command in (options("CONTAINER_ENGINE"), ["docker"], ["podman"]):
        if command and shutil.which(command[0]):
            done = run(*command, "info")
            if done.returncode == 0:
                return command
            why = f"{command[0]}: {(done.stderr.strip() or 'no answer').splitlines()[-1]}"
    pytest.skip(why)


def run(*command: str, within_s: float = 60.0) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(command, capture_output=True, text=True, timeout=within_s, check=False, cwd=ROOT)  # noqa: S603


@pytest.fixture(scope="module")
def image() -> Iterator[list[str]]:
    """Build the image; yields the engine. Skips where it cannot be fetched, or the engine runs nothing."""
    command = engine()
    file = ("-f", "deploy/container/Dockerfile", "-t", NAME)
    built = run(*command, "build", *options("CONTAINER_BUILD"), *file, ".", within_s=BUILD_S)
    if built.returncode and any(word in built.stderr for word in UNREACHABLE):
        pytest.skip(f"what the image is made of cannot be fetched: {built.stderr.strip().splitlines()[-1]}")
    assert built.returncode == 0, built.stderr[-2000:]
    try:
        trial = run(*command, "run", "--rm", *options("CONTAINER_RUN"), *CONFINED, NAME, "--version")
        if trial.returncode in {125, 126, 127}:  # of the engine itself
            pytest.skip(f"{command[0]} runs nothing here: {trial.stderr.strip().splitlines()[-1]}")
        assert trial.returncode == 0, trial.stderr
        yield command
    finally:
        run(*command, "rmi", "--force", NAME)


async def test_the_image_serves_a_rig_without_root_and_without_writing(image):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    began = ("run", "--detach", "--name", NAME, *options("CONTAINER_RUN"), *CONFINED, NAME)
    started = run(*image, *began, "run", "--config", "/etc/ldcnd/rig.toml", "--listen", endpoint)
    assert started.returncode == 0, started.stderr
    try:
        async with client(endpoint) as rig, asyncio.timeout(START_TIME_S):
            while (state := await rig.state("x")) is None or state.link is not LinkState.UP:
                await asyncio.sleep(0.2)
        inside = [*image, "exec", NAME]
        user = run(*inside, "id", "-u").stdout.strip()
        written = run(*inside, "touch", "/opt/here").returncode
        healthy = run(*inside, "ldcnd", "axis", "list", "-e", endpoint, within_s=START_TIME_S)
    finally:
        ended = run(*image, "stop", "--time", "30", NAME)
        log = run(*image, "logs", NAME)
        run(*image, "rm", "--force", NAME)

    assert user == "64801"
    assert written != 0
    assert healthy.returncode == 0, healthy.stderr
    assert ended.returncode == 0
    assert "ended" in log.stdout + log.stderr  # in order, at the signal of the engine
