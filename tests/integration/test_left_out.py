"""Who was left out because others had made up too many claims is asked for when there is room again."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack

import pytest

import macs_zenoh
from bridge.gateway import Gateway
from bridge.gateway.leases import HOLDERS
from macs_zenoh import anew, awareness
from macs_zenoh.mesh import Mesh
from macs_zenoh.presence import Presence
from macs_zenoh.protocol.directory import AgentInfo, Change, Directory
from macs_zenoh.protocol.keyexpr import LEASE, NAME, WANTED
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.named import Names, Outcome
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.waiting import until


@pytest.fixture
async def stranger(router: str) -> AsyncIterator[Mesh]:
    """Who makes up sessions."""
    async with await Mesh.open(patient(router)) as mesh:
        yield mesh


def watched(mesh: Mesh, changes: list[Change]) -> Presence:
    return Presence(mesh, changes.extend, lambda contested: None)


async def test_a_robot_is_back_when_those_who_claimed_to_be_it_are_gone(router: str, stranger: Mesh) -> None:
    """Sixteen sessions claim to be a robot, the robot comes, they end: it is there, also in another group, and leaves
    when it leaves."""
    changes: list[Change] = []
    async with await Mesh.open(patient(router)) as mesh:
        presence = watched(mesh, changes)
        await presence.start()
        made_up = [AgentInfo(ROS, 7, 0, f"00{number:02x}") for number in range(Directory.PER_AGENT)]
        tokens = [stranger.declare_token(each.presence) for each in made_up]
        await until(lambda: len(presence.directory.claimants(ROS, 7)) == len(made_up))
        robot = AgentInfo(ROS, 7, 3, "ff")
        true = stranger.declare_token(robot.presence)
        await until(lambda: mesh.drops["too_many_claims"] == 1)
        assert presence.directory.get(ROS, 7) == made_up[0]
        for token in tokens:
            token.close()
        await until(lambda: presence.directory.get(ROS, 7) == robot)
        other = robot._replace(group=4)
        again = stranger.declare_token(other.presence)
        true.close()
        await until(lambda: presence.directory.get(ROS, 7) == other)
        again.close()
        await until(lambda: (ROS, 7) not in presence.directory)
        assert changes[-1] == Change(other, online=False)
        presence.close()


async def test_room_is_used_whenever_it_is_made(router: str, stranger: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who was left out is asked for at once, and again when he is left out and room is made once more before the last
    question, which waits for long."""
    monkeypatch.setattr(anew, "PAUSES_S", (0.02, 0.02, 0.02, 600.0))
    robot = AgentInfo(ROS, 7, 3, "ff")
    async with await Mesh.open(patient(router)) as mesh:
        presence = watched(mesh, [])
        await presence.start()
        true = stranger.declare_token(robot.presence)
        await until(lambda: presence.directory.get(ROS, 7) == robot)
        for time in (1, 2):
            before = mesh.drops["too_many_claims"]  # counted again in each answer that leaves somebody out
            tokens = [
                stranger.declare_token(AgentInfo(ROS, 7, 0, f"0{time}{number:02x}").presence)
                for number in range(Directory.PER_AGENT)
            ]
            await until(lambda: len(presence.directory.claimants(ROS, 7)) == Directory.PER_AGENT)
            await until(lambda before=before: mesh.drops["too_many_claims"] > before)
            for token in tokens:
                token.close()
            await until(lambda: presence.directory.get(ROS, 7) == robot)
            await until(lambda: presence._anew._next == len(anew.PAUSES_S) - 1)
        true.close()
        presence.close()


