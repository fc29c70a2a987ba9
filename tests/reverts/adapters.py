"""Faults that a trial on the kernel's drivers once found; tests on terminals notice them, and tests in the guest."""

from dataclasses import dataclass

from tests.reverts.revert import Edit, Revert

TERMINALS = "tests/drivers/test_terminals.py::"
CAUSES = "tests/integration/test_fault_causes.py::"
SETTINGS = "tests/drivers/test_port_settings.py::"


@dataclass(frozen=True, slots=True)
class GuestRevert(Revert):
    """A fault that is noticed in the guest as well.

    Attributes:
        what: it did.
        guest: a part of the names of the tests in the guest.
    """

    what: str = ""
    guest: str = ""


REVERTS = (
    GuestRevert(
        (
            Edit(
                "ldcnd/daemon/axis/axis.py",
                "        if self._unconfirmed() is None:\n",
                "        if self._unconfirmed() is None or self.config.loss.bus == 'run_to_target':\n",
            ),
        ),
        (TERMINALS + "test_a_stop_while_the_adapter_is_unplugged_is_carried_out_under_its_new_name",),
        "F1",
        'a stop while the line is down is not sent again under loss.bus = "run_to_target"',
        "stop_while_the_adapter_is_away",
    ),
    GuestRevert(
        (
            Edit("ldcnd/daemon/axis/state.py", "runs = reading.enabled and not reading.profile_done", "runs = False"),
            Edit(
                "ldcnd/daemon/axis/state.py",
                "        if self.commanded and reading.enabled:\n",
                "        if self._quiet_s:\n",
            ),
        ),
        (TERMINALS + "test_slow_motion_is_halted_when_the_adapter_is_back",),
        "F2",
        "slow motion counts as rest, and is not halted after an outage",
        "halted_when_its_adapter_is_back",
    ),
    GuestRevert(
        (
            Edit(
                "ldcnd/drivers/ldcn/faults.py",
                "        faults = _power_driver_not_known(status, known)\n",
                "        faults = _power_driver_off(status, replace(known, latched=None))\n",
            ),
        ),
        (CAUSES + "test_a_tripped_drive_that_is_taken_over_has_a_fault_without_a_cause[stalled]",),
        "F3",
        "the cause of a fault is guessed while it is not known whether the power driver is on",
        "killed_daemon",
    ),
    GuestRevert(
        (
            Edit(
                "ldcnd/transport/serial_port.py",
                "        if baud and not makes(baud, made := port.tune(baud)):",
                "        if baud and not (made := port.tune(baud)):",
            ),
            Edit("ldcnd/transport/serial_port.py", "        if not makes(baud, made):", "        if not made:"),
        ),
        (
            SETTINGS + "test_rate_that_a_uart_does_not_make_is_refused_with_its_neighbours",
            SETTINGS + "test_change_to_a_rate_that_is_not_made_ends_the_port_and_names_the_one_that_is",
        ),
        "F4",
        "a rate that the UART does not make is accepted",
        "rates_are_those",
    ),
)
