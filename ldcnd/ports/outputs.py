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
    """The outputs of one module as its guest commands them; only those that the configuration names are driven.

    Attributes:
        drives_pwm: a duty may be on that the guest has set: until a zero was carried out.
        resets: how often it was reset so far: what came before does not begin behind.
    """

    def __init__(
        self, module: str, outputs: Mapping[str, OutputConfig], levels: Callable[[str], Mapping[str, bool | None]]
    ) -> None:
        self._module, self._levels_of = module, levels
        self._lines = {1 << each.line - 1: name for name, each in outputs.items()}
        self.drives_pwm, self.resets = False, -1
        self.restart()

    def restart(self) -> None:
        """Take what a reset leaves: all lines are inputs, nothing is stored."""
        self._inputs, self._levels = ALL_LINES, 0
        self._stored: SetSynchOutput | None = SetSynchOutput(0, 0, 0)
        self.resets += 1

    def gone(self) -> None:
        """Forget what the program has stored for later: the next one does not begin it."""
        self._stored = None

    def meaning(self, command: ReceivedCommand) -> SetIo | SetIoTimer | None:
        """Return what a command means now, each for what it names alone; None where nothing is to be done.

        Raises:
            NotSupported: it drives a line that the configuration does not name as an output, captures, or puts in force
                what this program has not stored.
        """
        match command:
            case SetDirection(inputs):
                before, self._inputs = self._inputs, inputs
                if foreign := ALL_LINES & ~inputs & ~sum(self._lines):  # the named ones of the packet are outputs
                    lines = ", ".join(str(line) for line in range(1, 13) if foreign & 1 << line - 1)
                    raise NotSupported(f"the configuration names no output at line {lines}")
                return self._drive(before & ~inputs, self._levels)
            case SetOutput(levels):
                return self._drive(ALL_LINES, levels)
            case SetSynchOutput():
                self._stored = command
                return None
            case SynchOutput():
                if self._stored is None:
                    raise NotSupported("this program has stored no outputs")
                return self._drive(ALL_LINES, self._stored.levels, (self._stored.pwm1, self._stored.pwm2))
            case SetPwmOutputs(pwm1, pwm2):
                return self._drive(0, 0, (pwm1, pwm2))
            case SetTimerMode(enabled, counter, prescale):
                mode = IoTimer.OFF if not enabled else IoTimer.COUNTER if counter else IoTimer.TIMER
                return SetIoTimer(module=self._module, mode=mode, prescale=prescale)
            case _:
                raise NotSupported("no command of a module does the same")

    def begins(self, wanted: SetIo | SetIoTimer) -> None:
        """Note that something is sent now: its reply may get lost."""
        self.drives_pwm |= isinstance(wanted, SetIo) and bool(wanted.pwm1 or wanted.pwm2)

    def carried_out(self, command: ReceivedCommand, wanted: SetIo | SetIoTimer | None) -> None:
        """Note what a command has set: lines that the next direction makes outputs have these levels."""
        if isinstance(wanted, SetIo) and wanted.pwm1 is not None:
            self.drives_pwm = bool(wanted.pwm1 or wanted.pwm2)
        match command:
            case SetOutput(levels):
                self._levels = levels
            case SynchOutput() if self._stored:
                self._levels = self._stored.levels

    def _drive(self, lines: int, levels: int, pwm: tuple[int, int] | None = None) -> SetIo | None:
        """Return what gives lines their levels, and the PWM outputs their duties; None when they have them already."""
        now = self._levels_of(self._module)
        driven = {line: bool(levels & line) for line in self._lines if lines & line & ~self._inputs}
        wanted = {line: level for line, level in driven.items() if now.get(self._lines[line]) is not level}
        # no reading shows a duty, and others may have set another one
        if not wanted and pwm is None:
            return None
        high = tuple(self._lines[line] for line, level in wanted.items() if level)
        low = tuple(self._lines[line] for line, level in wanted.items() if not level)
        pwm1, pwm2 = (each / MOST_PWM for each in pwm) if pwm else (None, None)
        return SetIo(module=self._module, high=high, low=low, pwm1=pwm1, pwm2=pwm2)
