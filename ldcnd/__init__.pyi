# made by `make fix` from what `__init__.py` names; not edited
from ldcnd.client.axis import Axis
from ldcnd.client.axis import Positions
from ldcnd.client.blocking import BlockingAxis
from ldcnd.client.blocking import BlockingJogging
from ldcnd.client.blocking import BlockingMotion
from ldcnd.client.blocking import BlockingRig
from ldcnd.client.blocking import BlockingStream
from ldcnd.client.blocking import Facade
from ldcnd.client.blocking import Opened
from ldcnd.client.blocking import connect as connect_blocking
from ldcnd.client.blocking import open_rig as open
from ldcnd.client.motion import Jogging
from ldcnd.client.motion import Motion
from ldcnd.client.motion import Position
from ldcnd.client.motion import Progress
from ldcnd.client.motion import Sent
from ldcnd.client.motion import State
from ldcnd.client.rig import Rig
from ldcnd.client.rig import Stream
from ldcnd.client.rig import UnfinishedMotion
from ldcnd.client.rig import connect
from ldcnd.client.traces import Trace
from ldcnd.contract.commands import About
from ldcnd.contract.commands import BufferMode
from ldcnd.contract.commands import Capability
from ldcnd.contract.commands import CommandReply
from ldcnd.contract.commands import Direction
from ldcnd.contract.commands import Effect
from ldcnd.contract.commands import Ends
from ldcnd.contract.commands import ErrorReply
from ldcnd.contract.commands import HomeMethod
from ldcnd.contract.commands import HomeStop
from ldcnd.contract.commands import MotionKind
from ldcnd.contract.commands import PinMode
from ldcnd.contract.commands import ProbeSource
from ldcnd.contract.commands import ProbeStop
from ldcnd.contract.commands import ReceivedError
from ldcnd.contract.commands import RemedyStep
from ldcnd.contract.commands import Role
from ldcnd.contract.commands import StopReply
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import AccelerationLimit
from ldcnd.contract.errors import AddressRefused
from ldcnd.contract.errors import AxisUnreachable
from ldcnd.contract.errors import BadReply
from ldcnd.contract.errors import BusBusy
from ldcnd.contract.errors import BusDown
from ldcnd.contract.errors import BusError
from ldcnd.contract.errors import BusyTracing
from ldcnd.contract.errors import ByteCountRefused
from ldcnd.contract.errors import CommandAborted
from ldcnd.contract.errors import CommandExpired
from ldcnd.contract.errors import CommandIdReused
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.errors import DataRefused
from ldcnd.contract.errors import DriveFault
from ldcnd.contract.errors import DuplicateDaemon
from ldcnd.contract.errors import EepromBudgetSpent
from ldcnd.contract.errors import ErrorCode
from ldcnd.contract.errors import InterlockViolated
from ldcnd.contract.errors import InternalError
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.errors import LeaseExpired
from ldcnd.contract.errors import LeaseHeld
from ldcnd.contract.errors import LeaseRequired
from ldcnd.contract.errors import LeaseUnknown
from ldcnd.contract.errors import MalformedRequest
from ldcnd.contract.errors import NetworkMismatch
from ldcnd.contract.errors import NotIdentified
from ldcnd.contract.errors import NotPermitted
from ldcnd.contract.errors import NotReferenced
from ldcnd.contract.errors import NotSupported
from ldcnd.contract.errors import OutcomeUnknown
from ldcnd.contract.errors import PacketRejected
from ldcnd.contract.errors import PayloadTooLarge
from ldcnd.contract.errors import PositionLimit
from ldcnd.contract.errors import RegisterUnknown
from ldcnd.contract.errors import Remedy
from ldcnd.contract.errors import RemedyCommand
from ldcnd.contract.errors import ReplyTimeout
from ldcnd.contract.errors import RequestRefused
from ldcnd.contract.errors import SessionError
from ldcnd.contract.errors import ShuttingDown
from ldcnd.contract.errors import StaleSequence
from ldcnd.contract.errors import StopLatched
from ldcnd.contract.errors import StopNotConfirmed
from ldcnd.contract.errors import TooManyRequests
from ldcnd.contract.errors import TraceTimedOut
from ldcnd.contract.errors import TransportLost
from ldcnd.contract.errors import UnknownAxis
from ldcnd.contract.errors import UnknownCommand
from ldcnd.contract.errors import UnknownVerb
from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.contract.errors import VelocityLimit
from ldcnd.contract.errors import WildcardRefused
from ldcnd.contract.errors import WrongState
from ldcnd.contract.events import CommandEvent
from ldcnd.contract.events import CommandOutcome
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.events import EventList
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.history import Within
from ldcnd.contract.leases import GuestSentAway
from ldcnd.contract.leases import Holder
from ldcnd.contract.leases import HolderList
from ldcnd.contract.leases import LeaseReply
from ldcnd.contract.leases import LeaseRequest
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.meta import AxisLimits
from ldcnd.contract.meta import BusInfo
from ldcnd.contract.meta import CommandInfo
from ldcnd.contract.meta import CommandList
from ldcnd.contract.meta import DaemonInfo
from ldcnd.contract.meta import ModuleInfo
from ldcnd.contract.meta import Provenance
from ldcnd.contract.meta import RegisterInfo
from ldcnd.contract.parameters import AlarmEntry
from ldcnd.contract.parameters import AlarmReport
from ldcnd.contract.parameters import CounterName
from ldcnd.contract.parameters import CounterReply
from ldcnd.contract.parameters import DigitInfo
from ldcnd.contract.parameters import DriveFacts
from ldcnd.contract.parameters import EepromCount
from ldcnd.contract.parameters import Memory
from ldcnd.contract.parameters import MonitorReading
from ldcnd.contract.parameters import MonitorReport
from ldcnd.contract.parameters import ParameterDump
from ldcnd.contract.parameters import ParameterInfo
from ldcnd.contract.parameters import ParameterList
from ldcnd.contract.parameters import ParameterPlan
from ldcnd.contract.parameters import ParameterReply
from ldcnd.contract.parameters import ParameterValue
from ldcnd.contract.parameters import PlannedParameters
from ldcnd.contract.parameters import PlannedWrite
from ldcnd.contract.questions import Cause
from ldcnd.contract.questions import Hindered
from ldcnd.contract.questions import PreviewReply
from ldcnd.contract.questions import ShadowReply
from ldcnd.contract.questions import WhyReply
from ldcnd.contract.rig_commands import AxisShare
from ldcnd.contract.rig_commands import CapturedInputs
from ldcnd.contract.rig_commands import ConfigChange
from ldcnd.contract.rig_commands import FrozenPosition
from ldcnd.contract.rig_commands import GroupMoves
from ldcnd.contract.rig_commands import IoReply
from ldcnd.contract.rig_commands import IoTimer
from ldcnd.contract.rig_commands import LinePath
from ldcnd.contract.rig_commands import MoveTogetherReply
from ldcnd.contract.rig_commands import OverrideReply
from ldcnd.contract.rig_commands import PathReply
from ldcnd.contract.rig_commands import PreviewTogetherReply
from ldcnd.contract.rig_commands import Rehearsal
from ldcnd.contract.rig_commands import RehearsalReply
from ldcnd.contract.rig_commands import ReloadReply
from ldcnd.contract.rig_commands import SnapshotReply
from ldcnd.contract.rig_commands import SpeedOverrideReply
from ldcnd.contract.rig_commands import WireLogReply
from ldcnd.contract.samples import AdcSample
from ldcnd.contract.samples import AxisState
from ldcnd.contract.samples import CurrentCommand
from ldcnd.contract.samples import FaultEntry
from ldcnd.contract.samples import FaultSample
from ldcnd.contract.samples import FigureRange
from ldcnd.contract.samples import InputLevels
from ldcnd.contract.samples import InputsSample
from ldcnd.contract.samples import IoReading
from ldcnd.contract.samples import IoSample
from ldcnd.contract.samples import LatchSample
from ldcnd.contract.samples import LinkState
from ldcnd.contract.samples import MonitorContent
from ldcnd.contract.samples import MonitorName
from ldcnd.contract.samples import MonitorSample
from ldcnd.contract.samples import Moving
from ldcnd.contract.samples import PastFault
from ldcnd.contract.samples import PositionSample
from ldcnd.contract.samples import Quality
from ldcnd.contract.samples import Sample
from ldcnd.contract.samples import ShadowFigure
from ldcnd.contract.samples import ShadowSample
from ldcnd.contract.samples import StateSample
from ldcnd.contract.samples import TelemetryItem
from ldcnd.contract.samples import Unseen
from ldcnd.contract.samples import VelocitySample
from ldcnd.contract.traces import DriveTraceInfo
from ldcnd.contract.traces import TraceAbortReply
from ldcnd.contract.traces import TraceChannel
from ldcnd.contract.traces import TraceChunk
from ldcnd.contract.traces import TraceHeader
from ldcnd.contract.traces import TracePhase
from ldcnd.contract.traces import TraceReply
from ldcnd.contract.traces import TraceShape
from ldcnd.contract.traces import TraceSource
from ldcnd.contract.traces import TraceTrigger
from ldcnd.contract.traces import TriggerKind
from ldcnd.lab.recording.tables import recording

