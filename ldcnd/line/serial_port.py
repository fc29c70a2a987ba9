"""A serial port as a byte pipe: opened, configured and closed by pyserial and pyserial-asyncio, used by descriptor.

Reading: one `read` each time the descriptor is ready; an empty one or an error of the driver (EIO when the far side of
a pseudo-terminal or a USB adapter has gone) ends the port. Writing: the bytes go to the descriptor at once; a request
is far smaller than the driver's buffer, so one that does not fit whole means that the port is stuck. pyserial-asyncio
0.6 needs three system calls for each read and keeps every write for the next turn of the loop; the measurement is in
docs/explanation/timing.md. Draining and opening may hang and happen in threads of their own, one for each device.

The direction of an RS-485 transmitter is the adapter's business, or the kernel's (`Rs485Config`); pyserial's
`rs485_mode` is not used: after a driver has refused it, every later change of the rate fails too.
"""

import asyncio
import contextlib
import errno
import fcntl
import os
import termios
from dataclasses import dataclass
from pathlib import Path

import serial
import serial_asyncio
from typing_extensions import override

from ldcnd.contract.errors import TransportLost
from ldcnd.line.adapter import LineErrors, line_errors
from ldcnd.line.line_discipline import PortFault, actual_baud, switch_direction
from ldcnd.line.ports_here import held_by
from ldcnd.line.rates import STANDARD_BAUDS, makes, nearest
from ldcnd.line.terminal_link import PSEUDO_TERMINALS, why_not_served
from ldcnd.line.transport import Framing, Incoming, Receiver, Rs485Config, Transport
from ldcnd.own_thread import OwnThread

OPEN_TIME_S = 5.0
REPLUG = "unplug the adapter and plug it in again"
_OPENING: set[str] = set()
"""Paths of which an opening has not returned: of a driver that hangs each attempt would keep one more thread."""
DRAIN_TIME_S = 1.0
"""Enough for a full output buffer of 1 KiB at 9600 baud."""

USB_TERMINALS = frozenset({166, 188})
"""Major device numbers of USB adapters (Linux, admin-guide/devices.txt)."""

READ_BYTES = 256
"""More than most replies have; to make room for 4096 takes a tenth longer, and replies are read one at a time."""
CONTROL_CHARACTERS = 6
"""Where `termios.tcgetattr` keeps VMIN and VTIME."""

SETTINGS_BYTES = 64
"""More than `struct termios` has anywhere."""


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """How to open a serial port.

    Attributes:
        path: the device, best a stable name below /dev/serial/by-id.
        baud: rate of both directions.
        framing: data bits, parity, stop bits.
        low_latency: request the driver to pass bytes on at once; an FTDI adapter otherwise waits for up to 16 ms.
        exclusive: refuse the port to others, and refuse to share one that is in use by a program that can be seen.
        working_baud: the rate that the line will be changed to; a port that cannot make it does not open.
        rs485: have the kernel switch the transmitter; None where the adapter does it, or where it stays on.
    """

    path: str
    baud: int
    framing: Framing = "8n1"
    low_latency: bool = True
    exclusive: bool = True
    working_baud: int | None = None
    rs485: Rs485Config | None = None


class _Refused(Exception):
    """The driver takes the port's settings otherwise than requested.

    Args:
        what: it makes of them.
        remedy: what to do about it.
    """

    def __init__(self, what: str, remedy: str) -> None:
        super().__init__(what)
        self.remedy = remedy


