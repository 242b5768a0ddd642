"""What holds for a whole test run."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.support import tiers
from tests.support.isolation import isolate
from tests.support.patience import be_patient
from tests.support.thorough import examples

NEED_ROS_TESTS = "MACS_NEED_ROS_TESTS"
"""Set by ``make test`` and CI: a run in which no ROS test passed is a failed run."""

LOGGERS = ("macs", "macs.mesh", "macs.demo")
"""Those whose level our programs set."""

# Hundreds of processes are started, which must not compile all of our modules each: environments made for containers
# often forbid to keep what was compiled.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Thousands of tests are collected, and nothing of them is garbage: without a look for any it takes a third less.
gc.disable()

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
        backwards = {path: -number for number, path in enumerate(dict.fromkeys(item.path for item in items))}
        items.sort(key=lambda item: backwards[item.path])
    tiers.mark(items)
    if "PYTEST_XDIST_WORKER" in os.environ:
        from tests.support.sharing import order  # what needs xdist; a run of one process does not

        items[:] = [items[index] for index in order([item.nodeid for item in items])]


def pytest_collection_finish() -> None:
    gc.collect()
    gc.freeze()  # what is there stays, and no collection looks at it again


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop() -> None:
    gc.enable()  # also in who hands tests out to workers, and collects none


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """How tests are shared out among workers."""
    from tests.support.sharing import Sharing

    return Sharing(config, log)


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
async def router(request: pytest.FixtureRequest) -> AsyncIterator[str]:
    """A Zenoh router in this process, or in one of its own for a test marked ``megabytes``; its endpoint.

    All sessions of a process share the two threads that read their links. A router that waits there for room in one of
    them may wait for itself, once more is on its way than kernels and queues hold.
    """
    from tests.support import local  # most tests need no Zenoh

    apart = request.node.get_closest_marker("megabytes") is not None
    async with local.router_apart() if apart else local.local_router() as endpoint:
        yield endpoint
