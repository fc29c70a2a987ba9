"""Verifying what the manual leaves open about traces, once, on the drive itself: strings first, then words and gear.

Strings of three lengths tell what their count counts. One trace of command pulses at a constant speed, between two
readings of their monitor, leaves the ways to read a word that agree with both; the level of RESET beside it tells where
the signal's bit sits. The recorder's working registers are set; EEPROM is not written, the drive moves nothing.
Source: manual 2.2, data string reference command; 3, 8005H and 8007H; 4, settings 3 and "Unit conversion".
"""

import asyncio
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import click

from ldcnd.bench.edit import set_for_axis
from ldcnd.bench.known import line_of, with_line
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import BadReply, ByteCountRefused, ConfigError, DriveFault
from ldcnd.contract.traces import TakeTrace
from ldcnd.drives.smartstep.addresses import TRACE_1_AREA
from ldcnd.drives.smartstep.commands import LONGEST_STRING_BYTES, string_reference
from ldcnd.drives.smartstep.config import SmartStepBusConfig
from ldcnd.drives.smartstep.drive import SmartStepAxis
from ldcnd.drives.smartstep.profiles import (
    ByteOrder,
    CommandPulseGear,
    CountUnit,
    SmartStepProfile,
    StringChecksum,
    TraceWordLayout,
)
from ldcnd.drives.smartstep.trace import SmartStepTracer
from ldcnd.drives.smartstep.trace_data import DataObject, TraceConstants, decode_word, scale
from ldcnd.drives.smartstep.trace_result import monitor_of
from ldcnd.drives.smartstep.words import Words
from ldcnd.drives.tracer import Recorded
from ldcnd.line.bus import Bus
from ldcnd.log import configure_logging

INTERVAL_S = 0.004
"""Sampling interval of the trace, seconds: two seconds in all."""
SHORTEST_STRING_BYTES = 4
PULSES = "RUN off, RESET not pressed: let command pulses come in, fast and at a constant speed, until the next message"
SPEED, SIGNAL = CHANNELS = ("command_pulse_speed", "reset")
LAYOUTS = tuple(each for each in TraceWordLayout if each is not TraceWordLayout.RAW)
KEYS = ("trace_word_layout", "trace_byte_order", "command_pulse_gear")
Reading = tuple[TraceWordLayout, ByteOrder, CommandPulseGear]
Setting = str | int
Act = Callable[[str], Awaitable[None]]
"""Asks a person for something; returns when it has begun."""


@dataclass(frozen=True, slots=True)
class Verified:
    """The drive's evidence on one setting of its profile.

    Attributes:
        key: the field of the profile.
        setting: what the drive does; None where that does not show.
        text: for a person; without a setting, what would help.
    """

    key: str
    setting: Setting | None
    text: str


async def verify_traces(bus: Bus, words: Words, profile: SmartStepProfile, act: Act) -> AsyncIterator[Verified]:
    """Verify the settings of a profile that bear on traces; yields each one once.

    Raises:
        DriveFault: the drive declines, the pulses did not stay as they were, or no known layout agrees with them.
        BusError: the line failed.
    """
    strings = await _string_settings(words, profile)
    for key, setting in strings.items():
        yield Verified(key, setting, f"{setting}, by strings of several lengths")
    profile = profile.with_trace(
        string_count_unit=CountUnit(str(strings["string_count_unit"])),
        chunk_bytes=int(strings["trace_chunk_bytes"]),
        string_checksum=StringChecksum.AUTO,
    )
    await act(PULSES)
    before = await _shown(words)
    armed = await SmartStepTracer(bus, words, profile).arm(TakeTrace(channels=CHANNELS, interval_s=INTERVAL_S))
    recorded = await armed.record(lambda *_: None)
    after = await _shown(words)
    if abs(before[SPEED] - after[SPEED]) > 1 or before[SIGNAL] != after[SIGNAL]:
        raise DriveFault(
            f"axis {words.axis}: the pulses came at {before[SPEED]:g} r/min before the trace and at {after[SPEED]:g}"
            " after it, or RESET has changed",
            axis=words.axis,
            remedy="keep their speed constant, and verify again",
        )
    checksum = recorded.drive.string_checksum if recorded.drive else StringChecksum.AUTO
    if checksum == StringChecksum.AUTO:
        yield Verified("string_checksum", None, "the trace leaves a choice: every variant is taken")
    else:
        yield Verified("string_checksum", checksum, f"{checksum}, by the replies of the trace")
    agreeing = _agreeing(profile, recorded, before)
    if not agreeing:
        raise DriveFault(f"axis {words.axis}: no known layout of trace words agrees with the monitors", axis=words.axis)
    for key, values in zip(KEYS, zip(*agreeing, strict=True), strict=True):
        left = sorted({each.value for each in values})
        if len(left) == 1:
            yield Verified(key, left[0], f"{left[0]}, by a trace beside its monitors")
        else:
            advice = "faster pulses, at a gear Pn202/Pn203 of 4/1, would tell them apart"
            yield Verified(key, None, f"{', '.join(left)} agree with the monitors; {advice}")