async def open_serial_port(settings: SerialSettings) -> Transport:
    """Open and configure a port.

    Raises:
        TransportLost: there is no such device, it may not be used, another program has it, or it is no serial port.
    """
    if settings.path in _OPENING:
        raise TransportLost(
            f"{settings.path} cannot be opened: an earlier attempt has not returned; {REPLUG}", remedy=REPLUG
        )
    thread = OwnThread(f"open {settings.path}")
    _OPENING.add(settings.path)
    opening = asyncio.get_running_loop().run_in_executor(thread, _open, settings)
    try:
        async with asyncio.timeout(OPEN_TIME_S):
            # open(2) cannot be interrupted: should it end after all, `_close_unwanted` gives the port back
            port = await asyncio.shield(opening)
    except _Refused as refused:
        message = f"{settings.path} cannot be opened: {refused}; {refused.remedy}"
        raise TransportLost(message, value=settings.path, remedy=refused.remedy) from None
    except TimeoutError:
        opening.add_done_callback(_close_unwanted)
        raise TransportLost(f"{settings.path} did not open within {OPEN_TIME_S:g} s", remedy=REPLUG) from None
    except asyncio.CancelledError:
        opening.add_done_callback(_close_unwanted)
        raise
    except PortFault as error:
        raise _explained(settings.path, error) from error
    try:
        return await _connected(port, Incoming(settings.path))
    except PortFault as error:
        raise _explained(settings.path, error) from error


async def _connected(port: "_Serial", incoming: Incoming) -> "SerialPort":
    """Have the loop watch an open port; closes it if anything fails, or it would stay locked against this program too.

    Raises:
        PortFault: the port is gone already.
    """
    loop = asyncio.get_running_loop()
    try:
        stream, _ = await serial_asyncio.connection_for_serial(loop, lambda: incoming, port)
        await asyncio.sleep(0)  # the stream begins to read in the loop's next turn, and would do so after a pause, too
        stream.pause_reading()
        return SerialPort(port, stream, incoming)
    except BaseException:
        if port.is_open:
            loop.remove_reader(port.fileno())
            port.close()
        raise


class _Serial(serial.Serial):
    """A port that pyserial-asyncio can close without blocking the loop.

    Attributes:
        bauds: the standard rates that the driver makes.
    """

    bauds: tuple[int, ...] = ()

    def tune(self, baud: int) -> int | None:
        """Change the rate; return the one that the driver makes of it, None where it does not say.

        Raises:
            PortFault: the driver refuses.
        """
        self.baudrate = baud
        return actual_baud(self.fileno())

    def flush(self) -> None:
        """Do nothing: pyserial-asyncio would drain on the event loop; `SerialPort.close` has drained in a worker."""

    def drain(self) -> None:
        """Block until the driver has sent everything."""
        if self.is_open:
            termios.tcdrain(self.fileno())


