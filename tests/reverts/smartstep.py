"""Fixes of departures from the manual of SmartStep drives, by their numbers on the reference page."""

from tests.reverts.revert import Edit, Revert

DRIVER = "ldcnd/drivers/smartstep/"
PAGES = "ldcnd/console/static/pages/"


def revert(finding: int, test: str, path: str, fixed: str, broken: str, *more: Edit) -> Revert:
    """Return the departure with this number, put back; the test that the page names notices it."""
    return Revert((Edit(path, fixed, broken), *more), (f"tests/{test}",), str(finding))


REVERTS = (
    revert(
        1,
        "unit/test_smartstep_drive.py::test_any_monitor_is_read_once_the_auto_tuning_result_too",
        DRIVER + "monitors.py",
        "        MonitorName.AUTO_TUNING_RESULT: AUTO_TUNING_RESULT,\n",
        "",
    ),
    revert(
        2,
        "unit/test_smartstep_transfer.py::test_a_replaced_drive_differs_in_its_unit_number_only_after_a_clone_and_a_power_cycle",
        DRIVER + "transfer.py",
        "with_digit(word, UNIT_DIGIT, unit_number(held)) if parameter.number == PN000.number else word",
        "held if parameter.number == PN000.number else word",
    ),
    revert(
        2,
        "unit/test_smartstep_transfer.py::test_a_replaced_drive_differs_in_its_unit_number_only_after_a_clone_and_a_power_cycle",
        DRIVER + "transfer.py",
        "    if memory is not Memory.RAM:\n        stored",
        "    if memory is Memory.EEPROM:\n        stored",
    ),
    revert(
        3,
        "unit/test_smartstep_parameter_store.py::test_no_spelling_of_pn000_goes_round_the_confirmation_of_a_new_unit_number",
        DRIVER + "parameters.py",
        'return _BY_NUMBER.get(number) or Parameter(number, "")',
        'return Parameter(number, "")',
        Edit(DRIVER + "parameter_store.py", "if parameter.number != PN000.number:", "if parameter != PN000:"),
    ),
    revert(
        4,
        "unit/test_smartstep_trace.py::test_either_edge_of_a_value_is_refused_because_the_drive_would_take_any_change",
        DRIVER + "trace_result.py",
        "    if kind is TriggerKind.EITHER and trigger.channel not in SIGNALS:\n",
        "    if kind is None:\n",
    ),
    revert(
        5,
        "unit/test_smartstep_trace.py::test_a_lost_execute_starts_the_trace_within_seconds",
        DRIVER + "modes.py",
        "            await enter(words, OperatingMode.NORMAL)\n            await enter(words, mode)\n        else:",
        "            return Execution(sent_s, loop.time())\n        else:",
    ),
    revert(
        6,
        "unit/test_smartstep_modes.py::test_a_mode_that_was_left_behind_ends_at_bring_up",
        DRIVER + "network.py",
        "ended = await end_mode(words)",
        "ended = None",
    ),
    revert(
        7,
        "unit/test_smartstep_trace.py::test_words_that_contradict_the_monitors_make_a_trace_uncertain",
        DRIVER + "trace_check.py",
        "    windows = [(each, window) for each in shown if",
        "    return Judgement()\n    windows = [(each, window) for each in shown if",
    ),
    revert(
        7,
        "unit/test_smartstep_trace.py::test_a_trace_that_was_ended_from_elsewhere_is_no_trace",
        DRIVER + "trace.py",
        "if ended_at_s - self._execution.sent_s < needed_s:",
        "if ended_at_s < 0:",
    ),
    revert(
        8,
        "unit/test_smartstep_trace.py::test_a_smaller_full_scale_resolves_finer_and_is_put_back",
        DRIVER + "trace.py",
        "for name, largest in request.full_scale.items():",
        "for name, largest in {}.items():",
    ),
    revert(
        9,
        "unit/test_smartstep_parameter_store.py::test_a_unit_number_that_collides_is_refused_although_confirmed",
        DRIVER + "parameter_store.py",
        "        await self._require_free(unit)\n",
        "",
    ),
    revert(
        10,
        "unit/test_smartstep_modes.py::test_no_counter_is_cleared_while_command_pulses_come_in_although_run_is_off",
        DRIVER + "modes.py",
        "if pulses_rpm or await words.read(low) != before:",
        "if before is None:",
    ),
    revert(
        11,
        "unit/test_smartstep_trace.py::test_the_gear_of_a_pulse_trace_is_that_of_the_eeprom",
        DRIVER + "trace.py",
        "gear = [await words.read(each.eeprom_address)",
        "gear = [await words.read(each.ram_address)",
    ),
    revert(
        12,
        "unit/test_smartstep_trace.py::test_the_trigger_may_have_come_two_milliseconds_before_it_was_seen",
        DRIVER + "trace_check.py",
        "TRIGGER_LATE_S = 0.002",
        "TRIGGER_LATE_S = 0.0",
    ),
    revert(
        13,
        "unit/test_smartstep_drive.py::test_a_signal_is_active_by_the_level_of_the_profile_and_not_by_being_high",
        DRIVER + "monitors.py",
        'active = tuple(signal.name or "" for signal in on if on[signal])',
        'active = tuple(signal.name or "" for signal in bits)',
    ),
    revert(
        13,
        "browser/test_smartstep_pages.py::test_a_signal_is_shown_by_its_active_level",
        PAGES + "axis_now.js",
        "          ? `${sample.active.join(",
        "          ? `${sample.high.join(",
    ),
    revert(
        14,
        "browser/test_smartstep_pages.py::test_a_reset_is_offered_only_where_the_drive_has_one",
        PAGES + "axis_faults.js",
        'axis.can("reset")\n',
        "true\n",
    ),
    revert(
        15,
        "unit/test_smartstep_parameter_store.py::test_the_budget_is_that_of_the_eeprom_as_a_whole",
        DRIVER + "ledger.py",
        "        total = self.total(axis)\n        if total >= budget",
        "        total = self.writes(axis, parameter)\n        if total >= budget",
    ),
    revert(
        16,
        "unit/test_smartstep_drive.py::test_a_warning_with_an_active_alarm_output_stops",
        DRIVER + "drive.py",
        "stops = present.kind is AlarmKind.ALARM or (present.kind is not AlarmKind.NONE and out)",
        "stops = present.kind is AlarmKind.ALARM",
    ),
    revert(
        17,
        "unit/test_smartstep_reference.py::test_every_field_of_the_profile_is_used",
        DRIVER + "profiles.py",
        "    trace_verify: bool = True\n",
        "    trace_verify: bool = True\n    atomic_counter: bool = False\n",
    ),
    revert(
        18,
        "unit/test_smartstep_trace.py::test_the_fastest_interval_is_two_time_units_of_the_drive",
        DRIVER + "trace.py",
        "            smptms = SHORTEST_INTERVAL\n",
        "            smptms = max(SHORTEST_INTERVAL, 500 // constants.cyclec_us)\n",
    ),
    revert(
        19,
        "unit/test_smartstep_reference.py::test_page_lists_the_assumption_with_its_confidence",
        DRIVER + "profiles.py",
        '"8000, the divisor of the printed speed formula", Confidence.INFERRED_HIGH',
        '"8000, the divisor of the printed speed formula", Confidence.STATED',
    ),
    revert(
        20,
        "unit/test_smartstep_reference.py::test_alarm_pages_say_what_the_manual_documents",
        "ldcnd/fault_pages/alarm_00c1.md",
        "the manual\ndocuments no command that enables, moves, stops or resets a SmartStep (sections 3 to 6)",
        "the\nport has no command that resets a SmartStep (section 3)",
    ),
    revert(
        21,
        "unit/test_smartstep_network.py::test_a_drive_that_joins_late_and_hears_itself_is_asked_for_one_word_only",
        DRIVER + "drive.py",
        "wires_checked=self.wires_checked,",
        "wires_checked=True,",
    ),
    revert(
        22,
        "unit/test_cli_params.py::test_two_files_are_compared_however_their_parameters_are_spelt",
        "ldcnd/cli/parameter_file.py",
        "return {FAMILY.parameter(name, value)[0]: value for",
        "return {name: value for",
    ),
    revert(
        23,
        "browser/test_smartstep_pages.py::test_parameters_are_shown_with_factory_values_as_hints_and_written_digit_by_digit",
        PAGES + "parameters.js",
        '"#Factory (a hint)"',
        '"#Factory"',
    ),
    revert(
        24,
        "browser/test_smartstep_pages.py::test_the_alarm_history_is_numbered_as_in_the_manual",
        PAGES + "parameters_alarms.js",
        "[`${nth}`, entry]",
        "[`${nth + 1}`, entry]",
    ),
    revert(
        25,
        "unit/test_smartstep_reference.py::test_the_page_has_the_pins_of_both_connectors",
        "docs/reference/smartstep.md",
        "| 22, 23 | TXD+, TXD- | drive to host |",
        "| 22, 23 | TXD+, TXD- | host to drive |",
    ),
)
