"""Fixes of what moved unwatched: lost control, pending stops, at most once, permission, adoption."""

from tests.reverts.revert import revert

LOSS = "tests/integration/test_loss_of_control.py::"
PENDING = "tests/integration/test_pending_stops.py::"
LEDGER = "tests/unit/test_ledger.py::"
AXIS = "tests/unit/test_axis_service.py::"
PERMISSION = "tests/integration/test_permission.py::"
START = "tests/integration/test_start_policies.py::"
PLAUSIBILITY = "tests/unit/test_plausibility.py::"
MOTION = "tests/integration/test_motion.py::"
ROUGH = "tests/integration/test_rough_lines.py::test_a_rough_line_shows_no_false_position_and_lets_stops_through"

REVERTS = (
    # -- lost control
    revert(
        "ldcnd/daemon/command/leases.py",
        """            self._lost(other, other.axes, f"taken by force by {lease.client}", ErrorCode.LEASE_EXPIRED)
""",
        "",
        (
            LOSS + "test_who_takes_one_axis_by_force_stops_all_that_its_holder_moved",
            LOSS + "test_an_axis_taken_by_force_in_mid_motion_comes_to_rest",
        ),
    ),
    revert(
        "ldcnd/daemon/command/leases.py",
        """self._lost(other, other.axes - lease.axes, "its client took a lease that covers less", None)""",
        "pass",
        (LOSS + "test_who_exchanges_a_lease_for_one_that_covers_less_stops_the_rest",),
    ),
    revert(
        "ldcnd/daemon/command/leases.py",
        """self._lost(lease, moving, "released while it moved", None)""",
        "pass",
        (
            LOSS + "test_a_release_in_mid_motion_stops_unless_it_is_to_leave_it_running[False]",
            LOSS + "test_the_policy_of_the_axis_decides_what_a_release_does",
        ),
    ),
    revert(
        "ldcnd/daemon/command/leases.py",
        "        if not leave_running:\n",
        "        if True:\n",
        (LOSS + "test_a_release_in_mid_motion_stops_unless_it_is_to_leave_it_running[True]",),
    ),
    revert(
        "ldcnd/daemon/command/leases.py",
        """self._lost(lease, lease.axes, "its lease was not renewed", ErrorCode.LEASE_EXPIRED)""",
        "pass",
        (
            LOSS + "test_a_client_that_freezes_in_mid_motion_has_its_axis_do_what_the_policy_says[halt]",
            LOSS + "test_a_client_that_freezes_in_mid_motion_has_its_axis_do_what_the_policy_says[power_off]",
            "tests/integration/test_authority.py::test_an_axis_halts_when_its_client_disappears",
        ),
    ),
    revert(
        "ldcnd/daemon/command/leases.py",
        "if error.axis is not None and self._refusals.admit() is not None:",
        "if error.axis is not None:",
        (LOSS + "test_refused_acquires_do_not_flood_the_events",),
    ),
    revert(
        "ldcnd/daemon/command/rig_commands.py",
        "                for name in concerned(self._rig, command):\n"
        "                    self._admit(name, command.lease)\n",
        "",
        (LOSS + "test_a_loss_is_rehearsed_under_a_lease_that_covers_what_it_concerns",),
    ),
    # -- pending stops
    revert(
        "ldcnd/daemon/axis/axis.py",
        """            if self._pending is not None:
                self._not_confirmed()
            self.telemetry.state""",
        """            self._pending = None
            self.telemetry.state""",
        (
            PENDING + "test_a_stop_sent_while_the_line_is_down_reaches_the_drive_when_it_is_back",
            PENDING + "test_a_drive_that_was_mute_is_stopped_as_soon_as_it_answers",
            PENDING + "test_nothing_moves_and_nothing_is_reset_while_a_stop_is_not_confirmed",
            PENDING + "test_a_stop_before_a_line_is_taken_over_stops_what_still_moves_there",
        ),
    ),
    revert(
        "ldcnd/daemon/line/line.py",
        "await self._send_pending_stops()  # first",
        "pass  #",
        (PENDING + "test_a_stop_is_the_first_packet_to_a_drive_whose_line_is_back_at_its_rate",),
    ),
    revert(
        "ldcnd/daemon/axis/axis.py",
        """            if not self.line_up:
                return False  # its line is being brought up, or is down: it is the first thing that is sent then
""",
        "",
        (PENDING + "test_stops_during_bring_up_are_answered_at_once_and_do_not_restart_it",),
    ),
    revert(
        "ldcnd/daemon/command/leases.py",
        """    if tracker.stop_latched and policy is LossPolicy.RUN_TO_TARGET:
        policy = LossPolicy.HALT
""",
        "",
        (PENDING + "test_a_latched_axis_that_moves_when_its_line_is_back_comes_to_rest_whatever_the_policy_says",),
    ),
    revert(
        "ldcnd/daemon/axis/commands.py",
        "if tracker.state is AxisState.ERROR_STOP and self._moves_by_force():",
        "if False:",
        (PENDING + "test_a_moving_axis_in_error_stop_is_not_switched_off_by_a_reset",),
    ),
    revert(
        "ldcnd/daemon/axis/axis.py",
        """        self._inherited = False
        self._pending = None
        self.tracker.stop_confirmed()
""",
        "",
        (PENDING + "test_a_drive_that_had_no_power_meanwhile_has_nothing_to_confirm",),
    ),
    # -- the ledger
    revert(
        "ldcnd/daemon/command/ledger.py",
        "if entry is None and self._until_s.get(_fingerprint(command_id), -math.inf) > self._now_s():",
        "if False:",
        (
            LEDGER + "test_a_replay_whose_answer_is_forgotten_is_refused",
            LEDGER + "test_senders_without_number_take_bounded_memory_and_their_replays_stay_refused",
            LEDGER + "test_an_id_is_remembered_for_the_time_that_the_contract_names",
        ),
    ),
    revert(
        "ldcnd/daemon/command/ledger.py",
        """sender = RESTING if entry.command.effect is Effect.REST else entry.login or entry.client or \"\"""",
        """sender = \"\"""",
        (
            LEDGER + "test_nobody_elses_commands_push_an_answer_out",
            PERMISSION + "test_a_replay_after_thousands_of_halts_is_answered_and_moves_nothing",
        ),
    ),
    revert(
        "ldcnd/daemon/command/ledger.py",
        "        if len(self._until_s) >= LARGEST_MEMORY:\n",
        "        if False:\n",
        (LEDGER + "test_ids_that_could_not_be_remembered_are_refused_before_anything_is_done",),
    ),
    revert(
        "ldcnd/daemon/command/ledger.py",
        """        if command.lease is not None and command.sequence is not None:
            return
""",
        "",
        (LEDGER + "test_an_id_under_a_lease_with_a_sequence_takes_no_memory",),
    ),
    revert(
        "ldcnd/daemon/command/ledger.py",
        "            if self._entries[command_id].status in FINAL:\n",
        "            if True:\n",
        (LEDGER + "test_what_is_not_over_is_never_forgotten",),
    ),
    # -- permission, take-over, reference, swapped replies
    revert(
        "ldcnd/bus/bus.py",
        "                self._line.deliver()  # permission is asked of all that the drives have said by now\n",
        "                pass\n",
        ("tests/unit/test_coalescing.py::test_permission_to_move_is_asked_of_all_that_the_drives_have_said",),
    ),
    revert(
        "ldcnd/bus/bus.py",
        "            if job.may_go():\n",
        "            if True:\n",
        (
            PERMISSION + "test_a_packet_that_waits_for_the_line_is_not_sent_once_its_lease_has_ended[start]",
            PERMISSION + "test_a_loop_that_waits_for_the_line_is_not_closed_once_its_lease_has_ended",
        ),
    ),
    revert(
        "ldcnd/daemon/axis/guards.py",
        "        self._right.holds()\n",
        "",
        (
            PERMISSION + "test_a_buffered_move_of_a_lease_that_was_released_is_refused",
            PERMISSION + "test_a_buffered_move_of_a_lease_that_was_taken_by_force_is_refused",
            PERMISSION + "test_a_homing_whose_lease_was_lost_begins_no_further_leg",
        ),
    ),
    revert(
        "ldcnd/daemon/line/line.py",
        "                    axis.taken_over()\n",
        "                    pass\n",
        (
            START + "test_a_motion_without_an_end_that_a_host_has_left_moves_until_it_was_ended",
            "tests/integration/test_motion_without_end.py::test_a_path_that_a_host_has_left_is_stopped",
        ),
    ),
    revert(
        "ldcnd/daemon/line/line.py",
        "axis.config.name in report.placed and not",
        "report.reset and not",
        (
            START + "test_a_reset_of_drives_that_an_earlier_host_has_used_gives_no_reference",
            START + "test_one_drive_that_was_powered_on_does_not_stand_for_those_that_kept_their_power",
            START + "test_a_drive_whose_shaft_turns_while_it_is_reset_is_not_referenced",
        ),
    ),
    revert(
        "ldcnd/daemon/axis/axis.py",
        "            self._bus.distrust()  # another drive's reply that came late would be followed by others\n",
        "            pass\n",
        (AXIS + "test_a_reading_that_contradicts_the_one_before_is_asked_again_and_in_the_end_counts_as_lost",),
    ),
    revert(
        "ldcnd/daemon/axis/polling.py",
        "            if self._agreeing >= ROUNDS or not jumped:\n",
        "            if True:\n",
        (
            PLAUSIBILITY + "test_late_replies_of_another_drive_are_not_believed_though_they_agree",
            ROUGH + "[agreeing]",
        ),
    ),
    revert(
        "ldcnd/daemon/axis/polling.py",
        "        return not self._is_jump(seen, reading, timing.true_until_s)",
        "        return True",
        (
            PLAUSIBILITY
            + "test_a_place_too_far_for_its_speed_is_asked_again_also_of_an_axis_that_was_not_read_for_a_while",
        ),
    ),
    revert(
        "ldcnd/daemon/axis/polling.py",
        ", JUMP_SPEEDS * shown)\n",
        ", 0.0)\n",
        (
            PLAUSIBILITY + "test_a_motion_that_is_faster_than_the_velocity_of_an_axis_without_limits_is_believed[0.2]",
            MOTION + "test_an_axis_without_limits_may_be_moved_faster_than_its_own_velocity[1.0]",
        ),
    ),
    revert(
        "ldcnd/daemon/axis/polling.py",
        "NOISE_COUNTS if standing or self._was_away else None",
        "NOISE_COUNTS if standing else None",
        (PLAUSIBILITY + "test_a_drive_that_is_back_is_believed_at_once_only_where_it_was",),
    ),
    revert(
        "ldcnd/daemon/axis/axis.py",
        "            self.stop_wanted.set()  # it replies again, whatever it says\n",
        "            pass\n",
        (AXIS + "test_a_reading_from_a_drive_that_owes_a_confirmation_calls_for_the_stop",),
    ),
    revert(
        "ldcnd/daemon/axis/axis.py",
        "                if not self._plausibility.is_out_of_reach(reading, self._clock.now_s()):\n",
        "                if True:\n",
        tuple(
            AXIS + "test_nothing_is_planned_from_two_readings_that_agree_where_no_motion_can_have_led" + case
            for case in ("[command0]", "[command1]")
        ),
    ),
)
