"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.catalogue import AXIS_COMMANDS
from ldcnd.model.commands import LONGEST_NAME as LONGEST_NAME
from ldcnd.model.commands import AxisCommand as AxisCommand
from ldcnd.model.commands import BufferMode as BufferMode
from ldcnd.model.commands import CommandReply
from ldcnd.model.commands import Halt as Halt
from ldcnd.model.commands import Home as Home
from ldcnd.model.commands import HomeMethod as HomeMethod
from ldcnd.model.commands import HomeStop as HomeStop
from ldcnd.model.commands import Move as Move
from ldcnd.model.commands import MoveAbsolute as MoveAbsolute
from ldcnd.model.commands import MoveAnalog as MoveAnalog
from ldcnd.model.commands import MoveRelative as MoveRelative
from ldcnd.model.commands import MoveVelocity as MoveVelocity
from ldcnd.model.commands import PinMode as PinMode
from ldcnd.model.commands import Power as Power
from ldcnd.model.commands import QuickStop as QuickStop
from ldcnd.model.commands import Reset as Reset
from ldcnd.model.commands import SetGains as SetGains
from ldcnd.model.commands import SetOutputs as SetOutputs
from ldcnd.model.commands import SetPosition as SetPosition
from ldcnd.model.commands import SetPwm as SetPwm
from ldcnd.model.commands import Stop as Stop
from ldcnd.model.commands import Track as Track
from ldcnd.model.commands import Verb as Verb
from ldcnd.model.parameters import ClearCounter as ClearCounter
from ldcnd.model.parameters import ListParameters as ListParameters
from ldcnd.model.parameters import ReadAlarms as ReadAlarms
from ldcnd.model.parameters import ReadAllParameters as ReadAllParameters
from ldcnd.model.parameters import ReadParameter as ReadParameter
from ldcnd.model.parameters import ReadProfile as ReadProfile
from ldcnd.model.parameters import WriteParameter as WriteParameter
from ldcnd.model.traces import AbortTrace as AbortTrace
from ldcnd.model.traces import TakeTrace as TakeTrace

Request = AxisCommand[CommandReply]
PowerRequest = Power
MoveRequest = Move
MoveAbsoluteRequest = MoveAbsolute
MoveRelativeRequest = MoveRelative
MoveVelocityRequest = MoveVelocity
HaltRequest = Halt
StopRequest = Stop
QuickStopRequest = QuickStop
HomeRequest = Home
ResetRequest = Reset
SetPositionRequest = SetPosition
SetGainsRequest = SetGains
MoveAnalogRequest = MoveAnalog
SetPwmRequest = SetPwm
TrackRequest = Track
SetOutputsRequest = SetOutputs
ListParametersRequest = ListParameters
ReadParameterRequest = ReadParameter
ReadAllParametersRequest = ReadAllParameters
WriteParameterRequest = WriteParameter
ClearCounterRequest = ClearCounter
ReadAlarmsRequest = ReadAlarms
ReadProfileRequest = ReadProfile
TraceRequest = TakeTrace
TraceAbortRequest = AbortTrace
REQUEST_MODELS = AXIS_COMMANDS
REPLY_MODELS: dict[Verb, type[CommandReply]] = {
    verb: model.reply_model() for verb, model in REQUEST_MODELS.items() if model.reply_model() is not CommandReply
}
