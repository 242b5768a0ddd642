"""What holds for a whole test run."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("macs", deadline=None)  # how long an example takes is the machine's affair
settings.load_profile("macs")

NEED_ROS_TESTS = "MACS_NEED_ROS_TESTS"
"""Set by ``make test`` and CI: a run in which no ROS test passed is a failed run."""


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


def pytest_configure(config: pytest.Config) -> None:
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        # a shell starts what it runs in the background so; programs that are tested with Ctrl-C would inherit it
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if os.environ.get(NEED_ROS_TESTS):
        config.pluginmanager.register(_RosTests())
