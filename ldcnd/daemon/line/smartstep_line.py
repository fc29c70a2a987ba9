"""From the configuration of a SmartStep line to its bus, its units and, where asked for, its simulated drives."""

import asyncio
from collections.abc import Mapping
from pathlib import Path

from ldcnd.bus.bus import Bus
from ldcnd.bus.settings import BusSettings
from ldcnd.config.axis import AxisConfig
from ldcnd.config.bus import BusConfig
from ldcnd.config.rig import RigConfig, SimulatedLineConfig
from ldcnd.drivers.driver import AxisSpec
from ldcnd.drivers.smartstep.drive import UnitSpec
from ldcnd.drivers.smartstep.ledger import EepromLedger
from ldcnd.drivers.smartstep.network import BAUD, SmartStepNetwork, smartstep_opener
from ldcnd.drivers.smartstep.parameter_store import EepromRules
from ldcnd.drivers.smartstep.profiles import Echo, Framing, SmartStepProfile
from ldcnd.planning.smartstep import rates_hz
from ldcnd.sim.chain import Chain
from ldcnd.sim.line import open_simulated_line
from ldcnd.sim.smartstep.cable import simulated_units, smartstep_chain
from ldcnd.transport.port_url import port_opener
from ldcnd.transport.serial_port import Framing as SerialFraming
from ldcnd.transport.transport import Opener

SIMULATED = "sim:"
LEDGER_FILE = "eeprom-writes.json"


def open_ledger(state_dir: Path | None) -> EepromLedger | None:
    """Return the ledger of EEPROM writes; None where nothing outlives the daemon.

    Raises:
        ConfigError: there is one and it cannot be read.
    """
    return EepromLedger(state_dir / LEDGER_FILE) if state_dir else None


def build_line(
    config: RigConfig,
    settings: BusConfig,
    ledger: EepromLedger | None,
    chains: Mapping[str, Chain],
    opener: Opener | None = None,
) -> tuple[Bus, SmartStepNetwork]:
    """Return the bus of a line and the units on it; nothing is opened yet.

    Args:
        config: the rig.
        settings: the line.
        ledger: counts EEPROM writes.
        chains: simulated lines that exist already, by name.
        opener: opens the line, manners included, instead of its port.
    """
    profiles = {axis.name: _profile(settings, axis) for axis in settings.axis}
    profile = profiles[settings.axis[0].name]  # what concerns the line is the same for all
    bus = Bus(
        BusSettings(
            settings.name,
            BAUD,
            margin_s=settings.margin_ms / 1000 + profile.quiet_s,
            attempts=profile.attempts,
            echo=profile.echo is Echo.EXPECT,
            recorded_s=settings.recorder.seconds,
            recorded_bytes=settings.recorder.memory_mb * 1_000_000,
        ),
        opener or smartstep_opener(_opener(config, settings, profile, chains), profile),
    )
    specs = tuple(
        UnitSpec(
            AxisSpec(axis.name, axis.address, axis.model, None),
            profiles[axis.name],
            rates_hz(axis),
            EepromRules(ledger, axis.smartstep.eeprom_budget),
        )
        for axis in settings.axis
    )
    return bus, SmartStepNetwork(bus, specs)


def _profile(settings: BusConfig, axis: AxisConfig) -> SmartStepProfile:
    line, unit = settings.smartstep, axis.smartstep
    profile = SmartStepProfile(
        framing=line.framing,
        wiring=line.wiring,
        echo=Echo(line.echo),
        first_character_s=unit.first_character_s,
        eeprom_write=unit.eeprom_write,
        encoder_counts_per_rev=unit.encoder_counts_per_rev,
        run_active_low=unit.run_active_low,
        reset_active_low=unit.reset_active_low,
        alarm_output_high=unit.alarm_output_high,
    )
    profile = unit.trace.assumed_of(profile)
    for key, verification in unit.verified.items():
        profile = profile.verified(key, verification)
    return profile


def _opener(config: RigConfig, settings: BusConfig, profile: SmartStepProfile, chains: Mapping[str, Chain]) -> Opener:
    if not settings.port.startswith(SIMULATED):
        framing: SerialFraming = "7e1" if profile.framing is Framing.SEVEN_EVEN else "8n1"
        return port_opener(settings.port, BAUD, framing, rs485=settings.transmitter)
    name = settings.port.removeprefix(SIMULATED)
    chain = chains.get(name) or _chain(next(line for line in config.sim if line.name == name), profile)
    return lambda: open_simulated_line(chain)


def _chain(line: SimulatedLineConfig, profile: SmartStepProfile) -> Chain:
    units = simulated_units(line.unit, asyncio.get_running_loop().time())
    return smartstep_chain(units, profile.wiring, profile.framing, echo=profile.echo is Echo.EXPECT)
