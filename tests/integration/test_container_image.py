"""The image, built and run by the engine that this machine has; skipped with the reason where it has none.

Where no registry of images can be reached, Debian's packages make the base. `CONTAINER_ENGINE` names another engine,
with its options; `CONTAINER_BUILD` and `CONTAINER_RUN` are more options of the build and of the run. Containers of
Podman have a network of their own; those of Docker need the usual ports of this machine.
"""

import os
import re
import shlex
import shutil
import subprocess
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from tests.support.process import ROOT, START_TIME_S

pytestmark = [pytest.mark.soak, pytest.mark.real_time, pytest.mark.timeout(2400)]

NAME = f"ldcnd-{uuid.uuid4().hex[:8]}"
FILE = ROOT / "deploy" / "container" / "Dockerfile"
BUILD_S = 1800.0
HYBRID = Path("/sys/fs/cgroup/unified")
TRUSTED = Path("/usr/local/share/ca-certificates")
LIMITS = ("--ulimit", "nofile=1024:1024", "--ulimit", "nproc=1024:1024")
"""An engine would raise them, which it may not do everywhere."""
OF_THE_ENGINE = {125, 126, 127}
"""Exit codes of a container that was not run."""
UNREACHABLE = (
    "no such host",
    "dial tcp",
    "i/o timeout",
    "connection refused",
    "toomanyrequests",
    "certificate",
    "denied",
    "short-name",
)


def options(name: str) -> list[str]:
    return shlex.split(os.environ.get(name, ""))


def run(*command: str, within_s: float = 60.0) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(command, capture_output=True, text=True, timeout=within_s, check=False, cwd=ROOT)  # noqa: S603


def last_line(done: "subprocess.CompletedProcess[str]") -> str:
    return (done.stderr.strip() or "no answer").splitlines()[-1]


@dataclass(frozen=True)
class Engine:
    """What commands begin with: those that make images, and those about containers."""

    images: list[str]
    containers: list[str]

    @classmethod
    @contextmanager
    def apart(cls, command: list[str]) -> "Iterator[Engine]":
        """Yield an engine for which cgroups have one version, crun refuses two, and the usual ports are free."""
        begin = (
            f"if [ -d {HYBRID} ]; then umount {HYBRID}; fi && ip link set lo up && echo ready && exec sleep infinity"
        )
        holder = subprocess.Popen(["unshare", "--mount", "--net", "sh", "-c", begin], stdout=subprocess.PIPE, text=True)  # noqa: S603, S607
        try:
            assert holder.stdout
            if holder.stdout.readline() != "ready\n":
                pytest.skip("a network of its own cannot be made")
            inside = ["nsenter", "--target", str(holder.pid), "--mount"]
            yield cls([*inside, *command], [*inside, "--net", *command])
        finally:
            holder.kill()
            holder.communicate()


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    """Return an engine that answers; skips without one."""
    why = "no docker and no podman"
    for command in (options("CONTAINER_ENGINE"), ["docker"], ["podman"]):
        if command and shutil.which(command[0]):
            done = run(*command, "info")
            if done.returncode == 0:
                with Engine.apart(command) if command == ["podman"] else nullcontext(Engine(command, command)) as made:
                    yield made
                return
            why = f"{command[0]}: {last_line(done)}"
    pytest.skip(why)


@contextmanager
def base(command: list[str], folder: Path) -> Iterator[list[str]]:
    """Make the base image of Debian's packages; yields the option of the build that takes it."""
    if not shutil.which("mmdebstrap"):
        pytest.skip("the base image cannot be fetched, and there is no mmdebstrap to make it")
    (suite,) = re.findall(r"(?m)^ARG BASE=debian:(\w+)-slim$", FILE.read_text())
    trusted = [f"--customize-hook=copy-in {TRUSTED} {TRUSTED.parent}"] if TRUSTED.is_dir() else []
    made = run("mmdebstrap", "--variant=minbase", *trusted, suite, f"{folder}/base.tar", within_s=BUILD_S)
    assert made.returncode == 0, made.stderr[-2000:]
    name = f"localhost/{NAME}-base:{suite}-slim"
    imported = run(*command, "import", f"{folder}/base.tar", name, within_s=BUILD_S)
    assert imported.returncode == 0, imported.stderr
    try:
        yield ["--build-arg", f"BASE={name}"]
    finally:
        run(*command, "rmi", "--force", name)