__all__ = [
    "About",
    "AccelerationLimit",
    "AdcSample",
    "AddressRefused",
    "AlarmEntry",
    "AlarmReport",
    "Axis",
    "AxisInfo",
    "AxisInstant",
    "AxisLimits",
    "AxisShare",
    "AxisState",
    "AxisUnreachable",
    "BadReply",
    "BlockingAxis",
    "BlockingJogging",
    "BlockingMotion",
    "BlockingRig",
    "BlockingStream",
    "BufferMode",
    "BusBusy",
    "BusDown",
    "BusError",
    "BusInfo",
    "BusyTracing",
    "ByteCountRefused",
    "Capability",
    "CapturedInputs",
    "Cause",
    "CommandAborted",
    "CommandEvent",
    "CommandExpired",
    "CommandIdReused",
    "CommandInfo",
    "CommandList",
    "CommandOutcome",
    "CommandReply",
    "CommandStatus",
    "ConfigChange",
    "ConfigError",
    "CounterName",
    "CounterReply",
    "CurrentCommand",
    "DaemonInfo",
    "DataRefused",
    "DigitInfo",
    "Direction",
    "DriveFacts",
    "DriveFault",
    "DriveTraceInfo",
    "DuplicateDaemon",
    "EepromBudgetSpent",
    "EepromCount",
    "Effect",
    "Ends",
    "ErrorCode",
    "ErrorReply",
    "EventList",
    "Facade",
    "FaultEntry",
    "FaultSample",
    "FigureRange",
    "FrozenPosition",
    "GroupMoves",
    "GuestSentAway",
    "Hindered",
    "Holder",
    "HolderList",
    "HomeMethod",
    "HomeStop",
    "InputLevels",
    "InputsSample",
    "InterlockViolated",
    "InternalError",
    "IoReading",
    "IoReply",
    "IoSample",
    "IoTimer",
    "Jogging",
    "LatchSample",
    "LdcndError",
    "LeaseExpired",
    "LeaseHeld",
    "LeaseReply",
    "LeaseRequest",
    "LeaseRequired",
    "LeaseUnknown",
    "LinePath",
    "LinkState",
    "MalformedRequest",
    "Memory",
    "ModuleInfo",
    "MonitorContent",
    "MonitorName",
    "MonitorReading",
    "MonitorReport",
    "MonitorSample",
    "Motion",
    "MotionKind",
    "MoveTogetherReply",
    "Moving",
    "NetworkMismatch",
    "NotIdentified",
    "NotPermitted",
    "NotReferenced",
    "NotSupported",
    "Opened",
    "OutcomeUnknown",
    "OverrideReply",
    "PacketRejected",
    "ParameterDump",
    "ParameterInfo",
    "ParameterList",
    "ParameterPlan",
    "ParameterReply",
    "ParameterValue",
    "PastFault",
    "PathReply",
    "PayloadTooLarge",
    "PinMode",
    "PlannedParameters",
    "PlannedWrite",
    "Position",
    "PositionLimit",
    "PositionSample",
    "Positions",
    "PreviewReply",
    "PreviewTogetherReply",
    "ProbeSource",
    "ProbeStop",
    "Progress",
    "Provenance",
    "Quality",
    "ReceivedError",
    "RegisterInfo",
    "RegisterUnknown",
    "Rehearsal",
    "RehearsalReply",
    "ReloadReply",
    "Remedy",
    "RemedyCommand",
    "RemedyStep",
    "ReplyTimeout",
    "RequestRefused",
    "Rig",
    "Role",
    "Sample",
    "Sent",
    "SessionError",
    "ShadowFigure",
    "ShadowReply",
    "ShadowSample",
    "ShuttingDown",
    "SnapshotReply",
    "SpeedOverrideReply",
    "StaleSequence",
    "State",
    "StateSample",
    "StopLatched",
    "StopNotConfirmed",
    "StopReply",
    "Stream",
    "TelemetryItem",
    "TooManyRequests",
    "Trace",
    "TraceAbortReply",
    "TraceChannel",
    "TraceChunk",
    "TraceHeader",
    "TracePhase",
    "TraceReply",
    "TraceShape",
    "TraceSource",
    "TraceTimedOut",
    "TraceTrigger",
    "TransportLost",
    "TriggerKind",
    "UnfinishedMotion",
    "UnknownAxis",
    "UnknownCommand",
    "UnknownVerb",
    "Unseen",
    "ValueOutOfRange",
    "VelocityLimit",
    "VelocitySample",
    "Verb",
    "WhyReply",
    "WildcardRefused",
    "WireLogReply",
    "Within",
    "WrongState",
    "connect",
    "connect_blocking",
    "open",
    "recording",
]
