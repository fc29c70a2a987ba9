"""Verifying what the manual leaves open about traces, on the drive itself: strings first, then words, then the gear.

Three lengths of the same string tell what its count counts. Short traces beside the monitors of their channels leave
the readings of a word that agree with both; a person turns the shaft by hand, so that values are not zero, and lets
command pulses come in, so that their gear shows. The recorder's working registers are set; EEPROM is not written, the
drive moves nothing.
Source: manual 2.2, data string reference command; 3; 4, settings 3 and "Unit conversion".
"""

from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from ldcnd.contract.errors import BadReply, ByteCountRefused, DriveFault
from ldcnd.contract.traces import TakeTrace
from ldcnd.drives.smartstep.addresses import TRACE_1_AREA
from ldcnd.drives.smartstep.commands import AGREEING_REPLIES, LONGEST_STRING_BYTES, string_reference
from ldcnd.drives.smartstep.profiles import CountUnit, SmartStepProfile, StringChecksum
from ldcnd.drives.smartstep.trace import SmartStepTracer
from ldcnd.drives.smartstep.trace_check import Reading, readings
from ldcnd.drives.smartstep.words import Words
from ldcnd.line.bus import Bus

INTERVAL_S = 0.004
"""Of the traces: two seconds, in which each monitor is read several times."""
ATTEMPTS = 3
"""Traces for one question; each leaves fewer readings."""
SHORTEST_STRING_BYTES = 4
WORDS = ("trace_word_layout", "trace_byte_order")
GEAR = "command_pulse_gear"
Setting = str | int


class Stimulus(StrEnum):
    """The action of a person while a trace is recorded."""

    REST = "leave the drive alone, RUN off and RESET not pressed"
    TURN = "turn the shaft by hand, RUN off, to and fro, until the next message"
    PULSES = "let command pulses come in, at a constant speed, until the next message"


Act = Callable[[Stimulus], Awaitable[None]]
"""Returns when the person has begun."""


@dataclass(frozen=True, slots=True)
class Verified:
    """The drive's evidence on one assumption.

    Attributes:
        key: the field of the profile.
        setting: what the drive does; None where that does not show.
        text: for a person; without a setting, what would help.
    """

    key: str
    setting: Setting | None
    text: str


async def verify_traces(bus: Bus, words: Words, profile: SmartStepProfile, act: Act) -> AsyncIterator[Verified]:
    """Verify the assumptions that bear on traces; yields each one once.

    Raises:
        DriveFault: the drive declines, or its traces contradict each other.
        BusError: the line failed.
    """
    strings = await _string_settings(words, profile)
    for key, setting in strings.items():
        yield Verified(key, setting, f"{setting}, by strings of several lengths")
    profile = replace(
        profile,
        string_count_unit=CountUnit(str(strings["string_count_unit"])),
        trace_chunk_bytes=int(strings["trace_chunk_bytes"]),
        string_checksum=StringChecksum.AUTO,
    )
    tracer = SmartStepTracer(bus, words, profile)
    checksum = StringChecksum.AUTO
    # At rest a signal that is high shows its bit and the byte order; only a value that is not zero shows its scale.
    for stimulus in (Stimulus.REST, *[Stimulus.TURN] * ATTEMPTS):
        await act(stimulus)
        checksum = await _trace(tracer, ("speed_feedback", "position_deviation", "run", "reset"))
        if _is_single(tracer, profile, WORDS) and checksum is not StringChecksum.AUTO:
            break
    yield (
        Verified("string_checksum", None, "the traces leave a choice: every variant is taken")
        if checksum is StringChecksum.AUTO
        else Verified("string_checksum", checksum.value, f"{checksum.value}, by {AGREEING_REPLIES} replies or more")
    )
    for key in WORDS:
        yield _of(tracer, profile, key, "a value that is not zero would tell them apart: turn the shaft faster")
    for _ in range(ATTEMPTS):
        await act(Stimulus.PULSES)
        await _trace(tracer, ("command_pulse_speed", "reset"))
        if _is_single(tracer, profile, (GEAR,)):
            break
    yield _of(tracer, profile, GEAR, "pulses at a gear Pn202/Pn203 other than 1/1 would tell them apart")


async def _string_settings(words: Words, profile: SmartStepProfile) -> Mapping[str, Setting]:
    """Return what the count of a string counts, and how many bytes of memory a string may have.

    Raises:
        DriveFault: no unit fits.
    """
    for unit in CountUnit:
        tried = replace(profile, string_count_unit=unit)
        try:
            await words.ask(string_reference(words.unit, TRACE_1_AREA.start, SHORTEST_STRING_BYTES, tried))
        except BadReply:
            continue
        longest = LONGEST_STRING_BYTES
        while longest > SHORTEST_STRING_BYTES:
            try:
                await words.ask(string_reference(words.unit, TRACE_1_AREA.start, longest, tried))
            except ByteCountRefused:
                longest = longest // 4 * 2
            else:
                break
        return {"string_count_unit": unit.value, "trace_chunk_bytes": min(longest, profile.trace_chunk_bytes)}
    raise DriveFault(f"axis {words.axis}: strings have a length that no unit of their count explains", axis=words.axis)


async def _trace(tracer: SmartStepTracer, channels: tuple[str, ...]) -> StringChecksum:
    """Record a trace, which leaves fewer readings; return the checksum variant that its replies have shown.

    Raises:
        DriveFault: no reading agrees with the monitors.
    """
    armed = await tracer.arm(TakeTrace(channels=channels, interval_s=INTERVAL_S))
    recorded = await armed.record(lambda *_: None)
    if tracer.possible is None:
        raise DriveFault(f"no known layout of trace words agrees with the monitors: {'; '.join(recorded.problems)}")
    return StringChecksum(recorded.drive.string_checksum) if recorded.drive else StringChecksum.AUTO


def _left(tracer: SmartStepTracer, profile: SmartStepProfile, key: str) -> list[Setting]:
    """Return the settings of an assumption that the traces have left.

    Only the quotient of gear and encoder counts shows, so the gear is that with the counts of the profile.
    """
    possible: list[Reading] = readings(profile) if tracer.possible is None else list(tracer.possible)
    counts = profile.encoder_counts_per_rev
    return sorted({getattr(each, key) for each in possible if each.encoder_counts_per_rev == counts})


def _is_single(tracer: SmartStepTracer, profile: SmartStepProfile, keys: tuple[str, ...]) -> bool:
    return all(len(_left(tracer, profile, key)) == 1 for key in keys)


def _of(tracer: SmartStepTracer, profile: SmartStepProfile, key: str, advice: str) -> Verified:
    left = _left(tracer, profile, key)
    if len(left) == 1:
        return Verified(key, left[0], f"{left[0]}, by traces beside their monitors")
    return Verified(key, None, f"{', '.join(map(str, left))} agree with the monitors; {advice}")
