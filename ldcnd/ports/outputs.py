"""What the packets of a guest to a PIC-I/O mean for its named outputs. Source: PIC-I/O data sheet, 2.2, 3.1."""

from collections.abc import Callable, Mapping

from ldcnd.contract.errors import NotSupported
from ldcnd.contract.rig_commands import IoTimer, SetIo, SetIoTimer
from ldcnd.drives.ldcn.pic_io import (
    ALL_LINES,
    MOST_PWM,
    SetDirection,
    SetOutput,
    SetPwmOutputs,
    SetSynchOutput,
    SetTimerMode,
    SynchOutput,
)
from ldcnd.drives.ldcn.received import ReceivedCommand
from ldcnd.drives.line_config import OutputConfig


class GuestOutputs:
    """The outputs of one module as its guest commands them; only those that the configuration names are driven."""

    def __init__(
        self, module: str, outputs: Mapping[str, OutputConfig], levels: Callable[[str], Mapping[str, bool | None]]
    ) -> None:
        self._module, self._levels_of = module, levels
        self._lines = {1 << each.line - 1: name for name, each in outputs.items()}
        self.restart()

    def restart(self) -> None:
        """Take what a reset leaves: all lines are inputs, PWM is 0."""
        self._inputs, self._levels, self._pwm = ALL_LINES, 0, (0, 0)
        self._stored = SetSynchOutput(0, 0, 0)

    def meaning(self, command: ReceivedCommand) -> SetIo | SetIoTimer | None:
        """Return what a command means now; None where nothing is to be done.

        Raises:
            NotSupported: it drives a line that the configuration does not name as an output, or captures.
        """
        match command:
            case SetDirection(inputs):
                self._inputs = inputs
                if foreign := ALL_LINES & ~inputs & ~sum(self._lines):  # the named ones of the packet are outputs
                    lines = ", ".join(str(line) for line in range(1, 13) if foreign & 1 << line - 1)
                    raise NotSupported(f"the configuration names no output at line {lines}")
                return self._drive()
            case SetOutput(levels):
                self._levels = levels
                return self._drive()
            case SetSynchOutput():
                self._stored = command
                return None
            case SynchOutput():
                self._levels = self._stored.levels
                return self._drive((self._stored.pwm1, self._stored.pwm2))
            case SetPwmOutputs(pwm1, pwm2):
                return self._drive((pwm1, pwm2))
            case SetTimerMode(enabled, counter, prescale):
                mode = IoTimer.OFF if not enabled else IoTimer.COUNTER if counter else IoTimer.TIMER
                return SetIoTimer(module=self._module, mode=mode, prescale=prescale)
            case _:
                raise NotSupported("no command of a module does the same")

    def _drive(self, pwm: tuple[int, int] | None = None) -> SetIo | None:
        """Return what makes the module as the guest wants it; None when it is so already."""
        now = self._levels_of(self._module)
        driven = {line: bool(self._levels & line) for line in self._lines if not self._inputs & line}
        wanted = {line: level for line, level in driven.items() if now.get(self._lines[line]) is not level}
        duties = pwm if pwm not in (None, self._pwm) else None
        self._pwm = duties or self._pwm
        if not wanted and duties is None:
            return None
        high = tuple(self._lines[line] for line, level in wanted.items() if level)
        low = tuple(self._lines[line] for line, level in wanted.items() if not level)
        pwm1, pwm2 = (each / MOST_PWM for each in duties) if duties else (None, None)
        return SetIo(module=self._module, high=high, low=low, pwm1=pwm1, pwm2=pwm2)
