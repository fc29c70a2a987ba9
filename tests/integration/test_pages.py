"""The commands of the pages work; those that no test can run are few, and say why."""

import json
import re
import tomllib

import pytest

from ldcnd.contract.fault_pages import FOLDER
from tests.support.page_reader import PageReader
from tests.support.pages import ROOT, blocks_of, broken_links, command_lines, pages, require_command_line

FIRST_RIG = "docs/tutorials/first-rig.md"
CENTRIFUGE = "docs/tutorials/centrifuge.md"
MONITOR = "docs/how-to/monitor-a-rig.md"
EPICS = "docs/how-to/use-epics.md"
SECOP = "docs/how-to/use-secop.md"
NEXT = (
    "docs/tutorials/move-from-python.md",
    "docs/tutorials/take-a-trace.md",
    "docs/tutorials/record-and-export.md",
)
BY_THEMSELVES = ("docs/how-to/simulate-a-line.md", "docs/how-to/secure-a-rig.md")
OPERATING = tuple(
    f"docs/how-to/{name}.md"
    for name in ("commission-a-first-drive", "jog", "home", "tune", "move-a-group", "speed-and-approach")
)
FOLLOWED = {FIRST_RIG, CENTRIFUGE, *NEXT, *BY_THEMSELVES, *OPERATING}
"""Pages whose blocks are run here, all of them but those in `NOT_RUN`."""
ELSEWHERE = {
    "deploy/INSTALL.md": "test_every_command_of_the_guide_works",
    "docs/how-to/rehearse-a-night-run.md": "test_a_twin_is_served_to_programs_that_know_nothing_of_it",
    "docs/how-to/replay-a-capture.md": "test_what_the_page_does_with_a_capture_can_be_done",
    "docs/how-to/take-a-trace.md": "test_a_move_is_traced_to_a_file_shown_and_drawn",
    "docs/how-to/test-your-program.md": "test_the_blocks_of_the_page_run_in_an_empty_folder",
    "docs/how-to/watch-an-axis.md": "test_the_blocks_of_the_page_tune_an_axis_and_watch_it",
}
"""Pages whose commands another test runs."""
NOT_RUN = {
    ("README.md", "make run    # an environment of 80 MB, the simulated rig and its console, and what to type next"): (
        "test_make_run_says_what_to_type_and_the_first_program_moves"
    ),
    ("README.md", "# first.py"): "test_make_run_says_what_to_type_and_the_first_program_moves",
    (EPICS, "ldcnd epics --prefix lab:"): "test_libca_sees_a_record_that_it_cannot_write",
    (EPICS, "ldcnd epics x y --prefix lab: --moves"): "test_an_unmodified_client_uses_the_record",
    (EPICS, "devices = dict("): "test_an_axis_is_read_homed_moved_scanned_and_stopped",
    (SECOP, 'description = "axes of ldcnd"'): "test_an_axis_is_read_homed_moved_scanned_and_stopped",
    (SECOP, "pip install '.[secop]'"): "fetches packages",
    (SECOP, "ldcnd secop x y --moves"): "test_an_axis_is_a_drivable_that_is_sent_stopped_and_reset",
    ("docs/how-to/use-ros-2.md", "ldcnd ros2 x y --router tcp/127.0.0.1:7448 --domain 0"): (
        "test_a_plain_zenoh_client_sees_node_publishers_and_joint_states"
    ),
    ("docs/how-to/use-bluesky.md", "from bluesky import RunEngine"): (
        "test_the_page_on_bluesky_runs_and_its_documents_are_valid"
    ),
    ("docs/how-to/run-in-a-container.md", "docker build -f deploy/container/Dockerfile -t ldcnd ."): (
        "needs an engine and fetches packages; tests/unit/test_deploy_container.py reads the files"
    ),
    ("README.md", ".venv/bin/ldcnd list"): "test_the_tour_of_the_readme_runs",
    ("README.md", ".venv/bin/python examples/move_and_watch.py"): (
        "test_the_example_follows_a_moving_axis_to_its_target"
    ),
    (FIRST_RIG, "python3 -m venv ldcnd-env"): "fetches packages",
    ("docs/how-to/write-a-client.md", "import asyncio, ldcnd"): "test_the_first_program_runs",
    (
        "docs/how-to/console.md",
        "pip install '.[console]'    # in a checkout; or the wheel with [console] behind its name",
    ): ("fetches packages; tests/integration/test_console_server.py runs the console"),
    ("docs/how-to/console.md", "ssh -L 8470:127.0.0.1:8470 bench.example ldcnd console"): "needs another machine",
    ("docs/how-to/console.md", "openssl rand -hex 32 > token; chmod 600 token"): (
        "test_tls_and_a_token_let_in_whoever_has_it_and_cookies_stay_inside_tls"
    ),
    ("docs/how-to/commission-a-first-drive.md", "ldcnd commission x --config rig.toml"): (
        "test_all_steps_are_gone_through_and_the_change_is_shown_and_written"
    ),
    ("docs/how-to/confirm-on-hardware.md", "ldcnd accept /dev/ldcn-FT4ABCDE-00 --out acceptance"): (
        "test_drives_that_are_as_the_documents_say_confirm_every_assumption_that_reading_can"
    ),
    (
        "docs/how-to/confirm-on-hardware.md",
        "ldcnd accept /dev/ldcn-FT4ABCDE-00 --out acceptance --move 1 --gains 350,3000,400,400,250,4000 --counts 2000",
    ): "test_trial_move_confirms_the_rest_and_leaves_the_loop_open",
    ("docs/how-to/choose-an-adapter.md", "ldcnd doctor --config rig.toml --bus line0"): (
        "test_command_prints_findings_as_json_lines"
    ),
    ("docs/how-to/probe-and-inputs.md", "ldcnd bus snapshot line0"): (
        "test_a_snapshot_shows_positions_inputs_and_the_instant"
    ),
    (
        "docs/how-to/probe-and-inputs.md",
        "ldcnd axis probe x --source forward_limit --distance 25 --velocity 1 --wait",
    ): "test_a_probe_latches_and_its_position_can_be_read",
    ("docs/how-to/probe-and-inputs.md", "ldcnd bus set-io cabinet 4=high 9=low --pwm1 0.5"): (
        "test_outputs_are_set_by_line_and_level"
    ),
    ("docs/how-to/tune.md", "ldcnd tune x --bandwidth 25 --yes --plot tune.png"): (
        "test_the_command_tunes_draws_and_prints_its_report_as_json"
    ),
    ("docs/how-to/tune.md", "ldcnd tune x --put-back"): "test_gains_of_a_tuning_that_was_killed_are_put_back_by_hand",
    (MONITOR, "ldcnd metrics"): "test_metrics_are_served_over_http_by_a_process_of_their_own",
    (MONITOR, "ldcnd foxglove"): "test_a_daemon_is_shown_by_a_process_of_its_own",
    ("docs/how-to/secure-a-rig.md", "ldcnd move x 10 --connect unixsock-stream//run/ldcnd/operator.sock"): (
        "needs the socket of the service"
    ),
    ("docs/how-to/secure-a-rig.md", "ldcnd list --config wall_display.json5   # lists"): (
        "needs the machines of a site; tests/integration/test_security_lan.py has one"
    ),
}
"""Blocks that are not run from the page, each by its first line, with the reason or the test that does it."""
BLOCKS = [block for page in pages() for block in blocks_of(page)]
RUNNABLE = [block for block in BLOCKS if block.language in ("sh", "console", "python")]


