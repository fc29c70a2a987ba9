"""Why an axis cannot move now: every guard is evaluated, not only the first that refuses."""

from collections.abc import Callable

from ldcnd.daemon.axis import guards
from ldcnd.daemon.axis.state import AxisTracker
from ldcnd.errors import DriveFault, LdcndError, Remedy, step
from ldcnd.messaging.codec import remedy_steps
from ldcnd.model.commands import Cause, WhyReply
from ldcnd.model.samples import FaultEntry


def explain(tracker: AxisTracker, admit: Callable[[], None], *, absolute: bool) -> WhyReply:
    """Evaluate every guard for a motion.

    Args:
        tracker: what is known of the axis.
        admit: raises what the authority would refuse the sender with.
        absolute: whether the motion would name a position.
    """
    checks: list[Callable[[], None]] = [
        admit,
        lambda: guards.check_reachable(tracker),
        lambda: guards.check_not_latched(tracker),
        *(_fault(tracker.name, fault) for fault in tracker.active_faults if fault.source == "drive"),
        lambda: guards.check_not_in_error(tracker),
        lambda: guards.check_enabled(tracker),
        lambda: guards.check_stands(tracker),
    ]
    if absolute:
        checks.append(lambda: guards.check_referenced(tracker))
    causes = []
    for check in checks:
        try:
            check()
        except LdcndError as error:
            causes.append(
                Cause(
                    code=error.code.value,
                    text=error.message,
                    remedy=error.remedy,
                    steps=remedy_steps(error),
                    page=error.page,
                )
            )
    first = tracker.first_fault
    return WhyReply(
        axis=tracker.name,
        can_move=not causes,
        causes=tuple(causes),
        first_fault=f"{first.code}: {first.text}" if first else None,
    )


def _fault(axis: str, fault: FaultEntry) -> Callable[[], None]:
    def check() -> None:
        raise DriveFault(
            f"axis {axis}: {fault.text}",
            axis=axis,
            value=fault.code,
            remedy=Remedy("remove the cause, then {}", step("reset")),
        )

    return check
