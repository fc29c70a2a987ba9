"""Reading all parameters of a drive, planning what another one needs, and carrying the plan out write by write."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.parameters import (
    Memory,
    ParameterDump,
    PlannedParameters,
    PlannedWrite,
    PlanParameters,
    ReadAllParameters,
    WriteParameter,
)

Progress = Callable[[int, PlannedWrite], None]
"""Takes how many writes are done, and the next one."""


@dataclass(frozen=True, slots=True)
class Transfer:
    """The outcome of a plan; every write of it is in exactly one of the three.

    Attributes:
        done: writes that were read back with their value.
        failed: the write that failed, and why; None when all are done.
        left: writes that were not tried after it.
        remarks: what the daemon said about the writes.
    """

    done: tuple[PlannedWrite, ...]
    failed: tuple[PlannedWrite, LdcndError] | None = None
    left: tuple[PlannedWrite, ...] = ()
    remarks: tuple[str, ...] = ()


async def read_dump(client: RigClient, axis: str) -> ParameterDump:
    """Read all listed parameters of a drive from both memories, and what the drive is."""
    return await client.command(axis, ReadAllParameters())


async def plan_transfer(
    client: RigClient,
    axis: str,
    values: Mapping[str, int],
    driver_type: int | None,
    *,
    memory: Memory | None = None,
    any_type: bool = False,
) -> PlannedParameters:
    """List the writes after which a drive holds these values; only reads."""
    request = PlanParameters(values=values, driver_type=driver_type, memory=memory, any_type=any_type)
    return (await client.command(axis, request)).plan


async def carry_out(client: RigClient, axis: str, plan: PlannedParameters, progress: Progress) -> Transfer:
    """Send the writes of a plan one by one; stop at the first that fails. Planning again completes it."""
    last: dict[str, tuple[str, ...]] = {}  # of each parameter only what is true after its last write
    for place, write in enumerate(plan.writes):
        progress(place, write)
        request = WriteParameter(parameter=write.parameter, value=write.value, memory=write.memory)
        try:
            reply = await client.command(axis, request)
        except LdcndError as error:
            return Transfer(plan.writes[:place], (write, error), plan.writes[place + 1 :], _all_of(last))
        last[write.parameter] = reply.remarks
    return Transfer(plan.writes, remarks=_all_of(last))


def _all_of(remarks: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(each for said in remarks.values() for each in said))