def test_every_block_is_run_or_says_why_not() -> None:
    silent = [
        str(block)
        for block in RUNNABLE
        if block.page not in FOLLOWED | set(ELSEWHERE) and (block.page, block.first_line) not in NOT_RUN
    ]
    assert silent == [], "add the page to FOLLOWED, or the block with its reason to NOT_RUN"


def test_no_exception_outlives_its_block() -> None:
    known = {(block.page, block.first_line) for block in RUNNABLE}

    assert set(NOT_RUN) <= known
    assert FOLLOWED | set(ELSEWHERE) <= {block.page for block in BLOCKS}


@pytest.mark.parametrize("page", sorted({block.page for block in RUNNABLE if block.language != "python"}))
def test_every_command_line_of_a_page_is_one(page: str) -> None:
    for block in RUNNABLE:
        for words in command_lines(block.text) if block.page == page and block.language != "python" else ():
            require_command_line(words)


def test_every_file_is_well_formed() -> None:
    for block in BLOCKS:
        if block.language in ("toml", "json"):
            assert (tomllib if block.language == "toml" else json).loads(block.text), str(block)


def test_every_link_leads_somewhere() -> None:
    copied = "../how-to/install.md"  # of deploy/INSTALL.md, by what builds the site or a package
    assert [each for each in broken_links(pages()) if not each.endswith(f" {copied}")] == []


