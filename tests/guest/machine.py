"""A machine of its own under QEMU: Debian's kernel with its own serial drivers, a real systemd and udev.

Its image is built once and kept in the user's cache, under a name that is a digest of the kernel's and the packages'
versions and of the scripts that build it. Unlike a machine on a bench, QEMU's FT232 and 16550A have no delays of their
own, and a break never arrives through its FT232. Everything between system call and register is the kernel's.
"""

import contextlib
import fcntl
import functools
import hashlib
import json
import os
import shutil
import socket
import subprocess
import tempfile
import termios
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ldcnd.sim.chain import Chain
from ldcnd.sim.pty import PtyLine
from tests.support.process import free_port

HERE = Path(__file__).parent
BUILD_TIME_S = 600.0
BOOT_TIME_S = 300.0
AGENT_PORT = 5555
MEMORY_MIB = 768
TOOLS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "mmdebstrap": "mmdebstrap",
    "cpio": "cpio",
    "apt-cache": "apt",
    "dpkg-deb": "dpkg",
    "mke2fs": "e2fsprogs",
}
SECTOR_BYTES = 512
BOOT_ARGUMENTS = (
    "console=ttyS0 quiet net.ifnames=0 mitigations=off nokaslr audit=0 apparmor=0 selinux=0 no_timer_check"
    " 8250.nr_uarts=8"  # four of them on board, whether there or not
)
TRIAL_S = 15.0
"""A kernel that is truly accelerated has booted without a root by then."""
TAKEN_WITHIN_S = 0.5
"""Maximum time in which QEMU reads what waits for an adapter, seconds."""
Done = subprocess.CompletedProcess[str]


def why_no_guest() -> str | None:
    """Return why no guest can be booted on this machine; None if one can be."""
    for tool, package in TOOLS.items():
        if not shutil.which(tool):
            return f"no {tool}: apt-get install {package}"
    if os.uname().machine != "x86_64":
        return "the guest is for x86_64"
    if os.geteuid() != 0:
        return "building its image takes root"
    return None


