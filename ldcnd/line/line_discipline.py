"""Settings of a Linux serial port that Python's `termios` cannot read or make: the rate it really has, and RS-485.

Sources: Linux, include/uapi/asm-generic/termbits.h and ioctls.h, include/uapi/linux/serial.h, Documentation/driver-api/
serial/serial-rs485.rst.
"""

import contextlib
import errno
import fcntl
import struct
import termios

from ldcnd.line.transport import (
    ENABLED,
    RTS_AFTER_SEND,
    RTS_ON_SEND,
    RX_DURING_TX,
    TERMINATE_BUS,
    Rs485Config,
)

# _IOR('T', 0x2A, 44 bytes), as on x86 and ARM; where it is another number it fails, and no rate is known
TCGETS2 = 0x802C542A
"""Reads `struct termios2`, whose speeds also hold rates without a constant of their own."""
# four words of flags, line discipline and 19 control characters, speed of input and of output
TERMIOS2 = struct.Struct("4I20B2I")
TIOCGRS485 = 0x542E
TIOCSRS485 = 0x542F
# flags, both delays in ms, five words of padding
SERIAL_RS485 = struct.Struct("3I5I")

PortFault = (OSError, ValueError, OverflowError, termios.error)
"""Exceptions for a driver's refusal; that of `termios` is no OSError."""


def actual_baud(descriptor: int) -> int | None:
    """Return the rate at which the driver says the port sends; None where it does not say.

    A driver that cannot make a rate sets another one and reports no error: the 8250 keeps the one before, or 9600.
    """
    with contextlib.suppress(OSError):
        speed: int = TERMIOS2.unpack(fcntl.ioctl(descriptor, TCGETS2, bytes(TERMIOS2.size)))[-1]
        return speed or None
    return None


def switch_direction(descriptor: int, wanted: Rs485Config) -> str:
    """Have the kernel switch the transmitter; return why it will not as wanted, empty when it does.

    A driver may take less than was requested without an error, so what it took is read back.
    """
    request = SERIAL_RS485.pack(wanted.flags, wanted.before_ms, wanted.after_ms, *bytes(5))
    try:
        fcntl.ioctl(descriptor, TIOCSRS485, request)
        flags, before_ms, after_ms, *_ = SERIAL_RS485.unpack(fcntl.ioctl(descriptor, TIOCGRS485, bytes(len(request))))
    except OSError as error:
        # drivers without it say so in each of these ways
        if error.errno in (errno.ENOTTY, errno.EINVAL, errno.EOPNOTSUPP):
            return "its driver cannot switch the transmitter of an RS-485 line"
        return f"its driver refuses to switch the transmitter: {error}"
    return _difference(wanted, flags, before_ms, after_ms)


def _difference(wanted: Rs485Config, flags: int, before_ms: int, after_ms: int) -> str:
    if not flags & ENABLED:
        return "its driver cannot switch the transmitter of an RS-485 line"
    if (flags ^ wanted.flags) & (RTS_ON_SEND | RTS_AFTER_SEND):
        return f"its driver cannot have RTS {'on' if wanted.rts_on_send else 'off'} while sending"
    if (flags ^ wanted.flags) & RX_DURING_TX:
        return f"its driver cannot have the receiver {'on' if wanted.receive_own else 'off'} while sending"
    if wanted.terminate and not flags & TERMINATE_BUS:
        return "its port has no terminating resistor that can be switched on"
    if (before_ms, after_ms) != (wanted.before_ms, wanted.after_ms):
        return (
            f"its driver makes pauses of {before_ms} and {after_ms} ms of {wanted.before_ms} and {wanted.after_ms} ms"
        )
    return ""
