"""One wire that leaves the computer and has a level: an output of a serial port, a GPIO line, a file of the kernel."""

import contextlib
from abc import ABC, abstractmethod
from pathlib import Path

import serial
from typing_extensions import override

from ldcnd.contract.errors import ConfigError
from ldcnd.parts import missing


class Output(ABC):
    """One wire that leaves the computer."""

    @abstractmethod
    def set(self, level: bool) -> None:  # noqa: FBT001 - a level is what it is
        """Set the wire's level.

        Raises:
            OSError: the wire is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Let the wire go; its level is then what the driver makes it."""


class ModemLine(Output):
    """RTS or DTR of a serial port that carries nothing else.

    Args:
        port: the device.
        signal: which of the two outputs.

    Raises:
        OSError: there is no such port, or it is in use.
    """

    def __init__(self, port: str, signal: str) -> None:
        self._signal = signal
        self._port = serial.Serial(None, exclusive=True)
        self._port.rts = self._port.dtr = False  # before it is opened: the driver would raise both
        self._port.port = port
        self._port.open()

    @override
    def set(self, level: bool) -> None:
        setattr(self._port, self._signal, level)

    @override
    def close(self) -> None:
        # the kernel drops both outputs
        with contextlib.suppress(OSError):
            self._port.close()


class LevelFile(Output):
    """A file of the kernel that takes 0 and 1, such as the brightness of an LED that drives a pin (gpio-leds).

    Args:
        path: the file.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)

    @override
    def set(self, level: bool) -> None:
        self._file.write(b"1\n" if level else b"0\n")

    @override
    def close(self) -> None:
        # the level stays
        with contextlib.suppress(OSError):
            self._file.close()


class GpioLine(Output):
    """One line of a GPIO chip, by libgpiod.

    Args:
        name: the chip and the line's number, as `gpiochip0:17`.

    Raises:
        ConfigError: the bindings of libgpiod 2 are not installed.
        OSError: there is no such chip or line, or it is in use.
    """

    def __init__(self, name: str) -> None:
        try:
            import gpiod  # noqa: PLC0415 - an optional package
            from gpiod.line import Direction, Value  # noqa: PLC0415 - as above
        except ImportError:
            why = missing("gpiod")
            raise ConfigError(f"heartbeat.gpio: {name}: {why.message}", value=name, remedy=why.remedy) from None
        chip, _, number = name.partition(":")
        self._levels = (Value.INACTIVE, Value.ACTIVE)
        self._number = int(number)
        settings = gpiod.LineSettings(direction=Direction.OUTPUT, output_value=Value.INACTIVE)
        self._request = gpiod.request_lines(f"/dev/{chip}", consumer="ldcnd", config={self._number: settings})

    @override
    def set(self, level: bool) -> None:
        self._request.set_value(self._number, self._levels[level])

    @override
    def close(self) -> None:
        # most drivers leave the level as it is
        with contextlib.suppress(OSError):
            self._request.release()
