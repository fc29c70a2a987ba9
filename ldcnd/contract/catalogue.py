"""All commands, and all models that cross the network."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

from ldcnd.contract import commands, parameters, questions, rig_commands, traces
from ldcnd.contract.commands import About, AxisCommand, Capability, Command, CommandReply, ErrorReply, StopReply, Verb
from ldcnd.contract.events import CommandEvent
from ldcnd.contract.frozen import Frozen, schema_name
from ldcnd.contract.health import BusHealth, DaemonHealth
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.leases import LeaseRequest
from ldcnd.contract.meta import AxisInfo, BusInfo, CommandList, DaemonInfo
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.samples import SAMPLE_MODELS, MonitorSample
from ldcnd.contract.traces import TraceChunk, TraceHeader

_AXIS = (*commands.COMMANDS, *questions.COMMANDS, *parameters.COMMANDS, *traces.COMMANDS)

AXIS_COMMANDS: Mapping[Verb, type[AxisCommand[CommandReply]]] = MappingProxyType(
    {verb: command for verb in Verb for command in _AXIS if command.verb == verb and issubclass(command, AxisCommand)}
)
"""Commands of an axis, by verb."""
AXIS_QUESTIONS: Mapping[str, type[Command[Frozen]]] = MappingProxyType(
    {command.verb: command for command in _AXIS if not issubclass(command, AxisCommand)}
)
"""Queries about an axis that the daemon answers without an exchange, by verb."""
RIG_COMMANDS: Mapping[str, type[Command[Frozen]]] = MappingProxyType(
    {command.verb: command for command in rig_commands.COMMANDS}
)
"""Commands and queries of the rig as a whole, by verb."""
COMMANDS: tuple[type[Command[Frozen]], ...] = (
    *AXIS_COMMANDS.values(),
    *AXIS_QUESTIONS.values(),
    *RIG_COMMANDS.values(),
)
"""Every command, in the order in which they are documented."""
BY_VERB: Mapping[About, Mapping[str, type[Command[Frozen]]]] = MappingProxyType(
    {about: MappingProxyType({each.verb: each for each in COMMANDS if each.about is about}) for about in About}
)
"""Commands by the last chunk of their key, in keys of axes and in those of the rig."""
RENAMED: Mapping[str, str] = MappingProxyType({"plan": "preview"})
"""Verbs of before, and what they are called now."""


def verbs_for(*capabilities: Capability) -> frozenset[Verb]:
    """Return the commands of a drive with these capabilities."""
    return frozenset(verb for verb, command in AXIS_COMMANDS.items() if command.capability in capabilities)


PUBLIC_MODELS: tuple[type[Frozen], ...] = (
    *COMMANDS,
    *(command.reply_model() for command in COMMANDS),
    *SAMPLE_MODELS.values(),
    AxisInfo,
    AxisInstant,
    BusHealth,
    BusInfo,
    CommandEvent,
    CommandList,
    DaemonHealth,
    DaemonInfo,
    ErrorReply,
    MonitorSample,
    RigBudget,
    StopReply,
    TraceChunk,
    TraceHeader,
    LeaseRequest,
)
"""Everything that crosses the network but the configuration, which is no part of the vocabulary."""

MODELS: Mapping[str, type[Frozen]] = MappingProxyType({schema_name(model): model for model in PUBLIC_MODELS})
"""The same by the name of their schema."""


@cache
def shipped_schemas() -> Mapping[str, bytes]:
    """Return all schemas, that of the configuration too, from their files, as `meta/schema/<name>` has them.

    A daemon generates none: that takes half as long as all the rest of its start-up, and `make check` holds the files
    to the models.
    """
    package = Path(__file__).parents[1]
    installed = package / "schemas"  # a wheel has a copy here; in a checkout they are beside the package
    folder = installed if installed.is_dir() else package.parent / "schemas"
    return MappingProxyType({path.stem: path.read_bytes() for path in sorted(folder.glob("*.json"))})