class SerialPort(Transport):
    """An open serial port."""

    def __init__(self, port: _Serial, stream: asyncio.Transport, incoming: Incoming) -> None:
        """Take over an open port, on which pyserial-asyncio does not read."""
        self._port = port
        self._stream = stream
        self._incoming = incoming
        self._descriptor = port.fileno()
        self._loop = asyncio.get_running_loop()
        major = os.major(os.fstat(self._descriptor).st_rdev)
        self._is_pseudo, self._is_usb = major in PSEUDO_TERMINALS, major in USB_TERMINALS
        self.pushes = self._is_pseudo
        self._least_bytes = 1
        self._settings: dict[int, bytes] = {}  # the driver's settings by minimum number of bytes, at this rate
        self._set_least_bytes()
        self._loop.add_reader(self._descriptor, self._readable)

    def offers(self, baud: int) -> bool:
        """See `Transport`: standard rates were tried when the port was opened, another one shows when it is set."""
        return baud not in STANDARD_BAUDS or baud in self._port.bauds

    @override
    def line_errors(self) -> LineErrors | None:
        return None if self._incoming.reason else line_errors(self._descriptor)

    @override
    def attach(self, receiver: Receiver) -> None:
        self.discard_input()
        self._incoming.attach(receiver)

    def _readable(self) -> None:
        try:
            data = os.read(self._descriptor, READ_BYTES)
        except BlockingIOError:
            return  # `collect` asks without knowing whether anything is there
        except OSError as error:
            self._give_up(self._gone(str(error)))
            return
        if data:
            self._incoming.data_received(data)
        else:
            self._give_up(self._gone("the driver hung it up"))

    def _gone(self, what: str) -> str:
        """Say who has gone: the kernel hangs a port up when its adapter leaves the USB, or a pty's far end closes."""
        if self._is_usb:
            return f"the USB adapter is gone, unplugged or reset ({what})"
        return "the far end closed it" if self._is_pseudo else what

    @override
    def write(self, data: bytes) -> None:
        if self._incoming.reason:
            raise TransportLost(self._incoming.reason)
        try:
            written = os.write(self._descriptor, data)
        except OSError as error:
            raise self._give_up(self._gone(str(error))) from error
        if written != len(data):
            raise self._give_up(f"it took {written} of {len(data)} bytes")

    def push(self) -> None:
        """See `Transport`: a worker of the kernel carries them through a pseudo-terminal, and needs a processor."""
        if self.pushes:
            os.sched_yield()

    def expect(self, reply_bytes: int) -> None:
        """See `Transport`; a USB adapter delivers in large pieces anyway and would need a transfer for the setting."""
        if reply_bytes != self._least_bytes and not self._is_usb:
            self._least_bytes = reply_bytes
            self._set_least_bytes()

    @override
    def collect(self) -> None:
        if self._least_bytes > 1 and not self._incoming.reason:
            self._readable()

    def _set_least_bytes(self) -> None:
        """Tell the driver how many bytes are worth a wake-up (VMIN).

        At least one, so that an empty read is the end and not just nothing yet. A number that was set before takes
        one system call instead of four.
        """
        with contextlib.suppress(*PortFault):  # a port that is gone says so to its reader
            if settings := self._settings.get(self._least_bytes):
                fcntl.ioctl(self._descriptor, termios.TCSETS, settings)
                return
            attributes = termios.tcgetattr(self._descriptor)
            attributes[CONTROL_CHARACTERS][termios.VMIN] = self._least_bytes
            attributes[CONTROL_CHARACTERS][termios.VTIME] = 0
            termios.tcsetattr(self._descriptor, termios.TCSANOW, attributes)
            self._settings[self._least_bytes] = fcntl.ioctl(self._descriptor, termios.TCGETS, bytes(SETTINGS_BYTES))

    @override
    def discard_input(self) -> None:
        if not self._incoming.reason:
            # a port that is gone has no input; its reader reports the loss
            with contextlib.suppress(*PortFault):
                self._port.reset_input_buffer()

    @override
    def set_baud(self, baud: int) -> None:
        self._require_usable()
        try:
            made = self._port.tune(baud)
        except PortFault as error:
            raise self._give_up(f"it refuses {baud} baud: {error}") from error
        if not makes(baud, made):
            raise self._give_up(f"it sends at {made} instead of {baud} baud")
        self._settings.clear()
        self._set_least_bytes()  # pyserial has undone it

    async def close(self) -> None:
        """See `Transport`; what was written still leaves, for at most `DRAIN_TIME_S`."""
        usable = not self._incoming.reason
        self._incoming.detach()
        try:
            if usable:
                await self._drain()
        finally:
            self._end()
        await self._incoming.ended.wait()

    async def _drain(self) -> None:
        # `_end` drops what has not left by then
        with contextlib.suppress(TimeoutError, *PortFault):
            await OwnThread(f"drain {self._port.port}").run(self._port.drain, DRAIN_TIME_S)

    def _require_usable(self) -> None:
        if self._incoming.reason:
            raise TransportLost(self._incoming.reason)

    def _give_up(self, why: str) -> TransportLost:
        error = self._incoming.lost(why)
        self._end()
        return error

    def _end(self) -> None:
        """Let pyserial-asyncio close the port in the loop's next turn, without waiting for unsent bytes."""
        if self._stream.is_closing():
            return
        self._loop.remove_reader(self._descriptor)
        with contextlib.suppress(*PortFault):
            # closing waits for unsent bytes, by default for 30 s (setserial(8), closing_wait)
            self._port.reset_output_buffer()
        self._stream.abort()


def _open(settings: SerialSettings) -> _Serial:
    """Open the port; may hang, so it runs in a thread of its own."""
    try:
        return _opened(settings)
    finally:
        _OPENING.discard(settings.path)


