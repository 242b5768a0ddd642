"""The emergency stop has a session of its own: nothing that is put to the robot is in front of it."""

from __future__ import annotations

import json
import threading
from typing import Any

import pytest
import zenoh

from bridge.ros import stop_line
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from macs_zenoh import join
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, Refused
from macs_zenoh.handles import Handle
from macs_zenoh.locked_out import apart
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.guard import Guard
from macs_zenoh.protocol.messages import Metadata
from tests.support.links import counted
from tests.support.routers import Router
from tests.support.thieves import notice_soon, stolen, zenoh_id
from tests.support.waiting import until

ROBOT = 7


def settings(router: Router, *overrides: str) -> Settings:
    mesh = MeshSettings(connect=[router.endpoint], overrides=list(overrides))
    return Settings(mesh=mesh, robot=RobotSettings(id=ROBOT))


async def test_a_stop_takes_effect_while_the_robot_receives_something_else(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that receives for the robot is stuck with a sample of somebody's: a stop is carried out and answered
    all the same, and so is the next one."""
    free, stuck = threading.Event(), threading.Event()
    admits = Guard.admits

    def slow(guard: Guard, key: str, *args: Any) -> bool:
        if key.endswith("unity/666") and "/to/" in key:
            stuck.set()
            free.wait(30)
        return admits(guard, key, *args)

    monkeypatch.setattr(Guard, "admits", slow)
    async with Router() as router:
        mesh = MeshSettings(connect=[router.endpoint])
        async with (
            open_robot(settings(router), domain_id=domain) as robot,
            join("operator", id=5, settings=mesh) as operator,
            join("unity", id=666, settings=mesh) as flooder,
        ):
            await until(lambda: robot.stop_line is not None and robot.stop_line.is_open)
            await until(lambda: all((1, ROBOT) in agent.directory for agent in (operator, flooder)))
            await operator.call("ros", ROBOT, "status")  # the routes are known
            try:
                flooder.send(b"", to="ros", ids=[ROBOT])
                await until(stuck.is_set)
                for stop in (True, False, True):
                    answer = await operator.call("ros", ROBOT, "stop", json.dumps(stop).encode())
                    assert json.loads(answer)["stopped"] is stop
                    assert robot.nodes.robot.stop.stopped is stop
            finally:
                free.set()


@pytest.mark.parametrize("override", [[], ['id:"abc123"']], ids=["any id", "an id of its own"])
async def test_the_stop_is_served_before_and_after_its_session(domain: int, override: list[str]) -> None:
    """Also where the settings give the robot a Zenoh id, which only one session can have; and where that session is
    gone, the robot's own serves the stop."""
    async with (
        Router() as router,
        open_robot(settings(router, *override), domain_id=domain) as robot,
        join("operator", id=5, settings=MeshSettings(connect=[router.endpoint])) as operator,
    ):
        await until(lambda: (1, ROBOT) in operator.directory)
        await operator.call("ros", ROBOT, "stop", b"true")
        line = robot.stop_line
        assert line is not None
        await until(lambda: line.is_open)
        await operator.call("ros", ROBOT, "stop", b"false")
        assert not robot.nodes.robot.stop.stopped
        about = Metadata(node_name="nd__another")
        with pytest.raises(Refused, match="is not the emergency stop of this robot, which is /emergency_stop"):
            await operator.call("ros", ROBOT, "stop", b"true", metadata=about)
        assert not robot.nodes.robot.stop.stopped
        await line.close()
        await operator.call("ros", ROBOT, "stop", b"true")
        assert robot.nodes.robot.stop.stopped


async def test_no_emergency_stop_needs_no_session(domain: int) -> None:
    """A robot without one has one session."""
    async with Router() as router:
        mesh = MeshSettings(connect=[router.endpoint])
        without = Settings(mesh=mesh, robot=RobotSettings(id=ROBOT, stop_topic=""))
        async with open_robot(without, domain_id=domain) as robot:
            assert robot.stop_line is None


def test_a_second_session_has_another_id() -> None:
    """Whether Zenoh's id is in the overrides, or in a file; where it is in neither, Zenoh chooses."""
    plain = MeshSettings(connect=["tcp/127.0.0.1:1"])
    assert apart(plain) is plain
    for chosen in (
        MeshSettings(connect=["tcp/127.0.0.1:1"], overrides=['id:"abc"', "scouting/delay:1"]),
        MeshSettings(config_file="zenoh.json5", overrides=["scouting/delay:1"]),
    ):
        one, other = apart(chosen).overrides, apart(chosen).overrides
        assert one != other
        assert [kept for kept in one if not kept.startswith("id:")] == ["scouting/delay:1"]


async def test_a_session_that_fails_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever goes wrong, of Zenoh's or of ours: it is tried again, and says once what is wrong."""
    monkeypatch.setattr(stop_line, "AGAIN_S", 0.01)
    failures: list[Exception] = [ConfigError("tls", "no certificate"), zenoh.ZError("closed"), RuntimeError("ours")]
    closed: list[bool] = []

    def serve(mesh: Mesh) -> Handle:
        if failures:
            raise failures.pop()
        return Handle(lambda: closed.append(True))

    async with Router() as router:
        line = stop_line.StopLine(MeshSettings(connect=[router.endpoint]), serve)
        await until(lambda: line.is_open)
        await line.close()
        assert closed == [True]
        assert not line.is_open


async def test_who_takes_its_id_gets_no_stop_of_it(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Routers let a thief in and not this session: it goes on under another id, and serves the stop again."""
    notice_soon(monkeypatch)
    sessions: list[Mesh] = []

    def serve(mesh: Mesh) -> Handle:
        sessions.append(mesh)
        return Handle(lambda: None)

    async with Router() as router, counted(router.endpoint) as link:
        line = stop_line.StopLine(MeshSettings(connect=[link.endpoint], overrides=['id:"abc"']), serve)
        await until(lambda: line.is_open)
        before = zenoh_id(sessions[0])
        async with stolen(sessions[0], link, router.endpoint):
            await until(lambda: len(sessions) == 2 and line.is_open, 60)
            assert zenoh_id(sessions[1]) != before
        await line.close()
