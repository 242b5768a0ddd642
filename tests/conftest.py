"""What holds for a whole test run."""

from __future__ import annotations

import logging
import os
import signal
import sys
import zlib
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.support.isolation import isolate
from tests.support.patience import be_patient
from tests.support.thorough import PART, examples

NEED_ROS_TESTS = "MACS_NEED_ROS_TESTS"
"""Set by ``make test`` and CI: a run in which no ROS test passed is a failed run."""


ALONE = (
    "tests/attack/",
    "tests/network/",
    "tests/integration/test_at_once.py",
    "tests/integration/test_direct_writer.py",
    "tests/integration/test_limits.py::test_a_thousand_headsets",
    "tests/integration/test_page_load.py",
    "tests/integration/test_page_many.py",
    "tests/integration/test_page_soak.py",
    "tests/integration/test_stop_behind.py",
    "tests/page/test_page.py::test_a_network_that_stands_still",
    "tests/page/test_page.py::test_a_stop_is_seen_on_two_pages",
    "tests/page/test_page.py::test_it_stops_however_it_is_let_go",
    "tests/page/test_page_times.py",
    "tests/page/test_page_uplink.py",
    "tests/page/test_xr_links.py",
    "tests/page/test_xr_never_old.py",
    "tests/page/test_xr_scene.py",
    "tests/page/test_xr_there.py",
    "tests/ros/test_commands_at_once.py",
    "tests/ros/test_deadman.py",
    "tests/ros/test_graph_verbs.py::test_the_rate_of_a_fast_sensor",
    "tests/ros/test_killed.py",
    "tests/ros/test_safety_floods.py",
)
"""What measures how long something takes, or needs the machine for itself: marked ``alone``."""

SOAK = (
    "tests/attack/",
    "tests/conformance/test_conformance.py::test_right_and_wrong_routers_are_told_apart",
    "tests/network/",
    "tests/integration/test_deploy_doc.py",
    "tests/integration/test_hostile_text.py::test_every_program",
    "tests/integration/test_limits.py::test_a_thousand_headsets",
    "tests/integration/test_nothing_lost.py::test_large_frames",
    "tests/integration/test_nothing_lost.py::test_many_destinations",
    "tests/integration/test_nothing_lost.py::test_slower_receivers_in_a_group",
    "tests/integration/test_operator.py::test_an_answer_that_makes_no_sense",
    "tests/integration/test_operator.py::test_numbers_that_are_none",
    "tests/integration/test_output.py::test_json_is_json",
    "tests/integration/test_page_load.py",
    "tests/integration/test_page_many.py",
    "tests/integration/test_security_web.py::test_chromium",
    "tests/integration/test_wrong_port.py::test_why_no_router_answers",
    "tests/integration/test_rmw_mirrors.py::test_each_robot",
    "tests/integration/test_rmw_secured.py::test_the_check",
    "tests/integration/test_trace_hops.py::test_a_slow_link",
    "tests/integration/test_router_links.py::test_a_link_that_flaps",
    "tests/page/test_macs_js.py::test_it_conforms_in_chromium[page]",
    "tests/page/test_macs_js.py::test_it_conforms_in_node",
    "tests/page/test_page.py::test_it_can_be_used_by_everybody",
    "tests/page/test_page.py::test_the_picture_of_the_readme",
    "tests/page/test_page_hold.py::test_a_robot_that_drops_out",
    "tests/page/test_page_record.py",
    "tests/page/test_page_times.py",
    "tests/page/test_page_uplink.py",
    "tests/page/test_xr_guard.py::test_a_camera_that_dies",
    "tests/page/test_xr_guard.py::test_a_picture_that_is_said_again",
    "tests/page/test_xr_links.py",
    "tests/page/test_xr_never_old.py::test_a_frozen_picture",
    "tests/page/test_xr_never_old.py::test_who_wears_it_no_more",
    "tests/page/test_xr_there.py",
    "tests/page/test_xr_world.py",
    "tests/integration/test_wheel.py::test_a_shipped_interface_package_builds",
    "tests/integration/test_wheel.py::test_every_verb_is_there",
    "tests/integration/test_wheel.py::test_init_writes_what_programs_take",
    "tests/ros/test_agents_page.py",
    "tests/ros/test_awareness_page.py",
    "tests/ros/test_awareness_robots.py",
    "tests/ros/test_both_kinds.py",
    "tests/ros/test_headset_page.py",
    "tests/ros/test_interfaces.py",
    "tests/ros/test_not_taken.py::test_verbs",
    "tests/ros/test_record_page.py::test_every_command",
    "tests/ros/test_record_story.py",
    "tests/ros/test_secured_verbs.py",
    "tests/ros/test_tutorial_page.py",
    "tests/ros/test_typed_values.py",
    "tests/ros/test_unity_page.py::test_every_command_runs",
    "tests/ros/test_unity_cdr.py",
    "tests/ros/test_up_demo.py::test_the_demo_drives",
    "tests/ros/test_up_demo.py::test_the_demo_leaves",
    "tests/ros/test_up_demo.py::test_two_demos",
)
"""What takes minutes, and seldom finds what others do not: marked ``soak``, run by ``make test-all`` and CI."""

