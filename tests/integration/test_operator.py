"""What an operator sees and does from a command line, on robots that answer, refuse, are slow or say nothing."""

from __future__ import annotations

import asyncio
import json
import signal
import socket as socketlib
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack

import pytest

import macs_zenoh
from macs_zenoh.errors import Refused
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.programs import ROOT, ended, macs
from tests.support.sockets import socket
from tests.support.waiting import PATIENCE_S, until

MANY = 12


class Robot:
    """A robot agent as the mesh sees it: it tells its state, and can be stopped. ``calls``: who asked for what."""

    def __init__(self, robot_id: int) -> None:
        self.id = robot_id
        self.stopped = False
        self.calls: list[str] = []
        self.holder: str | None = None
        self.silent_for = 0
        """So many calls are not answered in time."""
        self.refuses = ""
        self.obeys = True

    def serve(self, agent: macs_zenoh.Agent) -> None:
        for verb in ("status", "stop"):
            agent.serve(verb, self._answer)

    async def _answer(self, call: macs_zenoh.Call) -> bytes:
        self.calls.append(f"{call.verb} by {call.sender_type}/{call.sender_id}")
        if self.silent_for:
            self.silent_for -= 1
            await asyncio.sleep(30)
        if call.verb == "stop":
            if self.refuses:
                raise Refused(self.refuses)
            if self.obeys:
                self.stopped = call.data == b"true"
        control = {"holder": self.holder, "seconds_held": 2.0, "seconds_left": 1.0}
        node = {"role": "publisher", "name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "control": control}
        by = f"{call.sender_type}/{call.sender_id}" if self.stopped else ""
        stop = {"by": by, "seconds": 1.0, "times": int(self.stopped), "history": []}
        return json.dumps({"ros_node": "/r", "stopped": self.stopped, "stop": stop, "nodes": [node]}).encode()


StartRobot = Callable[..., Awaitable[Robot]]


@pytest.fixture
async def start_robot(router: str) -> AsyncIterator[StartRobot]:
    """Starts robots on the mesh, which answer before anybody sees them."""
    async with AsyncExitStack() as stack:

        async def start(robot_id: int, group: int = 0) -> Robot:
            robot = Robot(robot_id)
            agent = await stack.enter_async_context(
                macs_zenoh.join("ros", id=robot_id, group=group, settings=patient(router))
            )
            robot.serve(agent)
            await agent.call("ros", robot_id, "status")
            robot.calls.clear()
            return robot

        yield start


async def test_stop_stops_every_robot_and_says_so(router: str, start_robot: StartRobot) -> None:
    """Without ids all that are online are stopped, at once; --release wants to be told which, and lets them go."""
    robots = await asyncio.gather(*(start_robot(number) for number in range(1, MANY + 1)))
    code, out, errors = await ended("stop", "-e", router)
    assert code == 0, errors
    assert sorted(out.splitlines()) == sorted(f"robot {robot.id} is stopped, by operator/0" for robot in robots)
    assert all(robot.stopped for robot in robots)
    code, _, errors = await ended("stop", "--release", "-e", router)
    assert code == 2
    assert "say which robots" in errors
    assert all(robot.stopped for robot in robots)
    released = await macs("stop", "--release", "--all", "--json", "-e", router)
    assert released == [{"id": robot.id, "done": True, "stopped": False, "by": "", "problem": ""} for robot in robots]
    assert not any(robot.stopped for robot in robots)


async def test_stop_takes_ids_and_groups(router: str, start_robot: StartRobot) -> None:
    """Only those named are stopped, as the agent that --as names."""
    robots = {number: await start_robot(number, group) for number, group in ((1, 3), (2, 3), (3, 0), (4, 5))}
    stopped = await macs("stop", "3", "--group", "3", "--as", "operator/9", "--json", "-e", router)
    assert [outcome["id"] for outcome in stopped] == [1, 2, 3]
    assert robots[3].calls == ["stop by operator/9", "status by operator/9"]
    assert robots[4].calls == []


async def test_stop_is_repeated_until_it_is_confirmed(router: str, start_robot: StartRobot) -> None:
    """A robot that does not answer is told again, and confirmed when it does."""
    robot = await start_robot(7)
    robot.silent_for = 2
    code, out, errors = await ended("stop", "7", "-e", router, "--timeout", "15")
    assert (code, out) == (0, "robot 7 is stopped, by operator/0\n"), errors
    assert robot.calls == ["stop by operator/0"] * 3 + ["status by operator/0"]


async def test_stop_fails_unless_all_confirm(router: str, start_robot: StartRobot) -> None:
    """One that is absent, says nothing, refuses or goes on makes it fail, and is named; the others are stopped."""
    good, silent, refusing, deaf = [await start_robot(number) for number in (1, 2, 3, 4)]
    silent.silent_for = 1000
    refusing.refuses = "operator/0 may not stop this robot"
    deaf.obeys = False
    code, out, _ = await ended("stop", "1", "2", "3", "4", "9", "--timeout", "2", "-e", router)
    assert code == 1
    assert sorted(out.splitlines()) == [
        "robot 1 is stopped, by operator/0",
        "robot 2 is NOT stopped: no answer within 2 s",
        "robot 3 is NOT stopped: operator/0 may not stop this robot",
        "robot 4 is NOT stopped: it has not done what it was told",
        "robot 9 is NOT stopped: nobody there answers this call",
    ]
    assert good.stopped


async def test_stop_of_nobody_is_no_success(router: str) -> None:
    """With no robot online nothing was stopped, and the exit code says so; so it does without a router."""
    code, out, _ = await ended("stop", "-e", router)
    assert (code, out) == (1, "no such robot is online\n")
    code, out, errors = await ended("stop", "-e", "tcp/127.0.0.1:1", "--timeout", "0.5")
    assert (code, out) == (1, "")
    assert "no Zenoh router answered" in errors
    assert "start one with `macs router`" in errors


@pytest.mark.parametrize("verb", ["ls", "stop"])
async def test_the_next_router_gets_its_turn(verb: str, router: str, start_robot: StartRobot) -> None:
    """With the first router's host off, which refuses nothing, a verb with its usual patience works over the second
    one."""
    robot = await start_robot(7)
    off = socketlib.create_server(("127.0.0.1", 0))  # takes connections and says nothing
    with off:
        code, out, _ = await ended(verb, "-e", f"tcp/127.0.0.1:{off.getsockname()[1]}", "-e", router)
    assert code == 0
    assert "7" in out
    assert robot.stopped is (verb == "stop")


async def test_an_interrupted_stop_is_no_success(router: str, start_robot: StartRobot) -> None:
    """Ctrl-C before a robot has confirmed ends it at once, and not with 0."""
    robot = await start_robot(7)
    robot.silent_for = 1000
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "bridge", "stop", "7", "--timeout", "60", "-e", router),
        cwd=ROOT,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    await until(lambda: robot.calls)
    process.send_signal(signal.SIGINT)
    _, errors = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert process.returncode == 130
    assert "Task was destroyed" not in errors.decode()


