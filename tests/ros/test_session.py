"""The one ROS node and its thread."""

from __future__ import annotations

import asyncio
import logging
import sys
import threading

import pytest
from std_msgs.msg import String

from bridge.ros.session import RosSession
from macs_zenoh.errors import Unreachable
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, get, until


async def test_jobs_run_in_order_in_one_thread(session: RosSession) -> None:
    """What is submitted first is done first, and never in the caller's thread."""
    done: list[tuple[int, int]] = []

    def job(number: int) -> None:
        done.append((number, threading.get_ident()))

    futures = [session.submit(lambda number=number: job(number)) for number in range(100)]
    await asyncio.gather(*(asyncio.wrap_future(future) for future in futures))
    assert [number for number, _ in done] == list(range(100))
    assert len({thread for _, thread in done}) == 1
    assert done[0][1] != threading.get_ident()


async def test_the_result_and_the_error_of_a_job_come_back(session: RosSession) -> None:
    """A job's value is returned and its error raised where it is awaited."""
    assert await session.run(lambda: 7) == 7
    with pytest.raises(ZeroDivisionError):
        await session.run(lambda: 1 // 0)


async def test_a_failing_callback_does_not_end_the_others(
    session: RosSession, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    """After an error in a ROS callback, logged, the next message is received."""
    received: asyncio.Queue[str] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def receive(message: String) -> None:
        if message.data == "bad":
            raise ValueError(message.data)
        loop.call_soon_threadsafe(received.put_nowait, message.data)

    await session.run(lambda: session.node.create_subscription(String, "/t", receive, 10))
    publisher = await peer.publisher(String, "/t", matched=1)
    for text in ("bad", "good"):
        publisher.publish(String(data=text))
    assert await get(received) == "good"
    assert [record.levelno for record in caplog.records if record.name == "macs.ros"] == [logging.ERROR]


def test_a_closed_session_says_so(domain: int) -> None:
    """A job after the end fails at once instead of waiting for ever; closing twice is allowed."""
    session = RosSession(domain_id=domain)
    session.close()
    session.close()
    with pytest.raises(Unreachable, match="closed"):
        session.submit(lambda: None).result(PATIENCE_S)


def test_jobs_that_the_end_overtakes_fail(domain: int) -> None:
    """A job still waiting when ROS is shut down gets an error, so nobody waits for it."""
    session = RosSession(domain_id=domain)
    begun, go_on = threading.Event(), threading.Event()

    def first() -> None:
        begun.set()
        go_on.wait(5)
        session._spinning = False
        raise ValueError

    session.submit(first)
    assert begun.wait(5)
    waiting = session.submit(lambda: 7)
    go_on.set()
    assert waiting.exception(PATIENCE_S) is None or isinstance(waiting.exception(), Unreachable)
    session.close()


async def test_ros_shut_down_from_outside_is_noticed(domain: int, caplog: pytest.LogCaptureFixture) -> None:
    """When somebody ends the ROS context, jobs fail and the session can still be closed."""
    session = RosSession(domain_id=domain)
    session.context.try_shutdown()
    await until(lambda: not session._thread.is_alive())
    with pytest.raises(Unreachable):
        await session.run(lambda: None)
    session.close()
    assert "ROS was shut down from outside" in caplog.text


async def test_ros_shut_down_while_nobody_waits_is_noticed(domain: int, caplog: pytest.LogCaptureFixture) -> None:
    """It is no error of a callback that comes again for ever, where the thread is not waiting just then."""
    session = RosSession(domain_id=domain)
    await session.run(session.context.try_shutdown)
    await until(lambda: not session._thread.is_alive())
    session.close()
    assert [record.message for record in caplog.records] == ["ROS was shut down from outside"]


def test_ros_arguments_name_the_node(domain: int) -> None:
    """Remapping of name and namespace works as for every ROS node."""
    with RosSession(domain_id=domain, ros_args=["--ros-args", "-r", "__node:=left", "-r", "__ns:=/arm"]) as session:
        assert session.full_name == "/arm/left"
        assert session.node.resolve_topic_name("scan") == "/arm/scan"


@pytest.mark.parametrize("ros_args", [["--ros-args", "-r", "nonsense"], ["--ros-args", "-r", "__node:=no spaces"]])
def test_wrong_ros_arguments_are_an_error_of_ours(domain: int, ros_args: list[str]) -> None:
    """ROS arguments that ROS does not take give one line that says so."""
    with pytest.raises(Unreachable, match="ROS 2 cannot be reached") as error:
        RosSession(domain_id=domain, ros_args=ros_args)
    assert "\n" not in str(error.value)


def test_the_domain_comes_from_the_environment(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a domain id, ROS_DOMAIN_ID holds."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    with RosSession() as session:
        assert session.context.get_domain_id() == domain


async def test_without_ros_the_robot_says_what_to_install() -> None:
    """`macs agent` where rclpy cannot be imported ends with one line of advice, not a traceback."""
    program = "import sys; sys.modules['rclpy'] = None; from bridge.cli import main; sys.exit(main(['agent']))"
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", program), stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    out, log = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert process.returncode == 1
    assert out == b""
    (line,) = log.decode().splitlines()
    assert "pip install 'macs-zenoh[ros]'" in line
    assert "setup.bash" in line
