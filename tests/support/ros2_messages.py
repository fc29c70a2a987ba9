"""Messages of ROS 2 whose bytes are compared with those of other libraries."""

from ldcnd.lab.ros2.cdr import DiagnosticArray, DiagnosticStatus, JointState

JOINTS = (
    JointState(1_700_000_000_123_456_789, ("x",), (0.0125,), (-0.5,)),
    JointState(0, (), ()),
    JointState(5_000_000_001, ("a", "bc", "def", "ghij"), (1.0, 2.0, 3.0, 4.0)),
    JointState(1_700_000_000_000_000_000, ("Ωmega",), (-1e-9,), (1e9,)),
)
DIAGNOSTICS = (
    DiagnosticArray(1_700_000_000_123_456_789, (DiagnosticStatus(0, "sim: x", "standstill", "line0/1"),)),
    DiagnosticArray(7, ()),
    DiagnosticArray(
        1_700_000_000_000_000_000,
        (
            DiagnosticStatus(2, "sim: y", "error_stop", "line0/2", (("position_error", "left the limit"), ("k", ""))),
            DiagnosticStatus(3, "", "", "", ()),
        ),
    ),
)
