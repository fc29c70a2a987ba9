"""The Wireshark dissector of LDCN/NMC and SmartStep lines: Lua, its tables written from those of the codecs.

What cannot be in a table, such as which reply belongs to which request, is in dissector.lua. `pcapng` writes
the captures: link type USER0, the direction of each packet among its options.
"""

from collections.abc import Iterable, Mapping
from enum import IntEnum, IntFlag
from importlib.resources import files
from pathlib import Path

from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, StatusFlag, StatusItem
from ldcnd.drives.ldcn.profiles import PIC_SERVO_SC, PROFILES, HomingControl, Profile
from ldcnd.drives.ldcn.registers import gain_fields
from ldcnd.drives.ldcn.trajectory import TrajectoryControl
from ldcnd.drives.smartstep.addresses import Register
from ldcnd.drives.smartstep.monitors import WORDS
from ldcnd.drives.smartstep.packet import Function, ResponseStatus
from ldcnd.drives.smartstep.parameters import PARAMETERS

PERSONAL_PLUGINS = Path(".local/lib/wireshark/plugins")
"""Below the home directory (Wireshark's own documentation, "Plugin folders")."""
FILE = "ldcnd.lua"


def dissector() -> str:
    """Return the whole plugin."""
    tables = (
        _table("COMMANDS", _names(CommandCode)),
        _flags("STATUS_ITEMS", StatusItem),
        _flags("STATUS_FLAGS", StatusFlag),
        _flags("AUX_FLAGS", AuxFlag),
        _flags("TRAJECTORY_FLAGS", TrajectoryControl),
        _flags("STOP_FLAGS", StopControl),
        _flags("HOMING_FLAGS", HomingControl),
        _rows("GAIN_REGISTERS", (f'{{"{field.name}", {field.width}}}' for field in gain_fields(PIC_SERVO_SC))),
        _rows("DIALECTS", map(_dialect, PROFILES.values())),
        _table("FUNCTIONS", _names(Function)),
        _table("RESPONSES", _names(ResponseStatus)),
        _table("REGISTERS", _registers()),
        f'local STRING_REFERENCE = "{int(Function.STRING_REFERENCE)}"\n',
    )
    head = "-- Written by ldcnd from the tables of its codecs; not meant to be edited.\n\n"
    return head + "\n".join(tables) + "\n" + (files("ldcnd.ops") / "dissector.lua").read_text(encoding="utf-8")


def install(home: Path) -> Path:
    """Write the plugin to the directory that a user's Wireshark and tshark search; return the file."""
    file = home / PERSONAL_PLUGINS / FILE
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(dissector(), encoding="utf-8")
    return file


def _names(numbers: type[IntEnum]) -> dict[int, str]:
    return {int(member): member.name for member in numbers}


def _registers() -> dict[int, str]:
    """Return a name for each address of a SmartStep that has one."""
    names = {monitor.address: name.value for name, monitor in WORDS.items()}
    for parameter in PARAMETERS:
        names[parameter.eeprom_address] = f"{parameter.label} (EEPROM)"
        names[parameter.ram_address] = f"{parameter.label} (RAM)"
    return names | _names(Register)


def _table(name: str, values: Mapping[int, str]) -> str:
    rows = "".join(f'    [0x{number:X}] = "{text}",\n' for number, text in sorted(values.items()))
    return f"local {name} = {{\n{rows}}}\n"


def _flags(name: str, flags: type[IntFlag]) -> str:
    return _rows(name, (f'{{0x{int(flag):02X}, "{flag.name}"}}' for flag in flags))


def _rows(name: str, rows: Iterable[str]) -> str:
    return f"local {name} = {{\n{''.join(f'    {row},{chr(10)}' for row in rows)}}}\n"


def _dialect(profile: Profile) -> str:
    return (
        f'{{title = "{profile.title}", id = {profile.device_id}, first = {profile.versions[0]},'
        f" last = {profile.versions[-1]}, adc = {profile.adc_bytes},"
        f" position_error = {profile.position_error_bytes}, bit7 = {profile.bit7_bytes}}}"
    )
