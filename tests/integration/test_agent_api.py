"""What a program with an agent of its own relies on: types, replies, handles, its end."""

from __future__ import annotations

import asyncio

import pytest

import macs_zenoh
from tests.support.local import patient
from tests.support.waiting import PATIENCE_S, until


async def test_what_says_who_is_there_says_where_to_send(router: str) -> None:
    """A type is taken as AgentInfo has it, a number, and as Message has it, a text; by send, call and join alike."""
    async with (
        macs_zenoh.join(1, id=7, settings=patient(router)) as robot,
        macs_zenoh.join("2", id=300, settings=patient(router)) as headset,
    ):
        assert (robot.type, headset.type) == ("ros", "unity")
        await until(lambda: len(headset.online()) == 2)
        info = next(agent for agent in headset.online() if agent.id == 7)
        assert str(info.key) == "ros/7"
        headset.send(b"by number", to=info.type, ids=[info.id])
        message = await asyncio.wait_for(robot.receive(), PATIENCE_S)
        assert message.data == b"by number"
        robot.send(b"by text", to=message.sender_type, ids=[message.sender_id])
        assert (await asyncio.wait_for(headset.receive(), PATIENCE_S)).data == b"by text"
        assert await headset.call(info.type, info.id, "ping", b"x") == b"x"
        with pytest.raises(macs_zenoh.UsageError, match="unknown agent type '0'"):
            headset.send(b"", to=0, ids=[7])


async def test_a_reply_goes_to_who_asked_with_its_number(router: str) -> None:
    """What answers a message carries its request id, and goes to its sender alone."""
    async with (
        macs_zenoh.join("ros", id=7, settings=patient(router)) as robot,
        macs_zenoh.join("unity", id=300, settings=patient(router)) as headset,
        macs_zenoh.join("unity", id=301, settings=patient(router)) as other,
    ):
        await until(lambda: len(headset.online()) == len(robot.online()) == 3)
        headset.send(b"?", to="ros", ids=[7], metadata=macs_zenoh.Metadata(request_id=41))
        robot.reply(await asyncio.wait_for(robot.receive(), PATIENCE_S), b"!")
        robot.send(b"to you", to="unity", ids=[301])
        answer = await asyncio.wait_for(headset.receive(), PATIENCE_S)
        assert (answer.data, answer.metadata.request_id, answer.sender_id) == (b"!", 41, 7)
        assert (await asyncio.wait_for(other.receive(), PATIENCE_S)).data == b"to you"


@pytest.mark.parametrize("data", ["text", ["a list"], 7, None])
async def test_data_that_is_no_bytes_is_refused_by_name(router: str, data: object) -> None:
    """Every way to send says that data is bytes, and what to do with text."""
    async with macs_zenoh.join("unity", id=300, settings=patient(router)) as agent:
        said = r"text\.encode" if isinstance(data, str) else rf"bytes, not {type(data).__name__}"
        with pytest.raises(macs_zenoh.UsageError, match=said):
            agent.send(data, to="ros", ids=[7])  # type: ignore[arg-type]
        with pytest.raises(macs_zenoh.UsageError, match=said):
            agent.broadcast(data)  # type: ignore[arg-type]
        with pytest.raises(macs_zenoh.UsageError, match=said):
            await agent.call("unity", 300, "ping", data)  # type: ignore[arg-type]


@pytest.mark.megabytes
async def test_a_drained_agent_has_sent_all(router: str) -> None:
    """After drain, all that was sent before is in Zenoh's hands, large as it may be: nothing waits here. Waited for
    after each piece, more goes through than may wait at one time."""
    pieces, size = 6, 11 << 20  # together more than the 64 MiB that may wait
    async with (
        macs_zenoh.join("ros", id=7, settings=patient(router)) as robot,
        macs_zenoh.join("unity", id=300, settings=patient(router)) as headset,
    ):
        await until(lambda: len(headset.online()) == len(robot.online()) == 2)
        for number in range(pieces):
            headset.send(bytes([number]) + bytes(size), to="ros", ids=[7])
            await headset.drain()
            assert not headset.mesh.backlogged
            assert (await asyncio.wait_for(robot.receive(), 60)).data[0] == number
        await headset.drain()  # nothing waits: at once
        assert not headset.mesh.drops["backlog"]


@pytest.mark.megabytes
async def test_drain_waits_for_what_was_sent_before(router: str) -> None:
    """While something large is under way, drain has not ended."""
    async with (
        macs_zenoh.join("ros", id=7, settings=patient(router)) as robot,
        macs_zenoh.join("unity", id=300, settings=patient(router)) as headset,
    ):
        await until(lambda: len(headset.online()) == len(robot.online()) == 2)
        headset.send(bytes(12 << 20), to="ros", ids=[7])
        headset.send(b"after it", to="ros", ids=[7])
        draining = asyncio.ensure_future(headset.drain())
        await asyncio.sleep(0)
        assert not draining.done()
        await asyncio.wait_for(draining, 60)
        assert len((await asyncio.wait_for(robot.receive(), 60)).data) == 12 << 20
        assert (await asyncio.wait_for(robot.receive(), PATIENCE_S)).data == b"after it"


