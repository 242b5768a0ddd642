"""One ROS node and the one thread that spins it, in a context of its own.

One node for all interfaces, because a node costs a quarter of a second and its own set of parameter services; one
single-threaded executor, because rclpy 7.1's multi-threaded one loses messages (of 200 sent 5 ms apart at depth 10 it
got 87 to 95) and its events executor was seen to spin at full load without delivering.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from types import TracebackType
from typing import Any, TypeVar

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from bridge.ros.intake import Intake
from bridge.ros.jobs import settle
from bridge.ros.rclpy_side import RclpySide
from macs_zenoh.errors import Unreachable

log = logging.getLogger("macs.ros")

T = TypeVar("T")


class RosSession(RclpySide):
    """A ROS node that works in its own thread until `close`; also a context manager.

    Args:
        name: of the node; remapping (``-r __node:=...``, ``-r __ns:=...``) in ``ros_args`` wins.
        domain_id: None takes ``ROS_DOMAIN_ID``.
        ros_args: ROS arguments, as ``["--ros-args", "-r", "__ns:=/robot7"]``.
        make_node: makes the node of the name and the options given here.

    Raises Unreachable when ROS cannot start (a wrong argument, no middleware).
    """

    def __init__(
        self,
        name: str = "rosagent",
        *,
        domain_id: int | None = None,
        ros_args: Sequence[str] = (),
        make_node: Callable[..., Node] = rclpy.create_node,
    ) -> None:
        self.context = Context()
        try:
            rclpy.init(
                args=list(ros_args),
                context=self.context,
                domain_id=domain_id,
                # signals belong to the program; a handler of ROS's would end the context under our feet
                signal_handler_options=SignalHandlerOptions.NO,
            )
            # Every service of a node costs time in each turn of the executor, so this one has none of its own:
            # without them a turn takes three quarters of the time.
            self.node = make_node(
                name,
                context=self.context,
                start_parameter_services=False,
                enable_rosout=False,
                parameter_overrides=[Parameter("start_type_description_service", value=False)],
            )
        except RuntimeError as error:
            self.context.try_shutdown()
            raise Unreachable("ROS 2", why(error)) from error
        self.intake = Intake(self.node)
        """For subscriptions whose messages are only passed on."""
        self._jobs: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._lock = threading.Lock()
        self._spinning = True
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._jobs_waiting = self.node.create_guard_condition(self._work)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name="macs-ros", daemon=True)
        self._thread.start()

    def __enter__(self) -> RosSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def domain(self) -> int:
        """The ROS domain that it is in."""
        return int(self.context.get_domain_id())

    @property
    def full_name(self) -> str:
        """Namespace and name of the node."""
        return str(self.node.get_fully_qualified_name())

    def submit(self, job: Callable[[], T]) -> Future[T]:
        """Run ``job`` in the ROS thread, after those submitted before. From any thread; never waits.

        The future raises Unreachable when the session ends first.
        """
        future: Future[T] = Future()
        with self._lock:
            if self._spinning:
                self._jobs.append((job, future))
                self._jobs_waiting.trigger()
                return future
        future.set_exception(Unreachable("ROS 2", "the session is closed"))
        return future

    def hurry(self, job: Callable[[], T]) -> Future[T]:
        """`Side.hurry`: nothing waits in this thread."""
        return self.submit(job)

    def later(self, delay_s: float, job: Callable[[], object]) -> None:
        """Run ``job`` in the ROS thread after a time, unless the session ends before. In the ROS thread."""

        def fire() -> None:
            self.node.destroy_timer(timer)
            job()

        # a clock of its own: with use_sim_time the node's may stand still
        timer = self.node.create_timer(delay_s, fire, clock=self._clock)

    async def run(self, job: Callable[[], T]) -> T:
        """Run ``job`` in the ROS thread and return its result or raise its error."""
        return await asyncio.wrap_future(self.submit(job))

    def close(self) -> None:
        """End the thread, then the node, then the context: in another order rclpy can abort the process."""
        self.submit(self._stop)
        self._thread.join()
        self.intake.close()
        self._executor.shutdown()
        if self.context.ok():
            self.node.destroy_node()
        self.context.try_shutdown()

    # -- in the ROS thread ---------------------------------------------------------------------------------------

    def _spin(self) -> None:
        while self._spinning:
            try:
                self._executor.spin_once()
            except Exception as error:
                # rclpy says so only to who waits at that moment; who comes later is told that he cannot wait, for ever
                if isinstance(error, ExternalShutdownException) or not self.context.ok():
                    log.warning("ROS was shut down from outside")
                    break
                # one callback that failed must not end the others
                log.exception("error in a ROS callback")
        with self._lock:
            self._spinning = False
            unfinished = list(self._jobs)
            self._jobs.clear()
        for _, future in unfinished:
            if future.set_running_or_notify_cancel():
                future.set_exception(Unreachable("ROS 2", "the session is closed"))

    def _work(self) -> None:
        while self._jobs:
            job, future = self._jobs.popleft()
            settle(future, job)

    def _stop(self) -> None:
        self._spinning = False


def why(error: RuntimeError) -> str:
    """What rcl says is wrong, in a line, and what to do where it does not say that."""
    first = str(error).splitlines()[0].split(", at /")[0]
    if "log" in first and "directory" in first:
        home = os.environ.get("HOME")
        at = f"{home}/.ros/log cannot be made" if home else "HOME is not set"
        return f"{first}: {at}; set ROS_LOG_DIR to a directory that can be written"
    return first
