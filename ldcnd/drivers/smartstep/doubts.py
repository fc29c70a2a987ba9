"""Doubts about a drive, as clients see them."""

from enum import Enum

from ldcnd.drivers.smartstep.profiles import Doubt, SmartStepProfile
from ldcnd.model.parameters import DoubtInfo


def doubt_info(profile: SmartStepProfile, doubt: Doubt) -> DoubtInfo:
    """Describe one doubt and what the profile assumes."""
    return DoubtInfo(
        key=doubt.key,
        question=doubt.question,
        confidence=doubt.confidence.value,
        standing=doubt.standing.value,
        setting=_setting(profile, doubt.key),
    )


def _setting(profile: SmartStepProfile, key: str) -> str | None:
    if key not in SmartStepProfile.__slots__:
        return None
    value = getattr(profile, key)
    return str(value.value if isinstance(value, Enum) else value)