async def test_every_callback_ends_with_its_handle(router: str) -> None:
    """on_presence, on_id, on_message and serve give a handle; closed, nothing is called any more."""
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as robot:
        first: list[int] = []
        second: list[int] = []
        ended = robot.on_presence(lambda agent, online: first.append(agent.id))
        robot.on_presence(lambda agent, online: second.append(agent.id))
        assert first == second == [7]
        ended.close()
        ended.close()  # twice is allowed
        assert not ended.is_open

        heard: list[bytes] = []
        async with macs_zenoh.join("unity", id=300, settings=patient(router)) as headset:
            await until(lambda: 300 in second)
            assert first == [7]

            async def look(call: macs_zenoh.Call) -> bytes:
                return b"seen"

            serving = robot.serve("look", look)
            assert await headset.call("ros", 7, "look") == b"seen"
            serving.close()
            with pytest.raises(macs_zenoh.Unreachable):
                await headset.call("ros", 7, "look", timeout_s=0.5)

            with robot.on_message(lambda message: heard.append(message.data)):
                headset.send(b"to the callback", to="ros", ids=[7])
                await until(lambda: heard == [b"to the callback"])
            headset.send(b"to receive", to="ros", ids=[7])
            assert (await asyncio.wait_for(robot.receive(), PATIENCE_S)).data == b"to receive"
        assert heard == [b"to the callback"]


async def test_another_handler_is_not_ended_by_the_first_ones_handle(router: str) -> None:
    """A handler that was replaced ends nothing but itself."""
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as robot:
        old = robot.on_message(lambda message: None)
        heard: list[bytes] = []
        robot.on_message(lambda message: heard.append(message.data))
        old.close()
        robot.send(b"to itself", to="ros", ids=[7])
        await until(lambda: heard == [b"to itself"])


async def test_a_callback_may_end_callbacks(router: str) -> None:
    """Who is told may end the others' handles and its own."""
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as robot:
        told: list[str] = []
        handles: list[macs_zenoh.Handle] = []

        def tell(agent: macs_zenoh.AgentInfo, online: bool) -> None:
            if agent.id == 300:
                told.append("first")
                for handle in handles:
                    handle.close()

        handles.append(robot.on_presence(tell))
        handles.append(robot.on_presence(lambda agent, online: told.append(f"second {agent.id}")))
        async with macs_zenoh.join("unity", id=300, settings=patient(router)):
            await until(lambda: "first" in told)
        assert told == ["second 7", "first"]


async def test_what_is_done_after_the_end_says_so(router: str) -> None:
    """After it has left, receive, send, call and serve say that the agent is closed, and iteration ends."""
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as robot:
        waiting = asyncio.ensure_future(robot.receive())
        await asyncio.sleep(0)

    async def look(call: macs_zenoh.Call) -> bytes:
        return b""

    for late in (waiting, robot.receive(), robot.call("ros", 8, "x"), robot.drain()):
        with pytest.raises(macs_zenoh.Closed, match=r"^ros/7 is closed$"):
            await late
    with pytest.raises(macs_zenoh.Closed):
        robot.broadcast(b"late")
    with pytest.raises(macs_zenoh.Closed):
        robot.serve("look", look)
    assert [message async for message in robot] == []


async def test_an_answer_that_does_not_come_is_a_timeout(router: str) -> None:
    """Who waits for a call as asyncio's users do catches it as a TimeoutError."""
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as robot:

        async def sleep(call: macs_zenoh.Call) -> bytes:
            await asyncio.sleep(60)
            return b""

        robot.serve("sleep", sleep)
        with pytest.raises(TimeoutError, match=r"ros/7 sleep .* no answer within 0\.3 s"):
            await robot.call("ros", 7, "sleep", timeout_s=0.3)


async def test_a_callback_that_fails_keeps_nobody_from_hearing(router: str) -> None:
    """Neither another one of who came, nor that one or another of who comes next."""
    heard: list[int] = []

    def failing(agent: macs_zenoh.AgentInfo, online: bool) -> None:
        if agent.id in (6, 7):
            raise RuntimeError("a fault of ours")

    async with macs_zenoh.join("unity", id=5, settings=patient(router)) as one:
        one.on_presence(failing)
        one.on_presence(lambda agent, online: heard.append(agent.id))
        async with (
            macs_zenoh.join("unity", id=6, settings=patient(router)),
            macs_zenoh.join("unity", id=7, settings=patient(router)),
        ):
            await until(lambda: {6, 7} <= set(heard))