async def test_ls_shows_who_is_stopped_and_who_has_control(
    router: str, start_robot: StartRobot, start_gateway: StartGateway, connect: Connect
) -> None:
    """A line per agent as before, and the state of robots; nothing of it while there is nothing to tell."""
    first, second = await start_robot(1), await start_robot(2)
    headset = await connect(await start_gateway())
    while set((await headset.online()).ros_agent_ids) != {1, 2}:
        await asyncio.sleep(0.02)
    code, out, _ = await ended("ls", "-e", router)
    assert code == 0
    assert [line.split()[0] for line in out.partition("\n\n")[0].splitlines()] == ["TYPE", "ros", "ros", "unity"]
    assert "STATE" not in out
    first.stopped, first.holder = True, "unity/5"
    second.holder = "unity/6"
    code, out, _ = await ended("ls", "-e", router)
    states = [line[out.index("STATE") :] for line in out.partition("\n\n")[0].splitlines()]
    assert states == ["STATE", "stopped by operator/0, /cmd_vel: unity/5", "/cmd_vel: unity/6", "-"]
    assert len(set(first.calls)) == 1, "it asks for the state, and for nothing else"


async def test_ls_does_not_wait_for_a_robot_that_is_stuck(router: str, start_robot: StartRobot) -> None:
    """It is listed with a question mark, and for programs with the problem; the others tell their state."""
    stuck, well = await start_robot(1), await start_robot(2)
    stuck.silent_for = 1000
    listed = await asyncio.wait_for(macs("ls", "--json", "-e", router), PATIENCE_S)
    assert [row["problem"] for row in listed] == ["no answer within 1 s", ""]
    assert listed[0]["status"] is None
    assert listed[1]["status"]["ros_node"] == "/r"
    assert well.calls == ["status by operator/0"]
    _, out, _ = await ended("ls", "-e", router)
    assert out.partition("\n\n")[0].splitlines()[1].endswith("?")


