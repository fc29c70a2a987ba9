"""Which home captures an LDCN/NMC drive has, and the control byte that arms one.

Sources: LS-182AP manual and PIC-SERVO manual, "Set Homing Mode". Versions 1 and 2 of PIC-SERVO do not stop by
themselves: the host stops them.
"""

from types import MappingProxyType

from ldcnd.drivers.driver import HomeCapture, StopMode
from ldcnd.drivers.ldcn.controls import HomingControl
from ldcnd.drivers.ldcn.profiles import HomingSource, Profile
from ldcnd.model.requests import HomeMethod

SOURCES = MappingProxyType(
    {
        HomeMethod.REVERSE_LIMIT: HomingSource.LIMIT1,
        HomeMethod.FORWARD_LIMIT: HomingSource.LIMIT2,
        HomeMethod.INDEX: HomingSource.INDEX,
        HomeMethod.POSITION_ERROR: HomingSource.POSITION_ERROR,
        HomeMethod.CURRENT: HomingSource.CURRENT,
    }
)
STOPS = MappingProxyType(
    {
        StopMode.SMOOTH: HomingControl.STOP_SMOOTH,
        StopMode.ABRUPT: HomingControl.STOP_ABRUPT,
        StopMode.OFF: HomingControl.MOTOR_OFF,
    }
)


def home_methods(profile: Profile) -> frozenset[HomeMethod]:
    """Return what can capture the home position of this device."""
    return frozenset(method for method, source in SOURCES.items() if source & profile.homing_sources)


def homing_control(profile: Profile, capture: HomeCapture) -> HomingControl:
    """Return the control byte that arms a capture.

    An excess position error opens the loop by itself, so no way to stop goes with it.
    """
    control = HomingControl(SOURCES[capture.method])
    if profile.stops_on_home and capture.method is not HomeMethod.POSITION_ERROR:
        control |= STOPS[capture.stop]
    return control


def opens_loop(profile: Profile, capture: HomeCapture) -> bool:
    """Tell whether the drive opens its loop by itself when it has captured."""
    if capture.method is HomeMethod.POSITION_ERROR:
        return True
    return profile.stops_on_home and capture.stop is StopMode.OFF
