"""How others hear that an agent has left."""

from __future__ import annotations

from ..agents import Agent, Received
from ..checks import Level
from .scene import GONE, Scene, Trials, expect

TRIALS = Trials()


async def hears(agent: Agent, kind: int, gone: int) -> Received:
    """The message that tells an agent who has left. Raises NotHeld."""

    def tells(message: Received) -> bool:
        left = message.json().get("agents")
        return message.manager == GONE and isinstance(left, list) and {"agent_type": kind, "agent_id": gone} in left

    return await agent.wait(tells, f"that agent {gone} of type {kind} has left")


@TRIALS.add("leaving.go_offline", "Who says that it leaves is announced to headsets at once.")
async def _go_offline(scene: Scene) -> None:
    agent, other = await scene.headset(), await scene.headset()
    await agent.say("go_offline")
    await hears(other, 2, agent.id)


@TRIALS.add("leaving.robots_hear", "And to robots.")
async def _robots_hear(scene: Scene) -> None:
    agent, robot = await scene.headset(), await scene.robot()
    await agent.say("go_offline")
    await hears(robot, 2, agent.id)


@TRIALS.add("leaving.sender_null", "That message comes from the router: its sender is null.")
async def _sender(scene: Scene) -> None:
    agent, other = await scene.headset(), await scene.headset()
    await agent.say("go_offline")
    fields = (await hears(other, 2, agent.id)).fields
    sender = [fields.get(key, "missing") for key in ("senderAgentType", "senderAgentId")]
    expect(sender == [None, None], f"it is {sender}")


@TRIALS.add("leaving.not_online", "Who has left is not online any more.")
async def _not_online(scene: Scene) -> None:
    agent, other = await scene.headset(), await scene.headset()
    await agent.say("go_offline")
    await hears(other, 2, agent.id)
    expect(agent.id not in (await scene.online(other))["unityAgentIds"], f"{agent.id} is")


@TRIALS.add("leaving.connection_ends", "After it has said so its connection is closed.", Level.STRICT)
async def _connection_ends(scene: Scene) -> None:
    agent = await scene.headset()
    await agent.say("go_offline")
    await agent.until_ended()


@TRIALS.add("leaving.closed", "Who closes its connection is announced at once.", Level.STRICT)
async def _closed(scene: Scene) -> None:
    agent, other = await scene.headset(), await scene.headset()
    agent.finish()
    await hears(other, 2, agent.id)


@TRIALS.add("leaving.reset", "So is one whose connection is reset.", Level.STRICT)
async def _reset(scene: Scene) -> None:
    agent, other = await scene.headset(), await scene.headset()
    agent.reset()
    await hears(other, 2, agent.id)


@TRIALS.add("leaving.reset_in_a_frame", "So is one whose connection is reset in the middle of a frame.", Level.STRICT)
async def _reset_in_frame(scene: Scene) -> None:
    agent, other = await scene.headset(), await scene.headset()
    await agent.send(agent.frame("unicast", peer=other.id)[:60])
    agent.reset()
    await hears(other, 2, agent.id)


@TRIALS.add("leaving.robot", "A robot that leaves is announced as well.", Level.STRICT)
async def _robot(scene: Scene) -> None:
    robot, other = await scene.robot(), await scene.headset()
    robot.finish()
    await hears(other, 1, robot.id)


@TRIALS.add("leaving.comes_back", "Who comes back is greeted as anybody.")
async def _comes_back(scene: Scene) -> None:
    agent = await scene.headset()
    await agent.say("go_offline")
    await scene.headset()