def test_every_path_of_this_repository_that_a_page_names_exists() -> None:
    named = re.compile(r"(?<![\w./$~<-])(?:ldcnd|tests|docs|config|deploy|examples|schemas)/[\w./*<>-]*[\w/*>]")
    missing = [
        f"{page.relative_to(ROOT)}: {path}"
        for page in (*pages(), ROOT / "CHANGELOG.md", *FOLDER.glob("*.md"))
        for path in sorted(set(named.findall(page.read_text())))
        if not list(ROOT.glob(re.sub(r"<\w+>", "*", path)))
    ]

    assert missing == []


@pytest.mark.system
@pytest.mark.real_time
@pytest.mark.timeout(600)
async def test_the_tutorials_can_be_followed(tmp_path) -> None:
    async with PageReader(tmp_path) as reader:
        await reader.follow(ROOT / FIRST_RIG, NOT_RUN)
        assert "more: ldcnd fault not_referenced" in reader.printed
        assert "a stop was asked for" in reader.printed

    async with PageReader(tmp_path) as reader:
        await reader.start_daemon("rig.toml")
        for page in NEXT:
            await reader.follow(ROOT / page, NOT_RUN)

    assert "there: standstill" in reader.printed
    assert "nearest: 100.0" in reader.printed
    assert "killed" in reader.printed
    assert (tmp_path / "move.png").read_bytes().startswith(b"\x89PNG")
    assert " positions, from " in reader.printed
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.system
@pytest.mark.real_time
@pytest.mark.timeout(240)
async def test_a_first_drive_is_commissioned_jogged_homed_tuned_and_moved_in_a_group(tmp_path) -> None:
    async with PageReader(tmp_path) as reader:
        for page in OPERATING:
            await reader.follow(ROOT / page, NOT_RUN)

    assert (tmp_path / "before.csv").exists()
    assert "motor and encoder agree" in (tmp_path / "x.html").read_text()


@pytest.mark.system
@pytest.mark.real_time
@pytest.mark.timeout(120)
@pytest.mark.parametrize("page", BY_THEMSELVES)
async def test_a_how_to_can_be_followed(page: str, tmp_path) -> None:
    async with PageReader(tmp_path) as reader:
        await reader.follow(ROOT / page, NOT_RUN)


@pytest.mark.system
@pytest.mark.real_time
@pytest.mark.timeout(120)
async def test_a_centrifuge_is_spun_and_opened_as_far_as_its_rules_allow(tmp_path) -> None:
    async with PageReader(tmp_path) as reader:
        text = (ROOT / "config" / "centrifuge.toml").read_text()
        (tmp_path / "centrifuge.toml").write_text(text.replace("7447", reader.port))
        await reader.follow(ROOT / CENTRIFUGE, NOT_RUN)

    assert "interlock lock_opens: axis rotor" in reader.printed
    assert "interlock door_shut: " in reader.printed
