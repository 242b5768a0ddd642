"""Which tests run when: the tiers of `tests.run`, by file or by the beginning of a test's name."""

from __future__ import annotations

import zlib
from pathlib import Path

import pytest

from tests.support.thorough import PART

ROOT = Path(__file__).parents[2]

ALONE = (
    "tests/attack/",
    "tests/network/test_failover.py",
    "tests/network/test_hosts.py",
    "tests/network/test_isolation.py",
    "tests/network/test_wan.py",
    "tests/integration/test_at_once.py",
    "tests/integration/test_direct_writer.py",
    "tests/integration/test_limits.py::test_a_thousand_headsets",
    "tests/integration/test_page_load.py",
    "tests/integration/test_page_many.py",
    "tests/integration/test_stop_behind.py",
    "tests/page/test_page_times.py",
    "tests/page/test_page_uplink.py",
    "tests/page/test_xr_there.py",
    "tests/ros/test_commands_at_once.py",
    "tests/ros/test_graph_verbs.py::test_the_rate_of_a_fast_sensor",
    "tests/ros/test_killed.py",
    "tests/ros/test_safety_floods.py",
)
"""What measures how long something takes to the millisecond, or needs the machine for itself: marked ``alone``."""

FEW = (
    "tests/network/test_dead_host.py",
    "tests/network/test_deployment.py",
    "tests/network/test_partition.py",
    "tests/integration/test_page_soak.py",
    "tests/page/test_page.py::test_a_network_that_stands_still",
    "tests/page/test_page.py::test_a_stop_is_seen_on_two_pages",
    "tests/page/test_page.py::test_it_stops_however_it_is_let_go",
    "tests/page/test_page_ends.py",
    "tests/page/test_xr_links.py",
    "tests/page/test_xr_never_old.py",
    "tests/page/test_xr_scene.py",
    "tests/ros/test_deadman.py",
    "tests/ros/test_services.py::test_a_thousand_calls",
)
"""What measures that as well, but tries again or takes off what the machine itself lost: marked ``few``. One or two
may run beside it, a crowd may not."""