async def test_what_ends_while_it_is_asked_for_does_not_come_back(
    router: str, stranger: Mesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that was left out and leaves while an answer that has it is on its way is not there after that."""
    async with await Mesh.open(patient(router)) as mesh:
        presence = watched(mesh, [])
        await presence.start()
        asked = mesh.tokens
        tokens = [
            stranger.declare_token(AgentInfo(ROS, 7, 0, f"00{number:02x}").presence)
            for number in range(Directory.PER_AGENT)
        ]
        await until(lambda: len(presence.directory.claimants(ROS, 7)) == len(tokens))
        true = stranger.declare_token(AgentInfo(ROS, 7, 3, "ff").presence)
        await until(lambda: mesh.drops["too_many_claims"] == 1)
        ended = asyncio.Event()
        seen = presence._anew.ended

        def watched_end(key: str) -> None:  # not by another watcher: while its first news come, answers leave some out
            seen(key)
            if key.endswith("/ff"):
                ended.set()

        answers: list[list[str]] = []

        async def late(key: str) -> list[str]:
            answer = await asked(key)
            if any(key.endswith("/ff") for key in answer):
                answers.append(answer)
                true.close()
                await ended.wait()
            return answer

        monkeypatch.setattr(presence._anew, "ended", watched_end)
        monkeypatch.setattr(mesh, "tokens", late)
        monkeypatch.setattr(anew, "PAUSES_S", (0.02, 0.02))
        for token in tokens:
            token.close()
        await until(lambda: len(answers) == 1)
        await until(lambda: presence._anew._asking is None)
        assert (ROS, 7) not in presence.directory
        presence.close()


async def test_a_gateway_sees_who_else_holds_its_block(
    start_gateway: StartGateway, router: str, stranger: Mesh
) -> None:
    """Sixteen sessions lease a block, then one more, then they end: that it holds the block is known, and its end."""
    gateway: Gateway = await start_gateway(block=0)
    tokens = [stranger.declare_token(LEASE.of(block=9, zid=f"00{number:02x}")) for number in range(HOLDERS)]
    await until(lambda: gateway._leases.has_lease(f"00{HOLDERS - 1:02x}"))
    last = stranger.declare_token(LEASE.of(block=9, zid="ff"))
    await until(lambda: gateway.mesh.drops["too_many_claims"] == 1)
    assert not gateway._leases.has_lease("ff")
    for token in tokens:
        token.close()
    await until(lambda: gateway._leases.has_lease("ff"))
    assert not gateway._leases.has_lease("0000")
    last.close()
    await until(lambda: not gateway._leases.has_lease("ff"))


async def test_a_name_and_its_types_are_back_when_there_is_room(router: str, stranger: Mesh) -> None:
    """Names and types that were too many of one session are known when others of it have ended: who waits for one of
    them goes on."""
    async with AsyncExitStack() as stack:
        agent = await stack.enter_async_context(macs_zenoh.join("unity", connect=[router]))
        ground = await stack.enter_async_context(awareness.join(agent, "ground"))
        tokens = [stranger.declare_token(NAME.of(name=f"n{n}", type=1, id=7, zid="1")) for n in range(Names.NAMES)]
        tokens += [
            stranger.declare_token(WANTED.of(name=f"n{n // 100}", message_type=f"t{n}", zid="1"))
            for n in range(Names.TYPES)
        ]
        await until(lambda: sum(len(ground.names.types(f"n{n}")) for n in range(Names.NAMES)) == Names.TYPES)
        await until(lambda: len(ground.others()) == Names.NAMES)
        arm = [
            stranger.declare_token(NAME.of(name="arm", type=1, id=7, zid="1")),
            stranger.declare_token(WANTED.of(name="arm", message_type="std_msgs/String", zid="1")),
        ]
        await until(lambda: ground.counters["too_many_names"] == 2)
        assert ground.send("arm", "std_msgs/String", b"") is Outcome.NO_SUCH_AGENT
        for token in tokens:
            token.close()
        await ground.wait_for("arm", "std_msgs/String", timeout_s=60)
        assert ground.send("arm", "std_msgs/String", b"") is Outcome.SENT
        for token in arm:
            token.close()
        await until(lambda: not ground.names.types("arm") and not ground.others())
