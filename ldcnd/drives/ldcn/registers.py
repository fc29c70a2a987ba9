"""LDCN/NMC registers: codes of baud rates, the data of Set Gain, and what the registers of one module hold.

Hardly any register can be read back. What one holds is `Known` by evidence, `Assumed`, or `Unknown`; it stands in the
book of its module and nowhere else, and whatever depends on it takes it from there.

Sources: LS-182AP manual, "Servo Control", "Set Gain", "Power-up and Reset Conditions", "Set Baud Rate" and the
calculation at its end; PIC-SERVO manual, 4.3 to 4.5, 5.2; for PIC-SERVO SC later vendor data sheets.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from enum import Enum
from functools import partial
from types import MappingProxyType

from typing_extensions import override

from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.contract.meta import Provenance, RegisterInfo
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import LimitPins
from ldcnd.drives.ldcn.packet import RegisterField
from ldcnd.drives.ldcn.profiles import CLOCK_HZ, CYCLE_CLOCKS, Profile

SERVO_CYCLE_S = CYCLE_CLOCKS / CLOCK_HZ
"""The servo period of a device with the usual clock at divisor 1: 0.512 ms."""
FRACTION = 1 << 16
MOST_RATE = 0x7FFF_FFFF
"""The largest programmed acceleration, and the largest velocity of most devices."""
MOST_DIVISOR = 0xFF
CLOCKS_PER_BIT = 16
BAUD_TOLERANCE = 0.01
"""Most that a rate may differ from what a divisor makes: half of what a receiver bears is left to the host."""
RESET_BAUD = 19_200
"""The rate after power-up and Hard Reset, with the usual clock."""
RESET_BAUD_CODE = 0x3F


class BaudCodes(Enum):
    """The two families of baud rate divisors in use; they differ by a per cent or two in the rate."""

    MANUAL = "manual"
    """As printed in both manuals; 57600 comes out 3.3 % fast."""
    ALTERNATE = "alternate"
    """As later vendor software has them; 57600 comes out 1.4 % slow."""


BAUD_DIVISORS = MappingProxyType(
    {
        BaudCodes.MANUAL: MappingProxyType({9600: 0x81, 19_200: 0x3F, 57_600: 0x14, 115_200: 0x0A, 230_400: 0x05}),
        BaudCodes.ALTERNATE: MappingProxyType({9600: 127, 19_200: 64, 57_600: 21, 115_200: 0x0A, 230_400: 0x05}),
    }
)
"""The divisor of each rate."""
FASTEST_BAUD = 230_400
"""PIC-SERVO SC only: it has the code in a table and sets exactly this rate."""
BAUD_KEYS = MappingProxyType({code: baud for rates in BAUD_DIVISORS.values() for baud, code in rates.items()})
"""The table of PIC-SERVO SC for the byte: it has the codes of both families and sets its clock to the rate itself."""


def baud_divisor(baud: int, codes: BaudCodes = BaudCodes.MANUAL, clock_hz: int = CLOCK_HZ) -> int:
    """Return the Set Baud Rate code of a rate: a printed one, or the divisor that makes it within 1 %.

    "Please refer to the PIC16C7x data sheet for details in obtaining other baud rates" (PIC-SERVO manual, 5.2).

    Raises:
        ValueOutOfRange: no divisor makes this rate; names the nearest that one makes.
    """
    # vendors print some divisors that are not the nearest ones; drives are known to answer at those
    if clock_hz == CLOCK_HZ and (printed := BAUD_DIVISORS[codes].get(baud)) is not None:
        return printed
    divisor = min(max(round(clock_hz / CLOCKS_PER_BIT / baud) - 1, 0), MOST_DIVISOR) if baud > 0 else MOST_DIVISOR
    made = actual_baud(divisor, clock_hz)
    if abs(made - baud) > BAUD_TOLERANCE * made:
        raise ValueOutOfRange(
            f"no divisor of a {clock_hz / 1e6:g} MHz clock makes {baud} baud; the nearest rate is {made:.0f}",
            value=baud,
            limit=round(made),
            nearest=round(made),
        )
    return divisor


def actual_baud(divisor: int, clock_hz: int = CLOCK_HZ) -> float:
    """Return the rate that a module really uses with this code, 0 to 255."""
    # "programmed directly into the PIC16C73's SPBRG register with the bit BRGH = 1" (PIC-SERVO manual, 5.2)
    return clock_hz / CLOCKS_PER_BIT / (divisor + 1)


def baud_at_reset(clock_hz: int) -> int:
    """Return the rate after power-up and Hard Reset: 19200, and in proportion with another clock."""
    return RESET_BAUD if clock_hz == CLOCK_HZ else round(actual_baud(RESET_BAUD_CODE, clock_hz))


def module_baud(profile: Profile, code: int) -> float | None:
    """Return the rate that a device takes at this code of Set Baud Rate, 0 to 255; None when it has no such code."""
    return BAUD_KEYS.get(code) if profile.baud_keys else actual_baud(code, profile.clock_hz)


_KP = RegisterField("KP", 2, 0, 0x7FFF)
_KD = RegisterField("KD", 2, 0, 0x7FFF)
_KI = RegisterField("KI", 2, 0, 0x7FFF)
_IL = RegisterField("IL", 2, 0, 0x7FFF)
_OL = RegisterField("OL", 1, 0, 0xFF)
_CL = RegisterField("CL", 1, 0, 0xFF)
# "reserved. Must be set to 0" (LS-182AP manual, "Set Gain", byte 10)
_RESERVED_CL = RegisterField("CL (reserved on this drive)", 1, 0, 0)
# "servo rate divisor SR (1 - 0xFF)": 0 is in neither manual
_SR = RegisterField("SR", 1, 1, MOST_DIVISOR)
_DEADBAND = RegisterField("deadband compensation", 1, 0, 0xFF)
_STEP_MULTIPLIER = RegisterField("step multiplier", 1, 1, 0xFF)

BYTES_WITH_DEADBAND = 14
_BYTES_WITH_STEP_MULTIPLIER = 15


def encode_gains(profile: Profile, gains: Gains) -> bytes:
    """Return the 13, 14 or 15 data bytes for this device.

    Raises:
        ValueOutOfRange: a value does not fit its register.
        NotSupported: the device lacks a register that is not at its default.
    """
    # "versions 1, 2 & 3 will simply ignore the 14th data byte" (PIC-SERVO manual, 5.2): it would not do what was asked
    if gains.deadband and profile.gain_bytes < BYTES_WITH_DEADBAND:
        raise NotSupported(f"{profile.title} has no deadband compensation")
    if gains.step_multiplier != 1 and profile.gain_bytes < _BYTES_WITH_STEP_MULTIPLIER:
        raise NotSupported(f"{profile.title} has no step multiplier")
    values = (gains.kp, gains.kd, gains.ki, gains.il, gains.ol, gains.cl, gains.el, gains.sr)
    optional = (gains.deadband, gains.step_multiplier)
    fields = gain_fields(profile)
    return b"".join(field.encode(value) for field, value in zip(fields, values + optional, strict=False))


def decode_gains(profile: Profile, data: bytes) -> Gains:
    """Take data bytes as this device would, in range or not.

    Surplus bytes are ignored, a missing step multiplier is 1, everything else that is missing is 0.
    """
    values = []
    at = 0
    for field in gain_fields(profile):
        # "if ... only 13 data bytes are sent, version 4 will use a default value of zero" for the deadband (ibid.)
        present = field is not _STEP_MULTIPLIER or at < len(data)
        values.append(field.decode(data[at:]) if present else 1)
        at += field.width
    return Gains(*values)


def gain_fields(profile: Profile) -> tuple[RegisterField, ...]:
    """Return the registers in order; older devices have fewer."""
    fields: tuple[RegisterField, ...] = (
        _KP,
        _KD,
        _KI,
        _IL,
        _OL,
        # odd and even values limit by opposite signs of the sense voltage, 0 "effectively disables" it (ibid.)
        _CL if profile.current_limit else _RESERVED_CL,
        # 0 opens the loop at the first count: "minimal requirements are" EL <> 0 (LS-182AP manual, "Initializing")
        RegisterField("EL", 2, 0, profile.most_error_limit),
        _SR,
    )
    if profile.gain_bytes >= BYTES_WITH_DEADBAND:
        fields += (_DEADBAND,)
    if profile.gain_bytes >= _BYTES_WITH_STEP_MULTIPLIER:
        fields += (_STEP_MULTIPLIER,)
    return fields


# -- what registers hold -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Known:
    """A value that something proves.

    Attributes:
        value: what the register holds.
        since: when the proof came, in loop time.
        evidence: the proof.
    """

    value: int
    since: float
    evidence: Provenance


@dataclass(frozen=True, slots=True)
class Assumed:
    """A value that nothing proves, and why it is believed; it bounds nothing."""

    value: int
    why: str


@dataclass(frozen=True, slots=True)
class Unknown:
    """No value.

    Attributes:
        why: what made it unknown.
        among: values that it may be.
        others: it may be any other one as well.
    """

    why: str
    among: tuple[int, ...] = ()
    others: bool = True


Holding = Known | Assumed | Unknown
REPLY_LOST = "the reply to the command that writes it was lost"
TAKEN_OVER = "the module was taken over as it was"
_EVIDENCE = MappingProxyType(
    {
        Provenance.WRITTEN_AND_ACKNOWLEDGED: "the module has acknowledged it",
        Provenance.RESET: "the module was reset",
        Provenance.READ_BACK: "the module has shown it",
    }
)


class RegisterBook:
    """The registers of one module."""

    def __init__(self, names: Iterable[str], now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._holdings: dict[str, Holding] = dict.fromkeys(names, Unknown("nothing has written it yet"))

    def __getitem__(self, name: str) -> Holding:
        """Return what a register holds; of one that the module lacks nothing is known."""
        return self._holdings.get(name, Unknown("the module lacks it"))

    def known(self, name: str) -> int | None:
        """Return the value of a register that is known, or None."""
        holding = self._holdings.get(name)
        return holding.value if isinstance(holding, Known) else None

    def possible(self, name: str) -> tuple[int, ...]:
        """Return the values that a register may hold; none where it may hold any."""
        match self[name]:
            case Known(value):
                return (value,)
            case Unknown(_, among, others=False):
                return among
        return ()

    def holds(self, values: Mapping[str, int]) -> bool:
        """Tell whether all of these registers, as far as the module has them, are known to hold these values."""
        for name in self._holdings.keys() & values:
            holding = self._holdings[name]
            if not isinstance(holding, Known) or holding.value != values[name]:
                return False
        return True

    def note(self, values: Mapping[str, int], evidence: Provenance) -> None:
        """Enter values that something proves."""
        since = self._now_s()
        self._enter({name: Known(int(value), since, evidence) for name, value in values.items()})

    def assume(self, values: Mapping[str, int], why: str) -> None:
        """Enter values that nothing proves."""
        self._enter({name: Assumed(value, why) for name, value in values.items()})

    def forget(self, why: str, names: Iterable[str] | None = None) -> None:
        """Note that these registers, or all, may hold anything."""
        self._enter(dict.fromkeys(self._holdings if names is None else names, Unknown(why)))

    @contextmanager
    def writing(self, values: Mapping[str, int]) -> Iterator[Callable[[], None]]:
        """Enclose the packets that write these values; yields what is to be called as one is sent, see `Bus.execute`.

        From then on until they are acknowledged, and for good if they are not, a register holds the one value or the
        other: it stays known only where both are the same. Packets that were never sent have changed nothing.
        """
        yield partial(self._doubt, values)
        self.note(values, Provenance.WRITTEN_AND_ACKNOWLEDGED)

    def _doubt(self, values: Mapping[str, int]) -> None:
        self._enter({name: self._either(name, value) for name, value in values.items() if self.known(name) != value})

    def _candidates(self, name: str) -> tuple[int, ...]:
        """Return values that a register may hold, perhaps besides others."""
        match self[name]:
            case Known(value):
                return (value,)
            case Unknown(_, among):
                return among
        return ()

    def _either(self, name: str, value: int) -> Unknown:
        match self[name]:
            # the reply was lost, not the packet, or the packet itself: both happen on a noisy line
            case Known(old):
                return Unknown(REPLY_LOST, (old, int(value)), others=False)
            case Unknown(_, among, others):
                return Unknown(REPLY_LOST, tuple(dict.fromkeys((*among, int(value)))), others)
        return Unknown(REPLY_LOST)

    def published(self) -> tuple[RegisterInfo, ...]:
        """Return every register that the module has, in the order of the manual."""
        return tuple(_published(name, holding) for name, holding in self._holdings.items())

    def _enter(self, holdings: Mapping[str, Holding]) -> None:
        for name in self._holdings.keys() & holdings:
            self._holdings[name] = holdings[name]


def _published(name: str, holding: Holding) -> RegisterInfo:
    match holding:
        case Known(value, _, evidence):
            return RegisterInfo(name=name, value=value, provenance=evidence, why=_EVIDENCE[evidence])
        case Assumed(value, why):
            return RegisterInfo(name=name, value=value, provenance=Provenance.ASSUMED, why=why)
        case Unknown(why, among, others):
            either = f": it is {' or '.join(map(str, among))}{' or another' if others else ''}" if among else ""
            return RegisterInfo(name=name, value=None, provenance=Provenance.UNKNOWN, why=why + either)


TRAJECTORY_NAMES = ("position", "velocity", "acceleration", "pwm_or_target")
TRAJECTORY_CONTROL = "trajectory_control"
LIMIT_PINS = MappingProxyType(
    {
        "limit1_pin": (LimitPins.LIMIT1_INPUT, LimitPins.LIMIT1_HIGH),
        "limit2_pin": (LimitPins.LIMIT2_INPUT, LimitPins.LIMIT2_HIGH),
    }
)
"""The two bits of I/O Control of each pin: input, and output high; without either it is an output that is low."""
FAST_PATH = "fast_path"


class ServoRegisters(RegisterBook):
    """The registers of one servo drive.

    None of Set Gain, Load Trajectory and I/O Control is among the status items of any dialect, so that nothing of them
    can be read back (LS-182AP manual, "Define Status"; PIC-SERVO manual, 5.2).

    Attributes:
        wanted_gains: see `Moves`.
        shown_tick: the servo tick in which the drive counts velocity, seconds, the shortest one that is possible, and
            whether that is uncertain.
    """

    shown_tick: tuple[float, bool]

    def __init__(self, profile: Profile, gains: Gains | None, now_s: Callable[[], float]) -> None:
        self.wanted_gains = gains
        self._profile = profile
        self._cycle_s = profile.servo_cycle_s
        lacking = {
            "cl": not profile.current_limit,
            "deadband": profile.gain_bytes < BYTES_WITH_DEADBAND,
            "step_multiplier": profile.gain_bytes < _BYTES_WITH_STEP_MULTIPLIER,
        }
        names = [each.name for each in fields(Gains) if not lacking.get(each.name, False)]
        names += [*TRAJECTORY_NAMES, TRAJECTORY_CONTROL]
        names += LIMIT_PINS if profile.limit_outputs else ()
        names += [FAST_PATH] if profile.path_points else []
        super().__init__(names, now_s)
        self.shown_tick = self._shown_tick()
        self._rates_before: frozenset[int] = frozenset()

    def loads(self) -> None:
        """A trajectory is about to be loaded: until one is started, the rates of before may be in force."""
        self._rates_before |= frozenset(filter(None, self.possible("acceleration")))

    def started(self) -> None:
        """What was loaded last was started: its acceleration is in force."""
        self._rates_before = frozenset()

    @property
    def rates(self) -> frozenset[int]:
        """The accelerations of which one is in force, as register values; empty where it may be any.

        The manuals do not say whether loading makes a rate that of a smooth stop, or only a start does.
        """
        held = self.possible("acceleration")
        return self._rates_before.union(held) if held else frozenset()

    def reset(self) -> None:
        """Enter the state after power-up: everything is 0 but the divisors and the pins (manuals, "Power-up").

        What a PIC-SERVO SC has saved in its EEPROM is restored by power-up only, and is overwritten at power-on.
        """
        self.started()
        # "whether the limit1 and 2 signals are inputs (default) or outputs" (PIC-SERVO manual, 5.2, "I/O Control")
        pins = {name: int(is_input) for name, (is_input, _) in LIMIT_PINS.items()}
        # "all gain parameters and limit values are set to zero; the servo rate divisor is set to 1" (ibid., "Powerup")
        self.note(dict.fromkeys(self._holdings, 0) | {"sr": 1, "step_multiplier": 1} | pins, Provenance.RESET)

    def taken_over(self, *, known: bool = False) -> None:
        """Another host may have had the drive: its registers may be as they were, or its gains as they are wanted.

        Args:
            known: this host had it before.
        """
        self.started()
        gains = asdict(self.wanted_gains) if self.wanted_gains else {}
        held = {name: self[name] for name in gains} if known else {}
        # no command reads what Set Gain, Load Trajectory and I/O Control of another host have written
        self._enter({name: Unknown(TAKEN_OVER, self._candidates(name)) for name in self._holdings})
        written = {name: each.value for name, each in held.items() if isinstance(each, Known)}
        self.assume(written, f"{TAKEN_OVER}; this host has written it before")
        # a gap proves nothing: an assumed value keeps its reason, a doubtful one is unknown
        self._enter({name: each for name, each in held.items() if isinstance(each, Assumed)})
        self.assume({name: gains[name] for name in gains.keys() - held}, f"{TAKEN_OVER}; this is what it is to hold")

    @property
    def loaded(self) -> bool:
        """Whether the drive is known to hold the gains that it should."""
        return self.wanted_gains is not None and self.holds(asdict(self.wanted_gains))

    @property
    def divisor(self) -> int | None:
        """The servo rate divisor on which velocity and acceleration depend; None while it is not known."""
        # "the servo tick rate is also used as the profiling timebase" (ibid., "Set Gain"); not so on every model
        return self.known("sr") if self._profile.divisor_slows_profile else 1

    @property
    def next_divisor(self) -> int | None:
        """The one in force when the next motion is loaded: until then the gains are; None while it is not known."""
        return self.wanted_gains.sr if self.wanted_gains and self._profile.divisor_slows_profile else self.divisor

    def _shown_tick(self) -> tuple[float, bool]:
        if not self._profile.divisor_slows_profile:
            return self._cycle_s, False
        match self["sr"]:
            case Known(value):
                return self._cycle_s * value, False
            # the shortest tick that is possible makes the highest velocity: no limit is taken for kept that is not
            case Unknown(_, among, others=False):
                return self._cycle_s * min(among, default=1), True
        return self._cycle_s, True  # it may be any one, also where another is assumed

    @override
    def _enter(self, holdings: Mapping[str, Holding]) -> None:
        super()._enter(holdings)
        if "sr" in holdings:
            self.shown_tick = self._shown_tick()