async def _string_settings(words: Words, profile: SmartStepProfile) -> Mapping[str, Setting]:
    """Return what the count of a string counts, and how many bytes of memory a string may have.

    Raises:
        DriveFault: no unit fits.
    """
    for unit in CountUnit:
        tried = profile.with_trace(string_count_unit=unit)
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
        return {"string_count_unit": unit.value, "trace_chunk_bytes": min(longest, profile.unit.trace.chunk_bytes)}
    raise DriveFault(f"axis {words.axis}: strings have a length that no unit of their count explains", axis=words.axis)


async def _shown(words: Words) -> Mapping[str, float]:
    """Return what the monitors say of the channels."""
    monitors = {channel: monitor_of(channel) for channel in CHANNELS}
    return {channel: each.value_of(await words.read(each.monitor.address)) for channel, each in monitors.items()}


def _agreeing(profile: SmartStepProfile, recorded: Recorded, shown: Mapping[str, float]) -> list[Reading]:
    """Return the ways to read the words of a trace by which they are what the monitors show."""
    info, (column, *_) = recorded.drive, recorded.raw
    if info is None:
        return []
    gear = (info.gear_numerator or 1, info.gear_denominator or 1)
    constants = TraceConstants(info.cyclec_us, info.maxtrqc, info.osvelcc, *gear)
    agreeing: list[Reading] = []
    for layout, order, pulse_gear in product(LAYOUTS, ByteOrder, CommandPulseGear):
        words = {int(word or 0) for word in column}
        if order is not profile.unit.trace.byte_order:
            words = {(word >> 8 | word << 8) & 0xFFFF for word in words}
        points = [decode_word(word, layout) for word in words]
        factor = scale(profile.with_trace(command_pulse_gear=pulse_gear), constants, DataObject.COMMAND_PULSE_SPEED)
        # A monitor has whole units; a point whole counts, and one layout loses the lowest bit of them.
        slack = 1.0 + 2 * factor
        if all(
            abs(point.value * factor - shown[SPEED]) <= slack and float(bool(point.io)) == shown[SIGNAL]
            for point in points
        ):
            agreeing.append((layout, order, pulse_gear))
    return agreeing


def commands() -> tuple[click.Command, ...]:
    """Return the commands."""

    @click.command()
    @click.option("--config", type=click.Path(path_type=Path), required=True, help="The rig's configuration (TOML).")
    @click.option("--bus", "name", required=True, help="The line.")
    @click.option("--axis", required=True, help="The SmartStep; RUN must be off.")
    @click.option("--write", is_flag=True, help="Write what was verified into the configuration.")
    def verify(config: Path, name: str, axis: str, *, write: bool) -> None:
        """Verify the layout of a SmartStep's traces; prompts to send command pulses.

        The values of its traces are uncertain until the configuration says `verified`, which --write does when nothing
        stays open. Exits with 1 when something stays open.
        """
        found: list[Verified] = []

        async def work(bus: Bus, unit: SmartStepAxis) -> None:
            async for each in verify_traces(bus, unit.words, unit.profile, _act):
                found.append(each)
                state = "open" if each.setting is None else "verified"
                click.echo(f"{each.key:22} {state:8} {each.text}")

        asyncio.run(_with_drive(config, name, axis, work))
        if write:
            set_for_axis(config, axis, {"smartstep.trace": verified_keys(found)})
            click.echo(f"written to {config}")
        sys.exit(1 if any(each.setting is None for each in found) else 0)

    return (verify,)


def verified_keys(found: Sequence[Verified]) -> dict[str, str]:
    """Return the keys of the configuration's table `smartstep.trace` that say what was verified."""
    settings = {each.key: each.setting for each in found if each.setting is not None}
    keys = {
        key.removeprefix("trace_"): str(setting) if isinstance(setting, int) else f'"{setting}"'
        for key, setting in settings.items()
    }
    if settings.keys() >= set(KEYS):
        keys["verified"] = "true"
    return keys


async def _act(request: str) -> None:
    await asyncio.to_thread(click.prompt, f"{request}; Enter", default="", show_default=False, err=True)


def _line_of(rig: RigConfig, config: Path, name: str, axis: str) -> SmartStepBusConfig:
    for line in rig.bus:
        if line.name == name and isinstance(line, SmartStepBusConfig) and axis in [each.name for each in line.axis]:
            return line
    raise ConfigError(f"{config}: no smartstep line {name!r} with an axis {axis!r}")


async def _with_drive(
    config: Path, name: str, axis: str, work: Callable[[Bus, SmartStepAxis], Awaitable[None]]
) -> None:
    """Open the line of a SmartStep, do something with the drive, and close it.

    Raises:
        BusDown: the port does not open.
    """
    configure_logging(level="error")
    rig = load_config(config)
    settings = _line_of(rig, config, name, axis)
    line = line_of(rig, settings)
    unit = line.network.axes[axis]
    if not isinstance(unit, SmartStepAxis):
        raise ConfigError(f"{axis} is no SmartStep")
    await with_line(line.bus, settings.port, lambda: work(line.bus, unit))