SOAK = (
    "tests/attack/",
    "tests/conformance/test_conformance.py::test_right_and_wrong_headsets_are_told_apart",
    "tests/conformance/test_conformance.py::test_right_and_wrong_routers_are_told_apart",
    "tests/conformance/test_conformance.py::test_the_csharp_example_passes",
    "tests/integration/test_cli_programs.py::test_a_worker_starts_no_workers[--workers=2]",
    "tests/integration/test_completion.py::test_robots_and_topics",
    "tests/integration/test_deploy_doc.py",
    "tests/integration/test_doctor.py::test_rules_that_hide_everybody",
    "tests/integration/test_doctor.py::test_what_a_plan_gives",
    "tests/integration/test_door.py::test_old_tls_is_refused[TLSv1]",
    "tests/integration/test_headset_cli.py::test_a_stopped_service_ends_well[SIGINT]",
    "tests/integration/test_hostile_text.py::test_every_program",
    "tests/integration/test_limits.py::test_a_thousand_headsets",
    "tests/integration/test_limits.py::test_large_frames_leave_nothing",
    "tests/integration/test_nothing_lost.py::test_a_robot_program_that_streams_unpaced[1048576",
    "tests/integration/test_nothing_lost.py::test_a_slower_receiver_behind_another_gateway[1048576",
    "tests/integration/test_nothing_lost.py::test_large_frames",
    "tests/integration/test_nothing_lost.py::test_many_destinations",
    "tests/integration/test_nothing_lost.py::test_slower_receivers_in_a_group",
    "tests/integration/test_operator.py::test_an_answer_that_makes_no_sense",
    "tests/integration/test_operator.py::test_numbers_that_are_none",
    "tests/integration/test_operator.py::test_the_next_router_gets_its_turn[ls]",
    "tests/integration/test_output.py::test_json_is_json",
    "tests/integration/test_page_load.py",
    "tests/integration/test_page_many.py",
    "tests/integration/test_page_secured.py::test_a_secured_mesh_s_page_shows_its_robot[hall-2]",
    "tests/integration/test_resume.py::test_a_thousand_times_leave_nothing_behind",
    "tests/integration/test_rmw_mirrors.py::test_each_robot",
    "tests/integration/test_rmw_secured.py::test_the_check",
    "tests/integration/test_router_links.py::test_a_link_that_flaps",
    "tests/integration/test_security_check.py::test_a_check_does_not_disturb",
    "tests/integration/test_security_check.py::test_a_check_that_was_stopped_is_none_that_went_well[15]",
    "tests/integration/test_security_check.py::test_across_two_routers",
    "tests/integration/test_security_check.py::test_calls_of_others",
    "tests/integration/test_security_check.py::test_the_check_finds_rules_that_are_missing",
    "tests/integration/test_security_check.py::test_the_check_finds_rules_that_were_loosened[True]",
    "tests/integration/test_security_web.py::test_chromium",
    "tests/integration/test_trace_hops.py::test_a_slow_link",
    "tests/integration/test_wheel.py",
    "tests/integration/test_who_registers.py::test_names_are_forgotten[1000]",
    "tests/integration/test_wrong_port.py::test_why_no_router_answers",
    "tests/network/",
    "tests/page/test_macs_js.py::test_it_conforms",
    "tests/page/test_page.py::test_it_can_be_used_by_everybody",
    "tests/page/test_page.py::test_it_offers_what_the_token_permits",
    "tests/page/test_page.py::test_it_stops_however_it_is_let_go",
    "tests/page/test_page.py::test_the_picture_of_the_readme",
    "tests/page/test_page_age.py::test_a_clock_that_says_nothing",
    "tests/page/test_page_age.py::test_what_was_done_long_ago",
    "tests/page/test_page_ends.py::test_a_browser_that_is_killed",
    "tests/page/test_page_ends.py::test_a_browser_that_stands_still_stops_its_robot[pad]",
    "tests/page/test_page_ends.py::test_a_gateway_or_router_that_ends",
    "tests/page/test_page_hold.py::test_a_gamepad_s_button_held",
    "tests/page/test_page_hold.py::test_a_gamepad_that_comes",
    "tests/page/test_page_hold.py::test_a_modifier_key",
    "tests/page/test_page_hold.py::test_a_refused_command",
    "tests/page/test_page_hold.py::test_a_robot_that_drops_out",
    "tests/page/test_page_hold.py::test_a_zero_comes_for_a_panel",
    "tests/page/test_page_hold.py::test_a_zero_comes_through_a_network",
    "tests/page/test_page_hold.py::test_another_view",
    "tests/page/test_page_record.py",
    "tests/page/test_page_stop.py::test_a_press_that_was_taken_back",
    "tests/page/test_page_stop.py::test_a_token_for_groups",
    "tests/page/test_page_times.py",
    "tests/page/test_page_uplink.py",
    "tests/page/test_xr_guard.py::test_a_camera_that_dies",
    "tests/page/test_xr_guard.py::test_a_page_that_is_loaded_again",
    "tests/page/test_xr_guard.py::test_a_picture_that_is_said_again",
    "tests/page/test_xr_links.py",
    "tests/page/test_xr_never_old.py::test_a_frozen_picture",
    "tests/page/test_xr_never_old.py::test_who_wears_it_no_more",
    "tests/page/test_xr_screen.py::test_the_settings_leave_the_stop",
    "tests/page/test_xr_stage.py::test_each_eye",
    "tests/page/test_xr_stage.py::test_the_world_is_drawn",
    "tests/page/test_xr_there.py",
    "tests/page/test_xr_world.py",
    "tests/ros/test_agents_page.py",
    "tests/ros/test_awareness_page.py",
    "tests/ros/test_awareness_robots.py",
    "tests/ros/test_both_kinds.py",
    "tests/ros/test_graph_verbs.py::test_a_goal_whose_robot_is_killed",
    "tests/ros/test_graph_verbs.py::test_age_and_size",
    "tests/ros/test_graph_verbs.py::test_rates_sizes",
    "tests/ros/test_graph_verbs.py::test_the_rate_of_a_fast_sensor",
    "tests/ros/test_graph_verbs.py::test_to_be_stopped",
    "tests/ros/test_headset_page.py",
    "tests/ros/test_interfaces.py",
    "tests/ros/test_not_taken.py::test_verbs",
    "tests/ros/test_record_page.py::test_every_command",
    "tests/ros/test_record_story.py",
    "tests/ros/test_robot_processes.py::test_who_holds_a_service_keeps_it_when_the_robot_restarts[15]",
    "tests/ros/test_secured_verbs.py",
    "tests/ros/test_tutorial_page.py",
    "tests/ros/test_typed_values.py",
    "tests/ros/test_unity_cdr.py",
    "tests/ros/test_unity_page.py::test_every_command_runs",
    "tests/ros/test_up_demo.py::test_the_demo_drives",
    "tests/ros/test_up_demo.py::test_the_demo_leaves",
    "tests/ros/test_up_demo.py::test_two_demos",
)
"""What takes minutes, and seldom finds what others do not: marked ``soak``, run by ``make test-all`` and CI."""

FAMILY = range(3, 16)
"""So many cases of one test are programs started so many times, and one in `PART` of them is in ``make test``, another
one in each test: of four ports, say, each test has one. More are rows of a table, and cheap; so are those of
tests/unit."""


def mark(items: list[pytest.Item]) -> None:
    """Mark each with its tiers."""
    for item in items:
        for tier, names in (("alone", ALONE), ("few", FEW), ("soak", SOAK)):
            if item.nodeid.startswith(names):
                item.add_marker(tier)
    for name, cases in _families(items).items():
        chosen = zlib.crc32(name.encode()) % min(PART, len(cases))
        for number, item in enumerate(cases):
            if number % PART != chosen:
                item.add_marker("soak")


def files(tier: str) -> list[str]:
    """Those that have tests of a tier, or may: a part of a run need not read all the others."""
    listed = {name.partition("::")[0] for name in {"alone": ALONE, "few": FEW}[tier]}
    marked = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "tests").rglob("test_*.py")
        if f"pytest.mark.{tier}" in path.read_text(encoding="utf-8")
    }
    return sorted(listed | marked)


def _families(items: list[pytest.Item]) -> dict[str, list[pytest.Item]]:
    """Tests with several cases, by their names."""
    found: dict[str, list[pytest.Item]] = {}
    for item in items:
        name, _, case = item.nodeid.partition("[")
        if case and not name.startswith("tests/unit/") and not item.get_closest_marker("soak"):
            found.setdefault(name, []).append(item)
    return {name: cases for name, cases in found.items() if len(cases) in FAMILY}
