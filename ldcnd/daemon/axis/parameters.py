"""The verbs of a drive whose parameters can be read: from a request to the drive's answer."""

from ldcnd.drivers.driver import AxisDriver
from ldcnd.drivers.parameter_access import ParameterAccess
from ldcnd.errors import NotSupported
from ldcnd.model.commands import AxisCommand, CommandReply, Verb
from ldcnd.model.parameters import (
    AlarmReport,
    ClearCounter,
    CounterReply,
    DriveProfile,
    ParameterDump,
    ParameterList,
    ParameterReply,
    ReadParameter,
    WriteParameter,
)
from ldcnd.model.requests import REPLY_MODELS


class Parameters:
    """The parameter verbs of one axis; the caller sees to it that they come one after the other."""

    def __init__(self, driver: AxisDriver, access: ParameterAccess) -> None:
        self._driver = driver
        self._access = access

    @staticmethod
    def takes(verb: Verb) -> bool:
        """Tell whether a verb is one of these."""
        return verb in REPLY_MODELS

    async def carry_out(self, command_id: str, verb: Verb, request: AxisCommand[CommandReply]) -> CommandReply:
        """Do what the request says.

        Raises:
            RequestRefused: it cannot be done; nothing was changed.
            DriveFault: the drive declined.
            BusError: the line failed; `OutcomeUnknown` when a write could not be read back.
        """
        axis, access = self._driver.spec.name, self._access
        match request:
            case ReadParameter():
                value = await access.read(request.parameter, unlisted=request.unlisted)
                return ParameterReply(command_id=command_id, axis=axis, verb=verb, value=value)
            case WriteParameter():
                done = await access.write(request)
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
            case _:
                return await self._told(command_id, verb)

    async def _told(self, command_id: str, verb: Verb) -> CommandReply:
        """Answer the verbs that take no value."""
        axis, access = self._driver.spec.name, self._access
        match verb:
            case Verb.LIST_PARAMETERS:
                return ParameterList(command_id=command_id, axis=axis, verb=verb, parameters=access.known())
            case Verb.READ_ALL_PARAMETERS:
                values = await access.read_all()
                return ParameterDump(command_id=command_id, axis=axis, verb=verb, values=values)
            case Verb.READ_ALARMS:
                present, history = await access.alarms()
                return AlarmReport(command_id=command_id, axis=axis, verb=verb, present=present, history=history)
            case Verb.READ_PROFILE:
                return DriveProfile(
                    command_id=command_id,
                    axis=axis,
                    verb=verb,
                    model=self._driver.spec.model,
                    identity=self._driver.identity,
                    self_hearing=access.self_hearing,
                    assumptions=access.assumptions(),
                )
            case _:
                raise NotSupported(f"axis {axis}: {verb} is not for parameters", axis=axis, value=verb.value)