def _opened(settings: SerialSettings) -> _Serial:
    _require_served(settings.path)
    seven_even = settings.framing == "7e1" and not _is_pseudo_terminal(settings.path)
    port = _Serial(
        settings.path,
        settings.baud,
        bytesize=serial.SEVENBITS if seven_even else serial.EIGHTBITS,
        parity=serial.PARITY_EVEN if seven_even else serial.PARITY_NONE,
        timeout=0,
        write_timeout=0,
        # False would have pyserial release the lock, None leaves it alone
        exclusive=settings.exclusive or None,
    )
    try:
        if settings.exclusive and not _is_pseudo_terminal(settings.path):
            # pyserial's lock binds only programs that use it; this one refuses every other user's open. It ends with
            # the last close (tty_ioctl(4)): what serves a pseudo-terminal has it open, so no second daemon could come.
            fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
            _refuse_holders(port, settings.path)
        _require_served(settings.path)  # the simulator may have ended, and the number been given away, in between
        _settle_rates(port, settings)
        _settle_direction(port, settings)
        if settings.low_latency:
            _ask_for_low_latency(port)
    except BaseException:
        port.close()
        raise
    return port


def _refuse_holders(port: _Serial, path: str) -> None:
    """Give a port back that is this program's from now on, and another one's from before.

    Raises:
        _Refused: a program has it that this user may see.
    """
    if others := held_by(Path(path), besides=os.getpid()):
        fcntl.ioctl(port.fileno(), termios.TIOCNXCL)  # it would outlast this program's close
        raise _Refused(f"{', '.join(others)} has it", "end that program")


def _require_served(path: str) -> None:
    if why := why_not_served(path):
        raise _Refused(why, f"start what serves it again, such as `ldcnd sim --pty {path}`, or make the link anew")


def _settle_rates(port: _Serial, settings: SerialSettings) -> None:
    """Find out which rates the driver makes before a drive is set to one, and leave it at the first one.

    Raises:
        _Refused: not those that the line needs.
    """
    port.bauds = tuple(baud for baud in STANDARD_BAUDS if makes(baud, port.tune(baud)))
    # the rate of opening comes last: the port is left at it
    for baud in (settings.working_baud, settings.baud):
        if baud and not makes(baud, made := port.tune(baud)):
            raise _Refused(
                f"it sends at {made} instead of {baud} baud, the nearest that it makes: {nearest(baud, port.bauds)}",
                f"set a baud that it makes ({', '.join(map(str, port.bauds)) or 'none'}), or use another adapter",
            )


def _settle_direction(port: _Serial, settings: SerialSettings) -> None:
    """Have the kernel switch the transmitter, where that is configured.

    Raises:
        _Refused: its driver does not, or not so.
    """
    if settings.rs485 and (why := switch_direction(port.fileno(), settings.rs485)):
        raise _Refused(why, "leave `rs485` out where the adapter switches its transmitter itself, or use another port")


def _is_pseudo_terminal(path: str) -> bool:
    """Tell whether the path leads to the near side of a pty: it carries bytes, not frames, and refuses 7E1."""
    return os.major(os.stat(path).st_rdev) in PSEUDO_TERMINALS  # noqa: PTH116 - a number of the device, not of a file


def _ask_for_low_latency(port: _Serial) -> None:
    with contextlib.suppress(ValueError, NotImplementedError):  # pseudo-terminals and several drivers have no such mode
        port.set_low_latency_mode(True)


def _close_unwanted(opening: "asyncio.Future[_Serial]") -> None:
    """Close a port that opened after its caller had gone."""
    if not opening.cancelled() and not opening.exception():
        opening.result().close()


def _explained(path: str, error: Exception) -> TransportLost:
    """Say what is wrong with the port and what to do about it."""
    match error.errno if isinstance(error, OSError) else None:
        case errno.ENOENT | errno.ENXIO | errno.ENODEV:
            what, remedy = "no such device", "plug the adapter in, or correct the port in the configuration"
        case errno.EACCES | errno.EPERM:
            what, remedy = "permission denied", "add the user to group dialout and log in again"
        case errno.EBUSY | errno.EAGAIN:
            what, remedy = "another program has it", "end that program; `fuser` names it"
        case _:
            what, remedy = f"it cannot be set up ({error})", "check that it is a serial port and that it has this rate"
    return TransportLost(f"{path} cannot be opened: {what}; {remedy}", value=path, remedy=remedy)
