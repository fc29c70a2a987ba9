"""The faults that the daemon finds; the drive tells all others."""

from ldcnd.contract.fault_pages import page_of
from ldcnd.contract.samples import FaultEntry, PastFault
from ldcnd.drives.driver import Fault

LINK_LOST = Fault("link_lost", "the drive does not answer; check its power and the line, then send reset")
LINK_BLOCKED = (
    "the drive does not answer, nor does {before}, before it on the line and needed to reach it: switch that on first,"
    " then send reset"
)
NOT_IDENTIFIED = Fault(
    "not_identified",
    "what answers is not known to be this drive: only what stops it is sent; correct the wiring or the configuration",
)
STOP_UNCONFIRMED = Fault(
    "stop_unconfirmed",
    "a stop was requested and the drive has not confirmed it; it is sent again until the drive does",
    stops=False,
)
LOOP_OPENED = Fault("loop_opened", "the drive opened its position loop by itself; find out why, then send reset")

NOT_SETTLED = Fault(
    "not_settled",
    "the axis did not stay within its window around the target in time; check for a jam, the load and the gains,"
    " then send reset",
    hides_motion=True,
)
NOT_FOLLOWED = Fault(
    "not_followed",
    "the shaft was not seen to go where its motion sent it: it is jammed, its encoder missed counts, or another program"
    " has stopped it; its motor is switched off; look at the machine, check encoder, cable and coupling, then send"
    " reset and home",
    loses_position=True,
    hides_motion=True,
)
STOOD_AT_ONCE = Fault(
    "stood_at_once",
    "the shaft turned with its motor off and stood from one reading to the next: a brake or a crash, or an encoder that"
    " does not count any more; look at the machine, then send reset and home",
    stops=False,
    loses_position=True,
    hides_motion=True,
)
JUMPED = Fault(
    "position_jump",
    "the position has changed by more than the axis can have moved; check the encoder, its cable and the coupling,"
    " then send reset and home",
    loses_position=True,
    hides_motion=True,
)
READINGS_CONTRADICT = Fault(
    "readings_contradict",
    "the drive replies, and its readings contradict each other and what was commanded; a stop was sent; switch the axis"
    " off, check gains, servo rate divisor and encoder, then send reset and home",
    loses_position=True,
    hides_motion=True,
)
REPLIES_UNUSABLE = Fault(
    "replies_unusable",
    "the drive replies, but polls reach it damaged or its replies make no sense: it is not known what it does; a stop"
    " was sent; check the line for noise and its termination, then send reset",
)
REFERENCE_REFUSED = Fault(
    "reference_refused",
    "the reference that an earlier daemon has kept was refused",
    stops=False,
)
DRIVE_RESET = Fault(
    "drive_reset",
    "the drive's position counter has restarted at 0: it was reset, or another program has set the counter; keep other"
    " programs off the line, then send reset and home",
    loses_position=True,
)
DRIVE_CHANGED = Fault(
    "drive_changed",
    "the drive is not as this daemon has left it; the events say what differs: undo it, or take it over",
    stops=False,
)
OUTSIDE_LIMITS = Fault(
    "outside_limits",
    "the axis is outside its software limits, where no command has sent it; move it back to a position inside, and find"
    " out what moved it there",
    stops=False,
)
OF_DAEMON = (
    DRIVE_CHANGED,
    DRIVE_RESET,
    LINK_LOST,
    LOOP_OPENED,
    JUMPED,
    NOT_FOLLOWED,
    NOT_IDENTIFIED,
    NOT_SETTLED,
    OUTSIDE_LIMITS,
    READINGS_CONTRADICT,
    REFERENCE_REFUSED,
    REPLIES_UNUSABLE,
    STOOD_AT_ONCE,
    STOP_UNCONFIRMED,
)
OF_DAEMON_CODES = frozenset(fault.code for fault in OF_DAEMON)


def entry_of(fault: Fault, now_ns: int) -> FaultEntry:
    """Return a fault that has come up as it is published, with its page and who has found it."""
    return FaultEntry(
        code=fault.code,
        text=fault.text,
        since=now_ns,
        source="daemon" if fault.code in OF_DAEMON_CODES else "drive",
        stops=fault.stops,
        hides_motion=fault.hides_motion,
        page=page_of(fault.code),
    )


def entry_again(past: PastFault) -> FaultEntry:
    """Return the entry of a fault that an earlier daemon has kept."""
    return FaultEntry(**past.model_dump(), page=page_of(past.code))
