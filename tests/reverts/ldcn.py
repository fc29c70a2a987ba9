"""Reverts of what was found against the manuals of LDCN and NMC drives, in the order of the table in the reference."""

from tests.reverts.revert import revert

CAUSES = "tests/integration/test_fault_causes.py::"
START = "tests/integration/test_start_policies.py::"
GROUPS = "tests/integration/test_groups.py::"
HOMING = "tests/integration/test_homing.py::"
IO = "tests/integration/test_io_modules.py::"
NEWCOMER = "tests/integration/test_sc_newcomer.py::"
ROTARY = "tests/integration/test_rotary_axes.py::"
CLOCKS = "tests/integration/test_clocks.py::"
PROBE = "tests/integration/test_probe.py::"
SNAPSHOT = "tests/integration/test_snapshot.py::"
TRACKER = "tests/unit/test_axis_tracker.py::"
LDCN = "ldcnd/drivers/ldcn/"

REVERTS = (
    # -- what a status byte means
    revert(
        LDCN + "record.py",
        "            self.known = replace(self.known, latched=cause, seen=True)\n",
        "            self.known = replace(self.known, seen=True)\n",
        (
            CAUSES + "test_a_stop_of_a_tripped_drive_leaves_the_fault_its_name",
            CAUSES + "test_power_off_of_a_tripped_drive_leaves_the_fault_its_name",
            CAUSES + "test_a_second_without_the_cable_leaves_the_fault_its_name",
        ),
    ),
    revert(
        LDCN + "faults.py",
        "    if known.nothing_latched:\n",
        "    if True:\n",
        (
            "tests/unit/test_ldcn_faults.py::test_what_bit_3_stands_for_is_not_readable_while_a_cause_may_be_latched",
            "tests/property/test_fault_truth.py::test_no_cause_is_named_that_the_drive_does_not_have",
        ),
    ),
    revert(
        LDCN + "faults.py",
        "        return Fault(FaultCode.STOP_INPUT, latched=True)\n    return Fault("
        "FaultCode.ENCODER_OR_HALL, latched=True, loses_position=True)\n",
        "        return Fault(FaultCode.STOP_INPUT, latched=True)\n    return Fault("
        "FaultCode.ENCODER_OR_HALL, latched=True)\n",
        (CAUSES + "test_a_position_that_was_lost_stays_lost_after_a_stop",),
    ),
    revert(
        LDCN + "faults.py",
        "self.code not in WARNINGS and (self.latched or self.code is not FaultCode.POWER_LOST)",
        "self.code not in WARNINGS",
        (CAUSES + "test_motor_power_that_is_off_while_the_axis_is_disabled_stops_nothing",),
    ),
    revert(
        "ldcnd/daemon/axis/commands.py",
        "        if stopped or not tracker.energised:\n",
        "        if stopped:\n",
        (CAUSES + "test_one_reset_is_enough_for_a_tripped_drive_that_was_stopped_and_taken_over",),
    ),
    # -- bounds, rest and resets
    revert(
        "ldcnd/daemon/axis/procedures/analog.py",
        "        self.deadline_s = motion.clock.now_s() + self._timeout_s\n",
        "        self.deadline_s = motion.clock.now_s() + 10 * self._timeout_s\n",
        ("tests/integration/test_modes.py::test_an_analog_move_whose_sensor_does_not_follow_ends_at_its_bounds",),
    ),
    revert(
        "ldcnd/daemon/axis/state.py",
        "        if self.commanded and reading.enabled:\n",
        "        if reading.enabled:\n",
        (TRACKER + "test_a_shaft_that_creeps_below_a_count_per_tick_never_stands",),
    ),
    revert(
        "ldcnd/daemon/axis/state.py",
        "min(max(2 * held_s, REST_S), MOST_REST_S)",
        "REST_S",
        (TRACKER + "test_a_shaft_that_creeps_out_of_the_band_is_believed_to_stand_only_after_it_stayed_longer",),
    ),
    revert(
        LDCN + "adoption.py",
        "            if _moves(before[address], after[address]):\n",
        "            if False:\n",
        (START + "test_a_drive_that_creeps_is_not_reset_by_the_fallback",),
    ),
    revert(
        LDCN + "adoption.py",
        "        if silent and (self.found or not await self._newcomer()):\n",
        "        if False:\n",
        (START + "test_a_drive_that_is_silent_is_not_known_to_stand_and_not_reset",),
    ),
    revert(
        LDCN + "network.py",
        "            if reads_only or not found or not await self._rejoin.gather(found, addressing):\n",
        "            if True:\n",
        (START + "test_a_drive_that_a_restarted_one_keeps_from_hearing_is_not_reset",),
    ),
    revert(
        "ldcnd/daemon/axis/procedures/probe.py",
        "    if abs(plan.velocity) > limit:\n",
        "    if False:\n",
        (
            HOMING + "test_a_search_that_the_index_pulse_can_slip_through_is_refused_with_the_nearest_velocity",
            PROBE + "test_what_cannot_be_latched_is_refused",
        ),
    ),
    # -- groups and rates
    revert(
        LDCN + "addressing.py",
        "        packet = commands.set_address(node, address, self._plan.place(address).address, leader=leader)\n",
        "        leads = self._plan.leads(address)\n"
        "        packet = commands.set_address(node, address, self._plan.place(address).address, leader=leads)\n",
        (
            GROUPS + "test_set_baud_goes_to_groups_while_they_have_no_leader",
            GROUPS + "test_a_leader_is_none_while_a_line_changes_its_rate_to_bring_a_drive_back",
        ),
    ),
    revert(
        LDCN + "commands.py",
        "    return gap.join(packets)\n",
        '    return b"".join(packets)\n',
        (GROUPS + "test_group_packets_are_a_servo_cycle_apart_on_the_wire",),
    ),
    revert(
        LDCN + "profiles.py",
        "        return CYCLE_CLOCKS / self.clock_hz\n",
        "        return CYCLE_CLOCKS / CLOCK_HZ\n",
        (CLOCKS + "test_a_drive_with_another_clock_moves_at_the_speed_that_was_asked_for",),
    ),
    revert(
        LDCN + "registers.py",
        "    if abs(made - baud) > BAUD_TOLERANCE * made:\n",
        "    if True:\n",
        (CLOCKS + "test_125000_baud_works",),
    ),
    # -- what protects a motion
    revert(
        LDCN + "servo.py",
        "        elif self.spec.limit_stop is not None:\n",
        "        elif False:\n",
        ("tests/integration/test_limit_switches.py::test_a_move_past_the_switch_stops_there_and_says_so",),
    ),
    revert(
        LDCN + "trajectory.py",
        "    if abs(counts_per_s) > most:\n",
        "    if False:\n",
        ("tests/unit/test_ldcn_servo_parts.py::test_a_speed_at_which_the_encoder_would_lose_counts_is_refused",),
    ),
    revert(
        "ldcnd/daemon/axis/commands.py",
        "        if gains.el <= step_counts:\n",
        "        if False:\n",
        ("tests/integration/test_tracking.py::test_a_position_error_limit_below_the_step_is_refused",),
    ),
    # -- the counter
    revert(
        LDCN + "servo.py",
        "                await self._set_counter_back(target)\n",
        "                pass\n",
        (ROTARY + "test_at_the_end_of_its_counter_an_axis_goes_on",),
    ),
    revert(
        LDCN + "servo.py",
        "        with contextlib.suppress(OutcomeUnknown):\n",
        "        with contextlib.suppress():\n",
        (ROTARY + "test_a_lost_acknowledgement_of_the_counter_leaves_no_wrong_position",),
    ),
    # -- the instant of a snapshot
    revert(
        LDCN + "groups.py",
        " if drive.state.homing_armed and not drive.state.guard]\n",
        " if drive.state.homing_armed]\n",
        (SNAPSHOT + "test_a_snapshot_is_taken_while_a_limit_switch_guards_the_motion",),
    ),
    revert(
        LDCN + "groups.py",
        "        groups = [group for group in self._plan.groups if group.address != EVERYBODY or self.all_capture]\n",
        "        groups = [group for group in self._plan.groups if self._usable(group)]\n",
        (IO + "test_a_snapshot_captures_inputs_and_count_with_the_positions",),
    ),
    revert(
        LDCN + "io_module.py",
        "                await self._switch_together(latch, *pwm_after)\n",
        "                await self._bus.execute(send_io_command(self._node, SetOutput(latch)))\n"
        "                await self._bus.execute(send_io_command(self._node, SetPwm(*pwm_after)))\n",
        (IO + "test_lines_and_pwm_that_are_asked_for_at_once_change_in_the_same_cycle",),
    ),
    # -- PIC-SERVO SC
    revert(
        LDCN + "adoption.py",
        "            if each.profile.sc_extensions:\n",
        "            if False:\n",
        (NEWCOMER + "test_an_sc_that_restarts_is_reset_before_it_is_addressed_and_the_others_go_on[servo on-115200]",),
    ),
    revert(
        LDCN + "adoption.py",
        "        return bool(self._kept_addresses)\n",
        "        return False\n",
        (
            NEWCOMER
            + "test_an_sc_that_restarts_is_reset_before_it_is_addressed_and_the_others_go_on[address kept-115200]",
        ),
    ),
    revert(
        LDCN + "packet.py",
        "            None if velocity is None else sign * velocity,\n",
        "            None if velocity is None else -velocity,\n",
        ("tests/integration/test_dialects.py::test_pic_servo_sc",),
    ),
    revert(
        LDCN + "registers.py",
        "        present = field is not _STEP_MULTIPLIER or at < len(data)\n",
        "        present = True\n",
        ("tests/unit/test_ldcn_received.py::test_a_missing_step_multiplier_is_one",),
    ),
    revert(
        LDCN + "trajectory.py",
        "(servo_divisor if profile.divisor_slows_profile else 1)",
        "servo_divisor",
        ("tests/unit/test_ldcn_registers.py::test_the_servo_divisor_slows_the_profile_on_version_4_but_not_on_sc",),
    ),
    # -- a latched position
    revert(
        "ldcnd/daemon/axis/procedures/probe.py",
        "        self._error_counts = speed * homing(motion.driver).capture_s + 1\n",
        "        self._error_counts = 0\n",
        (PROBE + "test_a_switch_is_latched_within_its_bound_and_the_reference_stays",),
    ),
    revert(
        "ldcnd/daemon/axis/procedures/probe.py",
        "also=frozenset(others)",
        "also=frozenset()",
        (PROBE + "test_of_several_sources_the_first_that_comes_counts",),
    ),
    revert(
        "ldcnd/daemon/axis/procedures/probe.py",
        "        if self._ahead not in self._methods and homing(",
        "        if not self._methods and homing(",
        (PROBE + "test_the_limit_switch_ahead_ends_a_probe_for_something_else",),
    ),
    revert(
        "ldcnd/daemon/axis/axis.py",
        "            if self._commands.retargets(move):\n",
        "            if False:\n",
        ("tests/integration/test_new_goals.py::test_an_sc_goes_on_to_the_new_goal_without_a_halt",),
    ),
)
"""In the order of the table."""
