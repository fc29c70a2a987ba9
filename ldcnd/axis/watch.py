"""What a reading shows of what a drive was told: whether it brakes, counts, and goes where it was sent. Pure.

Each takes a status and a reading, and returns the status behind it; what is compared are the values in `course`,
`following` and `coast`.
"""

import math
from dataclasses import replace

from ldcnd.axis.coast import Coast
from ldcnd.axis.course import Braking, Pace, Way
from ldcnd.axis.events import MotionStarted, ReadingTaken, StopUnconfirmed
from ldcnd.axis.faults import NOT_FOLLOWED, STOOD_AT_ONCE
from ldcnd.axis.following import BRAKES_SHARE, Following
from ldcnd.axis.outcome import changed, fail, keep_stop, own_and, place_lost, target_lost, with_faults
from ldcnd.axis.rest import Comparison, shows_velocity
from ldcnd.axis.status import AxisStatus
from ldcnd.contract.commands import Verb
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import Fault, StopMode

NAMED_STOPS = frozenset({Verb.HALT, Verb.QUICK_STOP})
"""Commands that are under way while a drive brakes, and that are sent again by their own name."""
WENT_ON = "sent again, because the axis went on for longer than it should need to come to rest"
STRAYED = "sent because the axis was not on the way to its target"
UNFOLLOWED = "sent because the shaft was not seen to go where it was sent"
NOT_SEEN = "its reference is lost: it was not seen to move in time; look at the machine, then home it"
OUTRUN = "sent because the axis stayed faster than it was told"


def parted(status: AxisStatus, event: ReadingTaken, faults: tuple[Fault, ...]) -> bool:
    """Tell whether a shaft that cannot stand at once has left its encoder behind, which has missed counts then."""
    coasts_on = status.limits.slowing_counts_per_s2 is not None
    return coasts_on and not event.reading.enabled and any(fault.hides_motion for fault in faults)


def stood(status: AxisStatus, event: ReadingTaken) -> bool:
    """Tell whether a drive has let go of a shaft that was not seen to move, and pushed it: it jams, or moves unseen."""
    reading, following = event.reading, status.following
    if reading.enabled or not status.enabled or status.limits.stalls or shows_velocity(reading):
        return False
    if not any(fault.stops and fault.hides_motion for fault in reading.faults):
        return False
    # one that lags, or is pushed away, is seen to move until its drive trips
    if not status.state.is_motion:
        return any(fault.pushed for fault in reading.faults)
    return not following or abs(reading.position_counts - following.seen.low) < following.leeway.least_counts


def watch_braking(status: AxisStatus, braking: Braking, event: ReadingTaken) -> AxisStatus:
    """Have a stop sent again that a reading does not show to have been heard."""
    seen = braking.observe(event.reading, event.sent_at_s, driven_open=status.driven_open)
    if isinstance(seen, Braking):
        return status if seen is braking else replace(status, braking=seen)
    if seen is Comparison.AS_TOLD:
        return replace(status, braking=None, driven_open=False)
    if status.driven_open and braking.mode is StopMode.OFF:
        return replace(status, braking=None, off_again=True)  # a rotor that coasts for a minute is no fault
    verb = status.command.verb if status.command and status.command.verb in NAMED_STOPS else Verb.STOP
    return keep_stop(replace(status, braking=None), StopUnconfirmed(event.now_ns, braking.mode, WENT_ON, verb))


def watch_encoder(status: AxisStatus, event: ReadingTaken, faults: tuple[Fault, ...]) -> AxisStatus:
    """Find an encoder that may have ceased to count: in a motion, and while a shaft coasts."""
    enabled = event.reading.enabled
    if status.coast is None and not enabled:
        status = changed(status, coast=let_go(status, event.sent_at_s))
    if status.following:
        status = _watch_following(status, status.following, event, faults)
    return status if enabled and NOT_FOLLOWED in status.own else _watch_coast(status, event, faults)