async def test_ls_knows_robots_that_tell_nothing(router: str, start_gateway: StartGateway, connect: Connect) -> None:
    """A robot behind a gateway, as existing programs are, has no state to tell: that is no fault."""
    gateway = await start_gateway()
    headset = await connect(gateway)
    async with socket(gateway) as robot:
        robot.configure(agent_type=1)
        while (await headset.online()).ros_agent_ids != [robot.id]:
            await asyncio.sleep(0.02)
        row, _ = await macs("ls", "--json", "-e", router)
        assert (row["type"], row["status"], row["problem"]) == ("ros", None, "")
        _, out, _ = await ended("ls", "-v", "-e", router)
        assert "is no `macs agent`" in out


async def test_a_session_that_serves_no_robot_verbs_is_no_fault(router: str) -> None:
    """A program with a session of its own, which is no robot agent, is listed without a question mark; a stop says
    that it is there."""
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as agent:
        await agent.call("ros", 7, "ping")
        row, *_ = await macs("ls", "--json", "-e", router)
        assert (row["status"], row["problem"]) == (None, "")
        code, out, _ = await ended("stop", "7", "--timeout", "1", "-e", router)
        assert (code, out) == (1, "robot 7 is NOT stopped: it is online, and has no emergency stop\n")


async def test_numbers_that_are_none_end_no_verb(router: str) -> None:
    """What robots say of themselves, and what somebody answers in the place of a router, costs nobody his tools."""
    faults = ['{"bad_cdr": 1%s}' % ("0" * 400), '{"bad_cdr": NaN}', '{"\\ud800": 1}', '{"bad_cdr": 1e999}']

    async def pretend(key: str, payload: bytes) -> bytes:
        return b'{"zid": [], "sessions": ' + b"[" * 100_000

    async with AsyncExitStack() as stack:
        for number, said in enumerate(faults, 1):
            status = f'{{"ros_node": "/r", "stopped": false, "stop": {{}}, "nodes": [], "drops": {said}}}'

            async def tell(_call: macs_zenoh.Call, status: bytes = status.encode()) -> bytes:
                return status

            agent = await stack.enter_async_context(macs_zenoh.join("ros", id=number, settings=patient(router)))
            agent.serve("status", tell)
            await agent.call("ros", number, "status")
        agent.mesh.serve("@/abcdef/router", pretend)
        for words in (
            ("ls", "-v"),
            ("ls", "-v", "--json"),
            ("top", "--once"),
            ("top", "--once", "--view", "lost"),
            ("top", "--json"),
            ("doctor", "--quick"),
            ("doctor", "--quick", "--json"),
        ):
            code, out, errors = await ended(*words, "-e", router)
            assert "Traceback" not in errors, (words, errors)
            assert code == 0 or words[0] == "doctor", (words, errors)
            if "--json" in words:
                told = json.loads(out, parse_constant=pytest.fail)
            if words == ("ls", "-v", "--json"):
                assert [row["id"] for row in told if row["type"] == "ros"] == [1, 2, 3, 4]


async def test_an_answer_that_makes_no_sense_is_told(router: str) -> None:
    """Whatever a robot answers, the list is complete, and nothing in it moves the cursor of a terminal."""
    answers = [b"", b"[]", b"{}", b"\xff", b'{"ros_node": 1}', b"[" * 100_000]
    good = {"ros_node": "\x1b[2Jboo", "stopped": True, "stop": {"by": "\x1b]0;x\x07"}, "nodes": []}
    answers.append(json.dumps(good).encode())
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as agent:
        answer = b""

        async def tell(_call: macs_zenoh.Call) -> bytes:
            return answer

        agent.serve("status", tell)
        await agent.call("ros", 7, "status")
        for answer in answers:  # noqa: B007 - `tell` reads it
            code, out, _ = await ended("ls", "-e", router)
            assert code == 0
            assert out.partition("\n\n")[0].splitlines()[1].split()[:2] == ["ros", "7"]
            assert out.replace("\n", "").isprintable()
