"""The verbs of a drive whose parameters can be read: from a request to the drive's answer."""

from ldcnd.contract.commands import AxisCommand, CommandReply
from ldcnd.contract.errors import NotSupported
from ldcnd.contract.parameters import (
    AlarmReport,
    ClearCounter,
    CounterReply,
    EepromCount,
    ListParameters,
    MonitorReport,
    ParameterDump,
    ParameterList,
    ParameterPlan,
    ParameterReply,
    PlanParameters,
    ReadAlarms,
    ReadAllParameters,
    ReadMonitors,
    ReadParameter,
    RestartEepromCount,
    WriteParameter,
)
from ldcnd.drives.driver import Drive
from ldcnd.drives.parameter_access import ParameterAccess


class Parameters:
    """The parameter verbs of one axis; the caller sees to it that they come one after the other."""

    def __init__(self, driver: Drive, access: ParameterAccess) -> None:
        self._driver = driver
        self._access = access

    async def carry_out(self, command_id: str, command: AxisCommand[CommandReply]) -> CommandReply:
        """Do what the command says.

        Raises:
            RequestRefused: it cannot be done; nothing was changed.
            DriveFault: the drive declined.
            BusError: the line failed; `OutcomeUnknown` when a write could not be read back.
        """
        axis, access, verb = self._driver.spec.name, self._access, command.verb
        match command:
            case ListParameters():
                return ParameterList(command_id=command_id, axis=axis, verb=verb, parameters=access.known())
            case ReadParameter():
                value = await access.read(command.parameter, unlisted=command.unlisted)
                return ParameterReply(command_id=command_id, axis=axis, verb=verb, value=value)
            case ReadAllParameters():
                values, facts = await access.read_all(), await access.facts()
                return ParameterDump(command_id=command_id, axis=axis, verb=verb, values=values, facts=facts)
            case PlanParameters():
                return ParameterPlan(command_id=command_id, axis=axis, verb=verb, plan=await access.plan(command))
            case ReadMonitors(monitors=names):
                read = await access.monitors(names)
                readings = tuple(each.reading for each in read)
                return MonitorReport(command_id=command_id, axis=axis, verb=verb, readings=readings)
            case WriteParameter():
                done = await access.write(command)
                return ParameterReply(
                    command_id=command_id,
                    axis=axis,
                    verb=verb,
                    value=done.value,
                    written=done.written,
                    remarks=done.remarks,
                )
            case ClearCounter(counter=counter):
                cleared = await access.clear_counter(counter)
                return CounterReply(
                    command_id=command_id,
                    axis=axis,
                    verb=verb,
                    counter=counter,
                    value=cleared.value,
                    remarks=cleared.remarks,
                )
            case RestartEepromCount(writes=writes):
                previous = await access.restart_eeprom_count(writes)
                return EepromCount(command_id=command_id, axis=axis, verb=verb, previous=previous, total=writes)
            case ReadAlarms():
                present, history = await access.alarms()
                return AlarmReport(command_id=command_id, axis=axis, verb=verb, present=present, history=history)
            case _:
                raise NotSupported(f"axis {axis}: {verb} is not for parameters", axis=axis, value=verb.value)