@pytest.fixture(scope="module")
def image(engine: Engine, tmp_path_factory) -> Iterator[list[str]]:
    """Build the image; yields what commands about containers begin with. Skips where the engine runs nothing."""
    with ExitStack() as made:
        more = options("CONTAINER_BUILD")
        if "podman" in engine.images:
            more += ["--format", "docker", "--layers=false"]  # OCI images have no health check
        build = (*engine.images, "build", *LIMITS, "--network", "host", "--file", str(FILE), "--tag", NAME)
        built = run(*build, *more, str(ROOT), within_s=BUILD_S)
        if built.returncode and "RUN" not in built.stdout and any(word in built.stderr for word in UNREACHABLE):
            more += made.enter_context(base(engine.images, tmp_path_factory.mktemp("base")))
            built = run(*build, *more, str(ROOT), within_s=BUILD_S)
        assert built.returncode == 0, built.stderr[-2000:]
        made.callback(run, *engine.images, "rmi", "--force", NAME)
        trial = run(*engine.containers, "run", "--rm", *options("CONTAINER_RUN"), *LIMITS, NAME, "--version")
        if trial.returncode in OF_THE_ENGINE:
            pytest.skip(f"{' '.join(engine.containers)} runs nothing here: {last_line(trial)}")
        assert trial.returncode == 0, trial.stderr
        yield engine.containers


@contextmanager
def service(image: list[str], name: str) -> Iterator[list[str]]:
    """Run a service as the compose file says it; yields what commands inside begin with."""
    said = yaml.safe_load((FILE.parent / "compose.yaml").read_text())["services"][name]
    assert {"image", "command", "network_mode", "read_only", "cap_drop", "security_opt", "tmpfs"} <= set(said)
    given = ["--network", said["network_mode"], *(["--read-only"] if said["read_only"] else [])]
    for option, key in (("--cap-drop", "cap_drop"), ("--security-opt", "security_opt"), ("--tmpfs", "tmpfs")):
        given += [word for value in said[key] for word in (option, value)]
    given += [word for value in said.get("volumes", []) for word in ("--volume", f"{NAME}-{value}")]
    full = f"{NAME}-{name}"
    command = [str(word) for word in said["command"]]
    started = run(*image, "run", "--detach", "--name", full, *options("CONTAINER_RUN"), *LIMITS, *given, NAME, *command)
    try:
        assert started.returncode == 0, started.stderr
        yield [*image, "exec", full]
    finally:
        run(*image, "rm", "--force", "--volumes", full)
        for volume in said.get("volumes", []):
            run(*image, "volume", "rm", f"{NAME}-{volume.partition(':')[0]}")


def until(holds: Callable[[], bool]) -> None:
    until_s = time.monotonic() + START_TIME_S
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.5)


def is_healthy(inside: list[str]) -> bool:
    (check,) = re.findall(r"(?m)^HEALTHCHECK .* CMD (.*)$", FILE.read_text())
    return run(*inside, *yaml.safe_load(check), within_s=START_TIME_S).returncode == 0


def test_the_services_of_the_compose_file_serve_record_and_report_without_root_and_without_writing(image):
    def said(name: str) -> str:
        done = run(*image, "logs", f"{NAME}-{name}")
        return done.stdout + done.stderr

    def scraped() -> str:
        program = "import urllib.request as u; print(u.urlopen('http://127.0.0.1:9464/metrics').read().decode())"
        return run(*metrics, "python3", "-c", program).stdout

    with service(image, "rig") as rig:
        until(lambda: is_healthy(rig))
        with service(image, "console"), service(image, "recorder") as recorder, service(image, "metrics") as metrics:
            until(lambda: "http://127.0.0.1:8470/?link=" in said("console"))
            until(lambda: ".mcap" in run(*recorder, "ls", "/recordings").stdout)
            until(lambda: 'ldcnd_daemon_up{rig="sim"} 1.0' in scraped())
        user, groups = run(*rig, "id", "-u").stdout.strip(), run(*rig, "id", "-Gn").stdout.split()
        written = [run(*rig, "touch", place).returncode for place in ("/here", "/opt/ldcnd/here", "/etc/ldcnd/here")]
        status = run(*rig, "grep", "-E", "CapEff|NoNewPrivs", "/proc/1/status").stdout.split()
        known = run(*image, "inspect", "--format", "{{.Config.Healthcheck.Test}}", f"{NAME}-rig").stdout
        ended = run(*image, "stop", "--time", "30", f"{NAME}-rig")
        log = said("rig")

    assert user == "64801"
    assert groups == ["ldcnd", "dialout"]
    assert status == ["CapEff:", "0000000000000000", "NoNewPrivs:", "1"]
    assert 0 not in written
    assert "ldcnd list" in known
    assert ended.returncode == 0
    assert "ended" in log  # in order, at the signal of the engine


def test_a_container_without_a_daemon_is_not_healthy(image):
    with service(image, "console") as console:  # which waits for one
        assert not is_healthy(console)