FAMILY = range(3, 16)
"""So many cases of one test are programs started so many times, and one in `PART` of them is in ``make test``, another
one in each test: of four ports, say, each test has one. More are rows of a table, and cheap; so are those of
tests/unit."""

LOGGERS = ("macs", "macs.mesh", "macs.demo")
"""Those whose level our programs set."""

# Hundreds of processes are started, which must not compile all of our modules each: environments made for containers
# often forbid to keep what was compiled.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Timings never decide a test: a busy machine is no counterexample.
settings.register_profile(
    "macs", deadline=None, max_examples=examples(100), suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("macs")


class _RosTests:
    """Counts the tests under tests/ros that ran and passed."""

    def __init__(self) -> None:
        self.passed = 0

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if (
            report.when == "call"
            and report.passed
            and Path(report.nodeid.partition("::")[0]).parts[:2] == ("tests", "ros")
        ):
            self.passed += 1

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if not self.passed and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        verdict = f"ROS tests passed: {self.passed}"
        terminalreporter.write_line(verdict if self.passed else f"{verdict}: this run proves too little, so it failed")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--backwards", action="store_true", help="the last file first: no test needs one before it")


def pytest_configure(config: pytest.Config) -> None:
    if "PYTEST_XDIST_WORKER" in os.environ:
        isolate()
    # A shell ignores both for what it runs in the background; programs that are stopped by them would inherit that.
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGQUIT, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, usual)
    if (
        os.environ.get(NEED_ROS_TESTS) and "PYTEST_XDIST_WORKER" not in os.environ
    ):  # workers report to the first process
        config.pluginmanager.register(_RosTests())


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--backwards"):
        order = {path: -number for number, path in enumerate(dict.fromkeys(item.path for item in items))}
        items.sort(key=lambda item: order[item.path])
    for item in items:
        if item.nodeid.startswith(ALONE):
            item.add_marker(pytest.mark.alone)
        if item.nodeid.startswith(SOAK):
            item.add_marker(pytest.mark.soak)
    for name, cases in _families(items).items():
        chosen = zlib.crc32(name.encode()) % min(PART, len(cases))
        for number, item in enumerate(cases):
            if number % PART != chosen:
                item.add_marker(pytest.mark.soak)


def _families(items: list[pytest.Item]) -> dict[str, list[pytest.Item]]:
    """Tests with several cases, by their names."""
    found: dict[str, list[pytest.Item]] = {}
    for item in items:
        name, _, case = item.nodeid.partition("[")
        if case and not name.startswith("tests/unit/") and not item.get_closest_marker("soak"):
            found.setdefault(name, []).append(item)
    return {name: cases for name, cases in found.items() if len(cases) in FAMILY}


@pytest.fixture(scope="session", autouse=True)
def _patient() -> None:
    """No test fails because an answer takes longer than people would wait for it."""
    be_patient()


@pytest.fixture(autouse=True)
def _logging_as_before() -> Iterator[None]:
    """What a command line that ran in the process of a test logs, and where, is nothing to the tests after it."""
    root, ours = logging.getLogger(), [logging.getLogger(name) for name in LOGGERS]
    levels, handlers = [each.level for each in (root, *ours)], set(root.handlers)
    yield
    for each, level in zip((root, *ours), levels, strict=True):
        each.setLevel(level)
    for added in set(root.handlers) - handlers:
        root.removeHandler(added)


@pytest.fixture
async def router() -> AsyncIterator[str]:
    """A Zenoh router in this process; its endpoint."""
    from tests.support.local import local_router  # most tests need no Zenoh

    async with local_router() as endpoint:
        yield endpoint
