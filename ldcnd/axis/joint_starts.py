"""Starts of several axes: each member's permission is asked for directly before the packet that starts all."""

from collections.abc import Callable, Mapping, Sequence

from ldcnd.axis.permit import Permit
from ldcnd.contract.errors import OutcomeUnknown, RequestRefused
from ldcnd.drives.driver import CountsMotion
from ldcnd.drives.network import Network
from ldcnd.line.proof import only_while


async def start_path(network: Network, names: frozenset[str], permits: Sequence[Permit]) -> None:
    """Start axes on their paths; every member's permission is checked directly before the packet that starts.

    Raises:
        LdcndError: as `Permit.ask_to_move` of any member, and as `Network.start_path`.
    """
    # made before any of them has begun: each still asks whether its command comes in time
    conditions = [permit.to_move() for permit in permits]

    def ask_all() -> None:
        for condition in conditions:
            condition()

    for permit in permits:
        permit.begin()
    with only_while(ask_all):
        await network.start_path(names, ask_all)


async def start_together(
    network: Network, motions: Mapping[str, CountsMotion], permits: Sequence[Permit], announce: Callable[[], None]
) -> None:
    """Start axes in the same servo cycle; every member's permission is checked directly before the packet that starts.

    Args:
        network: of their line.
        motions: by axis name.
        permits: of all members.
        announce: called between the last check and the first packet.

    Raises:
        LdcndError: as `Permit.ask_to_move` of any member, and as `Network.start_group`.
    """

    def about_to_start() -> None:
        ask_all()
        announce()

    def ask_all() -> None:
        for condition in conditions:
            condition()

    conditions = [permit.to_move() for permit in permits]
    ask_all()
    with only_while(ask_all):
        await network.start_group(motions, about_to_start)
    conditions = [permit.to_go_on() for permit in permits]
    try:
        ask_all()
    except RequestRefused as error:  # a member was stopped between the packet that started all and their answers
        raise OutcomeUnknown(
            f"{error.message}; the others had been started, so all are commanded to stop",
            axis=error.axis,
            remedy="read the axis states before anything else",
        ) from error