def image() -> Path:
    """Return the folder with kernel and root of the guest; builds them if they are not in the cache."""
    script = HERE / "build_image.sh"
    key = subprocess.run([str(script), "-", "--key"], capture_output=True, check=True).stdout  # noqa: S603
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ldcnd"
    cache.mkdir(parents=True, exist_ok=True)
    folder = cache / f"guest-{hashlib.sha256(key).hexdigest()[:16]}"
    with (cache / "guest.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "root.ext4").exists():
            for old in cache.glob("guest-*/*"):
                if old.is_file():
                    old.unlink()
            # all of its programs are told to end, so that each takes its mounts away
            subprocess.run(["timeout", f"{BUILD_TIME_S:g}", str(script), str(folder)], check=True)  # noqa: S603, S607
    return folder


@dataclass(frozen=True)
class FarEnd:
    """The host's end of a line, where the simulated drives are.

    Attributes:
        path: the terminal that leads to it.
        serving: held while the drives read and write.
        door: to be held before `serving` is asked for; the drives wait here.
    """

    path: Path
    serving: threading.Lock = field(default_factory=threading.Lock)
    door: threading.Lock = field(default_factory=threading.Lock)

    def serve(self, line: PtyLine, stopped: threading.Event) -> None:
        """Let the drives read and write until an event."""

        def stop() -> bool:
            self.serving.release()
            with self.door:
                self.serving.acquire()
            return stopped.is_set()

        with self.serving:
            line.run(stop)

    @contextmanager
    def silent(self) -> Iterator[None]:
        """Keep the drives from writing, once QEMU has taken what they have written."""
        with self.door, self.serving:
            terminal = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            try:
                until_s = time.monotonic() + TAKEN_WITHIN_S
                while fcntl.ioctl(terminal, termios.FIONREAD, bytes(4)) != bytes(4) and time.monotonic() < until_s:
                    time.sleep(0.001)
                yield
            finally:
                os.close(terminal)


@dataclass(frozen=True)
class Adapter:
    """A USB adapter of the guest, with a far end on the host."""

    serial: str
    far_end: FarEnd

    @property
    def id(self) -> str:
        return self.serial.lower()

    @property
    def device(self) -> dict[str, object]:
        """As QEMU plugs it in."""
        return {
            "driver": "usb-serial",
            "id": self.id,
            "chardev": f"far-{self.id}",
            "serial": self.serial,
            "bus": "usb.0",
            "always-plugged": True,
        }

    @property
    def node(self) -> str:
        """Its terminal in the guest."""
        return f"/dev/ldcn-{self.serial}-00"


@dataclass(frozen=True)
class Card:
    """A PCI card with one 16550A, with a far end on the host."""

    slot: int
    far_end: FarEnd

    @property
    def id(self) -> str:
        return f"card{self.slot}"

    @property
    def device(self) -> dict[str, object]:
        """As QEMU plugs it in."""
        return {"driver": "pci-serial", "id": self.id, "chardev": f"far-{self.id}", "addr": f"{self.slot:#x}"}

    @property
    def node(self) -> str:
        """A pattern of the folder that is named as its terminal in the guest."""
        return f"/sys/bus/pci/devices/0000:00:{self.slot:02x}.0/tty/ttyS*"


class Monitor:
    """QEMU's own control socket."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(20)
        self._socket.connect(str(path))
        self._lines = self._socket.makefile("r", encoding="utf-8")
        self._lines.readline()
        self.execute("qmp_capabilities")

    def execute(self, command: str, arguments: Mapping[str, object] | None = None, until: str = "") -> None:
        """Have a command carried out, and wait for an event after it."""
        request = {"execute": command, "arguments": dict(arguments or {})}
        self._socket.sendall(json.dumps(request).encode() + b"\n")
        returned, seen = False, not until
        while not (returned and seen):
            message = json.loads(self._lines.readline())
            assert "error" not in message, message["error"]
            returned |= "return" in message
            seen |= message.get("event") == until

    def close(self) -> None:
        self._lines.close()
        self._socket.close()


class Guest:
    """A booted guest.

    Attributes:
        ports: of this machine, by those of the guest that they lead to.
        boot_s: how long it took until the guest ran commands.
    """

    def __init__(
        self, ports: Mapping[int, int], monitor: Monitor, adapters: Mapping[str, Adapter], boot_s: float
    ) -> None:
        self.ports = ports
        self.boot_s = boot_s
        self._monitor = monitor
        self._adapters = adapters

    def run(self, command: str, *, given: str = "", timeout_s: float = 60.0) -> Done:
        """Run a shell command in it, whatever its outcome."""
        return run_in(self.ports[AGENT_PORT], command, given, timeout_s)

    def must(self, command: str, *, given: str = "", timeout_s: float = 60.0) -> str:
        """Run a command that must succeed; return its output."""
        done = self.run(command, given=given, timeout_s=timeout_s)
        assert done.returncode == 0, f"{command}: {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout.strip()

    def write(self, path: str, text: str) -> None:
        """Write a file."""
        self.must(f"mkdir -p $(dirname {path}) && cat > {path}", given=text)

    def until(self, command: str, wanted: str, within_s: float = 30.0) -> str:
        """Repeat a command until its output has a text."""
        until_s = time.monotonic() + within_s
        while wanted not in (seen := self.run(command).stdout):
            assert time.monotonic() < until_s, f"{command}: still {seen!r}, not {wanted!r}"
            time.sleep(0.1)
        return seen

    def pull(self, serial: str) -> None:
        """Unplug an adapter; returns when it is gone.

        Its far end is silent meanwhile: QEMU 7.2 crashes when a byte arrives for an adapter that has left its bus.
        """
        adapter = self._adapters[serial]
        with adapter.far_end.silent():
            self._monitor.execute("device_del", {"id": adapter.id}, until="DEVICE_DELETED")

    def push(self, serial: str) -> None:
        """Plug it in."""
        self._monitor.execute("device_add", self._adapters[serial].device)

    @contextmanager
    def plugged(self, port: Adapter | Card) -> Iterator[str]:
        """Plug in a port until the context ends, and yield its terminal; no program may send on it after that."""
        backend = {"type": "serial", "data": {"device": str(port.far_end.path)}}
        self._monitor.execute("chardev-add", {"id": f"far-{port.id}", "backend": backend})
        self._monitor.execute("device_add", port.device)
        try:
            self.until(f"ls -d {port.node}", "/")
            yield f"/dev/{Path(self.must(f'readlink -f {port.node}')).name}"
        finally:
            self._monitor.execute("device_del", {"id": port.id}, until="DEVICE_DELETED")
            self._monitor.execute("chardev-remove", {"id": f"far-{port.id}"})

    def send_break(self, chardev: str) -> None:
        """Let a break arrive at a UART."""
        self._monitor.execute("chardev-send-break", {"id": chardev})


@dataclass(frozen=True)
class Bench:
    """The guest, and the drives at the far ends of its ports."""

    guest: Guest
    usb: Chain
    uart: Chain


def run_in(port: int, command: str, given: str = "", timeout_s: float = 60.0) -> Done:
    """Have the agent behind a port run a command."""
    request = {"command": command, "input": given, "timeout_s": timeout_s}
    with socket.create_connection(("127.0.0.1", port), timeout=5.0) as agent:
        agent.settimeout(timeout_s + 5.0)
        agent.sendall(json.dumps(request).encode() + b"\n")
        with agent.makefile("r", encoding="utf-8") as answers:
            line = answers.readline()
    if not line:
        raise ConnectionError("the agent does not answer")
    reply = json.loads(line)
    return subprocess.CompletedProcess(command, reply["code"], reply["output"], reply["errors"])


@contextmanager
def far_end(chain: Chain, *, baud_check: bool = True) -> Iterator[FarEnd]:
    """Run a simulated line in a thread."""
    stopped = threading.Event()
    with PtyLine(chain, baud_check=baud_check) as line:
        end = FarEnd(line.path)
        thread = threading.Thread(target=end.serve, args=(line, stopped), name=f"line {line.path}")
        thread.start()
        try:
            yield end
        finally:
            stopped.set()
            thread.join(5)


@contextmanager
def booted_guest(
    deb: Path, adapters: tuple[Adapter, ...], uart: Path, forwarded: tuple[int, ...] = ()
) -> Iterator[Guest]:
    """Boot a guest until the context ends.

    Args:
        deb: a package that is its second disk.
        adapters: plugged in from the beginning.
        uart: the far end of its ttyS1.
        forwarded: ports of the guest to be reached from here.
    """
    built = image()
    ports = {port: free_port() for port in (AGENT_PORT, *forwarded)}
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ldcnd-guest-")))
        began_s = time.monotonic()
        disk = place / "deb"
        shutil.copy(deb, disk)
        os.truncate(disk, -(-deb.stat().st_size // SECTOR_BYTES) * SECTOR_BYTES)
        forwards = ",".join(f"hostfwd=tcp:127.0.0.1:{here}-:{there}" for there, here in ports.items())
        command = [
            *("qemu-system-x86_64", "-name", "ldcnd-test", "-nodefaults", "-no-reboot", "-display", "none"),
            *accelerated(built / "vmlinuz"),
            *("-smp", "2", "-m", str(MEMORY_MIB)),
            *("-kernel", str(built / "vmlinuz"), "-initrd", str(built / "initrd"), "-append", BOOT_ARGUMENTS),
            *("-drive", f"file={built / 'root.ext4'},format=raw,if=virtio,snapshot=on"),
            *("-drive", f"file={disk},format=raw,if=virtio,readonly=on"),
            *("-netdev", f"user,id=net,restrict=on,{forwards}", "-device", "virtio-net-pci,netdev=net,romfile="),
            *("-device", "virtio-rng-pci"),
            *("-serial", f"file:{place / 'console'}"),
            *("-chardev", f"serial,id=uart,path={uart}", "-serial", "chardev:uart"),
            *("-device", "qemu-xhci,id=usb,p2=8"),
            *("-qmp", f"unix:{place / 'monitor'},server=on,wait=off"),
        ]
        for adapter in adapters:
            command += ["-chardev", f"serial,id=far-{adapter.id},path={adapter.far_end.path}"]
            command += ["-device", json.dumps(adapter.device)]
        errors = stack.enter_context((place / "errors").open("w+"))
        qemu = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=errors, stderr=errors)  # noqa: S603
        stack.callback(_end, qemu)
        _answering(qemu, ports[AGENT_PORT], place)
        monitor = Monitor(place / "monitor")
        stack.callback(monitor.close)
        yield Guest(ports, monitor, {each.serial: each for each in adapters}, time.monotonic() - began_s)


@functools.cache
def accelerated(kernel: Path) -> tuple[str, ...]:
    """Return QEMU's options for the fastest processor on which the kernel boots: not every /dev/kvm runs any kernel."""
    emulated = ("-accel", "tcg,tb-size=512", "-cpu", "Nehalem")
    by_hardware = any(Path("/sys/module", name).exists() for name in ("kvm_intel", "kvm_amd"))
    if not (by_hardware and os.access("/dev/kvm", os.W_OK)):
        return emulated
    fast = ("-accel", "kvm", "-cpu", "host")
    command = ["qemu-system-x86_64", "-nodefaults", "-no-reboot", "-display", "none", "-m", "256", *fast]
    command += ["-kernel", str(kernel), "-append", "console=ttyS0 panic=-1", "-serial", "stdio"]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=TRIAL_S, check=False)  # noqa: S603
    except subprocess.TimeoutExpired:
        return emulated
    return fast if b"Unable to mount root" in done.stdout else emulated


def _answering(qemu: "subprocess.Popen[bytes]", port: int, place: Path) -> None:
    until_s = time.monotonic() + BOOT_TIME_S
    while True:
        console = (place / "console").read_text(errors="replace") if (place / "console").exists() else ""
        assert qemu.poll() is None, f"QEMU has ended: {(place / 'errors').read_text()}{console[-2000:]}"
        assert time.monotonic() < until_s, f"the guest does not boot: {console[-2000:]}"
        with contextlib.suppress(OSError, ValueError):
            if run_in(port, "true", timeout_s=2.0).returncode == 0:
                return
        time.sleep(0.1)


def _end(qemu: "subprocess.Popen[bytes]") -> None:
    qemu.terminate()
    try:
        qemu.wait(10)
    except subprocess.TimeoutExpired:
        qemu.kill()
        qemu.wait(10)