def _watch_following(
    status: AxisStatus, following: Following, event: ReadingTaken, faults: tuple[Fault, ...]
) -> AxisStatus:
    """Have a motor switched off whose shaft was not seen to go where its motion sent it."""
    # its drive knows more of it, and has switched the motor off
    tripped = any(fault.stops for fault in event.reading.faults)
    at_velocity = _is_at_velocity(status, following, event.sent_at_s)
    target, reading = _reached_target(status, event), event.reading
    error = reading.following_error_counts
    # behind the end of a profile the position tells it, too: what noise has made of the one, the other does not say
    if target is not None and error is not None and abs(target - reading.position_counts) < abs(error):
        reading = replace(reading, following_error_counts=target - reading.position_counts)
    seen = following.observe(reading, event.sent_at_s, event.true_until_s, at_velocity=at_velocity)
    # a jam may be cleared, and an encoder come back: neither tells of the way between
    if status.referenced and _has_gone_unseen(following, seen, replace(event, reading=reading), target):
        if status.command and status.command.state is not AxisState.STOPPING and not tripped:
            return _lose_encoder(status, event, faults)
        status = place_lost(status)
    if tripped:
        seen = Comparison.AS_TOLD
    if isinstance(seen, Following):
        if seen is following:
            return status
        if status.referenced and seen.given_up and not seen.leeway.stalls:
            progress = replace(status.progress, failure=NOT_SEEN) if status.command else status.progress
            status = replace(place_lost(status), progress=progress)
        return replace(status, following=seen)
    if seen is Comparison.AS_TOLD and status.command and not tripped:
        # at a velocity that it has reached its drive says that its profile is done
        if following.settled and not following.is_late:
            return status
        return replace(status, following=replace(following, until_s=math.inf, settled=event.reading.enabled))
    return replace(status, following=None) if seen is Comparison.AS_TOLD else _lose_encoder(status, event, faults)


def _has_gone_unseen(before: Following, seen: Following | Comparison, event: ReadingTaken, target: int | None) -> bool:
    """Tell whether a shaft stood for longer than friction holds one, or makes up for counts that were missed."""
    reading, at_s = event.reading, event.sent_at_s
    if not reading.enabled:
        return False
    if before.outruns(reading) or (target is not None and before.swings_past(reading, at_s, target)):
        return True
    if at_s < before.profile.swings_until_s:
        return False  # one that turns round stands for a moment
    if target is not None:
        stands = seen if isinstance(seen, Following) else before
        short = stands.short_counts(reading, target)
        return short is not None and stands.has_parted(at_s, short)
    return isinstance(seen, Following) and seen is not before and seen.has_parted(at_s)


def _reached_target(status: AxisStatus, event: ReadingTaken) -> int | None:
    """Return where the profile of a command has ended; None of one that runs, was cut short, or may have."""
    command, progress, reading = status.command, status.progress, event.reading
    if command is None or command.settling is None or not reading.profile_done:
        return None
    # a stop that it has not confirmed may have ended it
    elsewhere = progress.unsure or progress.failure or reading.cut_short or status.stop
    is_open = progress.told_anew is not None and progress.told_anew.leaves_end_open
    return None if elsewhere or is_open else command.settling.target_counts


def _lose_encoder(status: AxisStatus, event: ReadingTaken, faults: tuple[Fault, ...]) -> AxisStatus:
    """Have a motor switched off whose shaft does not go, or is not seen to go, where it was sent."""
    if status.energised:  # its loop pushes on, against a jam or unseen, as far as it can
        status = keep_stop(status, StopUnconfirmed(event.now_ns, StopMode.OFF, UNFOLLOWED))
    own = own_and(status, NOT_FOLLOWED)
    status = replace(target_lost(place_lost(status)), own=own, position_lost=True, following=None, coast=None)
    return fail(with_faults(status, (*faults, NOT_FOLLOWED), event.now_ns), NOT_FOLLOWED.text)


def _watch_coast(status: AxisStatus, event: ReadingTaken, faults: tuple[Fault, ...]) -> AxisStatus:
    """Find a shaft that turned and stands so suddenly that it may only seem to."""
    reading, at_s, coast, command = event.reading, event.sent_at_s, status.coast, status.command
    most = status.limits.slowing_counts_per_s2
    if reading.enabled or (command and command.opens_loop):
        most = None if reading.cut_short else _braking_counts_per_s2(status)
        if most is None:
            return status if coast is None else replace(status, coast=None)
    if coast is None:
        found = Coast.of(reading, at_s, event.true_until_s)
        return replace(status, coast=found) if found else status
    seen = coast.observe(reading, at_s, event.true_until_s, most)
    if isinstance(seen, Coast):
        return status if seen is coast else replace(status, coast=seen)
    if seen is Comparison.NOT_AS_TOLD and reading.enabled:
        return _lose_encoder(status, event, faults)
    status = replace(status, coast=None)
    if seen is Comparison.AS_TOLD or STOOD_AT_ONCE in status.own:
        return status
    status = with_faults(replace(status, own=own_and(status, STOOD_AT_ONCE)), (*faults, STOOD_AT_ONCE), event.now_ns)
    # at once, for a reset may come before the next reading
    return replace(target_lost(place_lost(status)), position_lost=True)


