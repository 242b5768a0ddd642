"""Agents that come back over another connection as the same: an extension, which a router need not have."""

from __future__ import annotations

from bridge.headset import frames

from ..agents import Agent, Received
from ..checks import Level, NotTried
from .leaving import hears
from .scene import GONE, Scene, Trials, expect, expect_copies

TRIALS = Trials()

OPENED, RESUMED = "SessionOpened", "SessionResumed"
NONE = "a"
"""A secret of nobody's, so many times."""


async def _configured(scene: Scene, session: str | None, received: int = 0) -> tuple[Agent, Received | None]:
    """A headset that says this of sessions, and what it is told first. Raises NotTried: nothing of sessions."""
    agent = await scene.connect()
    await agent.send(frames.configuration(agent.id, 0, agent.request, 1, None, session, received))
    if session is None:
        await scene.settled(agent)
        return agent, None
    await agent.send(frames.online_request(agent.id, 1))
    told = await agent.wait(
        lambda message: message.manager in (OPENED, RESUMED) or "unityAgentIds" in message.json(),
        "what has become of its session, or who is online",
    )
    if told.manager not in (OPENED, RESUMED):
        raise NotTried("it knows no sessions")
    return agent, told


async def _opened(scene: Scene) -> tuple[Agent, str]:
    """A headset that comes back, and its secret; one frame of it counts."""
    agent, told = await _configured(scene, "")
    assert told is not None
    secret = told.json().get("session")
    expect(isinstance(secret, str) and len(secret) >= 16, f"its secret is {secret!r}")
    return agent, str(secret)


async def _back(scene: Scene, secret: str, received: int = 0) -> tuple[Agent, dict[str, object]]:
    """It has come back; what it is told. Raises NotHeld: it is another one."""
    agent, told = await _configured(scene, secret, received)
    assert told is not None
    expect(told.manager == RESUMED, f"it is told {told.manager} after it has shown its secret")
    resumed = told.json()
    expect(type(resumed.get("agentId")) is int, f"its id is {resumed.get('agentId')!r}")
    agent.id = int(resumed["agentId"])
    return agent, resumed


@TRIALS.add("sessions.opened", "Who says that it comes back is told a secret, first of all.", Level.STRICT)
async def _is_opened(scene: Scene) -> None:
    await _opened(scene)


@TRIALS.add("sessions.not_asked", "Who says nothing of sessions is told nothing of them.", Level.STRICT)
async def _not_asked(scene: Scene) -> None:
    await _opened(scene)
    agent, other = await scene.headset(), await scene.headset()
    seen = await scene.puts(other, agent, b"")
    expect(not any(message.manager in (OPENED, RESUMED) for message in seen), "it is told of a session")


@TRIALS.add("sessions.same", "Who comes back with it has the same id, and others hear nothing of it.", Level.STRICT)
async def _same(scene: Scene) -> None:
    agent, secret = await _opened(scene)
    other = await scene.headset()
    agent.reset()
    again, _ = await _back(scene, secret)
    expect(again.id == agent.id, f"it was {agent.id} and is {again.id}")
    last = scene.word()
    await again.send(again.frame("unicast", peer=other.id, text=last))
    before: list[Received] = []

    def is_last(message: Received) -> bool:
        before.append(message)
        return last.encode() in message.data

    await other.wait(is_last, "its next message")
    gone = [message.json().get("agents") for message in before if message.manager == GONE]
    expect(
        not any({"agent_type": 2, "agent_id": agent.id} in (each or []) for each in gone), "others hear that it left"
    )


@TRIALS.add("sessions.missed", "What was said to it meanwhile arrives, once.", Level.STRICT)
async def _missed(scene: Scene) -> None:
    agent, secret = await _opened(scene)
    other = await scene.headset()
    agent.reset()
    word = scene.word()
    await other.send(other.frame("unicast", peer=agent.id, text=word))
    await scene.online(other)
    again, _ = await _back(scene, secret, received=1)  # who was online
    expect_copies(await scene.fence(other, again, word), 1)


@TRIALS.add("sessions.again", "What it has received is not sent again, and what it has not is.", Level.STRICT)
async def _again(scene: Scene) -> None:
    agent, secret = await _opened(scene)
    before = agent.looked_at
    other = await scene.headset()
    one, two = scene.word(), scene.word()
    for word in (one, two):
        await other.send(other.frame("unicast", peer=agent.id, text=word))
    await agent.wait(lambda message: one.encode() in message.data, "a message to it")
    received = agent.looked_at - before  # with news of who has left, of which there may be some
    await agent.wait(lambda message: two.encode() in message.data, "the next message to it")
    agent.reset()
    again, _ = await _back(scene, secret, received)
    last = scene.word()
    await other.send(other.frame("unicast", peer=again.id, text=last))
    seen: list[Received] = []

    def is_last(message: Received) -> bool:
        seen.append(message)
        return last.encode() in message.data

    await again.wait(is_last, "a message to it")
    expect_copies([message for message in seen if one.encode() in message.data], 0)
    expect_copies([message for message in seen if two.encode() in message.data], 1)


@TRIALS.add("sessions.frames", "It is told how many of its frames have come.", Level.STRICT)
async def _frames(scene: Scene) -> None:
    agent, secret = await _opened(scene)
    for _ in range(3):
        await scene.online(agent)
    agent.reset()
    _, resumed = await _back(scene, secret)
    expect(resumed.get("received") == 4, f"4 had come, and it says {resumed.get('received')!r}")


@TRIALS.add("sessions.wrong_secret", "Another secret makes a new agent, and costs the owner nothing.", Level.STRICT)
async def _wrong(scene: Scene) -> None:
    agent, secret = await _opened(scene)
    for wrong in (NONE * len(secret), secret[:-1], secret.swapcase()):
        other, told = await _configured(scene, wrong)
        assert told is not None
        expect(told.manager == OPENED, f"it is told {told.manager}")
        expect(other.id != agent.id, "it has the owner's id")
    await scene.online(agent)


@TRIALS.add("sessions.over", "Who has said that it leaves does not come back.", Level.STRICT)
async def _over(scene: Scene) -> None:
    agent, secret = await _opened(scene)
    other = await scene.headset()
    await agent.say("go_offline")
    await hears(other, 2, agent.id)
    _, told = await _configured(scene, secret)
    expect(told is not None and told.manager == OPENED, "it is the same agent")


@TRIALS.add("sessions.one_connection", "Where the one before seems to live, that ends.", Level.STRICT)
async def _one(scene: Scene) -> None:
    agent, secret = await _opened(scene)
    again, _ = await _back(scene, secret)
    expect(again.id == agent.id, f"it was {agent.id} and is {again.id}")
    await agent.until_ended()
