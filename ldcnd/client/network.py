"""The network as wings see it: sessions of their own, and what comes in on them undecoded.

A recorder, a page or a bridge passes on samples that it does not read, and what it publishes for other systems is no
command to a rig, so it needs more than `rig_client`. This is all of the session that it may use.
"""

from ldcnd.net.session import Declaration, Publication, Qos, SampleKind, Session
from ldcnd.net.zenoh_config import zenoh_config as check_settings
from ldcnd.net.zenoh_session import open_zenoh_session as open_session
from ldcnd.net.zenoh_settings import DEFAULT_ENDPOINT, LEASE_MS, RETRY_MS, ZenohSettings, endpoint_of

__all__ = [
    "DEFAULT_ENDPOINT",
    "LEASE_MS",
    "RETRY_MS",
    "Declaration",
    "Publication",
    "Qos",
    "SampleKind",
    "Session",
    "ZenohSettings",
    "check_settings",
    "endpoint_of",
    "open_session",
]