def _braking_counts_per_s2(status: AxisStatus) -> float | None:
    """Return how fast a loop slows down its shaft at most, None where that is not known: drives end some motions."""
    command, braking, following = status.command, status.braking, status.following
    most = status.limits.braking_counts_per_s2
    if braking and braking.mode is StopMode.ABRUPT:
        return None
    if command and (command.opens_loop or command.verb is Verb.HOME):
        return None
    return min(most, BRAKES_SHARE * following.profile.braking_counts_per_s2) if most and following else most


def let_go(status: AxisStatus, at_s: float) -> Coast | None:
    """Return how a shaft coasts whose loop opens at an instant, by what was seen of it last; None if it stood."""
    following, coast, most = status.following, status.coast, _braking_counts_per_s2(status)
    coast = replace(coast, braked_counts_per_s2=most) if coast and most else None
    told = following.let_go(at_velocity=_is_at_velocity(status, following, at_s)) if following else None
    return max(coast, told, key=lambda each: each.speed_counts_per_s) if coast and told else coast or told


def _is_at_velocity(status: AxisStatus, following: Following, at_s: float) -> bool:
    """Tell whether the profile of a motion keeps its velocity at an instant, or goes up to it."""
    command, ends_at_s = status.command, status.ends_at_s
    return (
        command is not None
        and command.verb is Verb.MOVE_VELOCITY
        and command.state is AxisState.CONTINUOUS_MOTION
        and at_s >= following.profile.swings_until_s
        # a run with an end is a long move to its drive
        and (ends_at_s is None or at_s < ends_at_s - following.profile.brakes_within_s)
    )


def next_following(status: AxisStatus, event: MotionStarted) -> Following | None:
    """Return by what the encoder is to be seen to count in a motion that has begun, or has gone over into another."""
    if event.following:
        return event.following.after(status.following)
    before, command = status.following, status.command
    if before is None or command is None or command.opens_loop:
        return None
    # what brings a motion to rest goes on with its profile, and so does a shaft that cannot stand at once
    if command.state is not AxisState.STOPPING and command.command_id != before.command_id:
        if not (before.leeway.coasts and event.profile):
            return None
        before = replace(before, command_id=command.command_id)
        return before.going_on(*event.profile, reverses=not event.onwards)
    return before.going_on(*event.profile) if event.profile else before


def watch_course(status: AxisStatus, event: ReadingTaken) -> AxisStatus:
    """Have a shaft stopped that goes elsewhere than it was sent, or faster than it was told."""
    reading, way, pace = event.reading, status.progress.way, status.progress.pace
    on_way = way.observe(reading) if way else Comparison.AS_TOLD
    if on_way is Comparison.NOT_AS_TOLD:
        return _stray(status, event)
    if isinstance(on_way, Way):
        status = replace(status, progress=replace(status.progress, way=on_way))
    if pace is None:
        return status
    seen = pace.observe(reading, event.sent_at_s, event.true_until_s)
    if seen is Comparison.NOT_AS_TOLD:
        return _outrun(status, pace, event)
    if seen is pace:
        return status
    return replace(status, progress=replace(status.progress, pace=seen if isinstance(seen, Pace) else None))


def _stray(status: AxisStatus, event: ReadingTaken) -> AxisStatus:
    """Have a shaft stopped that is not on the way to its target."""
    here = status.scale.shown_at(event.reading.position_counts)
    return fail(
        keep_stop(status, StopUnconfirmed(event.now_ns, how=STRAYED)),
        f"it is at {here:.12g} {status.scale.unit}, where no way to its target leads, and was stopped: look at the"
        " machine before you send it again",
    )


def _outrun(status: AxisStatus, pace: Pace, event: ReadingTaken) -> AxisStatus:
    """Have a shaft stopped that is faster than it was told in mid-motion."""
    most, told_anew = pace.most_counts_per_s / abs(status.scale.counts_per_unit), status.progress.told_anew
    why = f"; its drive has not confirmed the change: {told_anew.doubt}" if told_anew and told_anew.doubt else ""
    return fail(
        keep_stop(status, StopUnconfirmed(event.now_ns, how=OUTRUN)),
        f"it is faster than {most:.4g} {status.scale.unit}/s, to which its speed was changed, and was stopped{why}",
    )
