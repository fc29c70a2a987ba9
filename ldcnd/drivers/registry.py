"""Which family speaks for which line: a dict, because there are two of them."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from ldcnd.bus.bus import Bus
from ldcnd.drivers.driver import AxisSpec
from ldcnd.drivers.ldcn.network import LdcnNetwork
from ldcnd.drivers.line import LineSpec
from ldcnd.drivers.network import Network

NetworkFactory = Callable[[Bus, tuple[AxisSpec, ...], int, LineSpec], Network]

FAMILIES: Mapping[str, NetworkFactory] = MappingProxyType({"ldcn": LdcnNetwork})
