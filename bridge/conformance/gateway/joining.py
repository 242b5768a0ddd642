"""The handshake, questions about who is online, and signs of life."""

from __future__ import annotations

import asyncio
from typing import Any

from .. import vectors
from ..agents import Agent, Received
from ..checks import Level
from .scene import Scene, Trials, expect, expect_copies

TRIALS = Trials()

_KEYS = {
    "senderAgentType": (int, type(None)),
    "senderAgentId": (int, type(None)),
    "requestId": (int,),
    "messageManager": (str,),
    "nodeType": (int,),
    "nodeName": (str,),
    "dataExchangeType": (str,),
}


def expect_metadata(message: Received) -> None:
    """Raises NotHeld unless the metadata has the seven keys, each with a value of its type."""
    for key, kinds in _KEYS.items():
        expect(key in message.fields, f"{key} is missing in {message.metadata!r}")
        expect(type(message.fields[key]) in kinds, f"{key} has another type in {message.metadata!r}")


@TRIALS.add("handshake.first", "The first message on a connection is AgentConfigurer, at once.")
async def _first(scene: Scene) -> None:
    await scene.connect()


@TRIALS.add("handshake.agent_id", "It gives an id from 1 to 65535.")
async def _agent_id(scene: Scene) -> None:
    agent = await scene.connect()
    expect(1 <= agent.id <= 0xFFFF, f"the id is {agent.id}")


@TRIALS.add("handshake.request_id", "Its requestId fits 32 bits.")
async def _request_id(scene: Scene) -> None:
    agent = await scene.connect()
    expect(0 <= agent.request <= 0xFFFFFFFF, f"the requestId is {agent.request}")


async def _welcome(scene: Scene) -> Received:
    return await (await scene.connect(greeted=False)).first()


@TRIALS.add("handshake.metadata", "Its metadata has the seven keys, with values of their types.")
async def _metadata(scene: Scene) -> None:
    expect_metadata(await _welcome(scene))


@TRIALS.add("handshake.sender_null", "From the router itself the sender's type and id are null.")
async def _sender(scene: Scene) -> None:
    fields = (await _welcome(scene)).fields
    sender = [fields.get(key, "missing") for key in ("senderAgentType", "senderAgentId")]
    expect(sender == [None, None], f"they are {sender}")


@TRIALS.add("handshake.no_node", "It names no interface node: agents look at that first.")
async def _no_node(scene: Scene) -> None:
    name = (await _welcome(scene)).fields.get("nodeName")
    expect(name == "", f"nodeName is {name!r}")


@TRIALS.add("handshake.ids_differ", "Two connections have two ids.")
async def _ids_differ(scene: Scene) -> None:
    agents = [await scene.connect() for _ in range(5)]
    expect(len({agent.id for agent in agents}) == 5, f"the ids were {[agent.id for agent in agents]}")


@TRIALS.add("handshake.nothing_else_first", "Nothing comes before the configuration was answered, whoever else talks.")
async def _nothing_else(scene: Scene) -> None:
    other = await scene.headset()
    agent = await scene.connect()
    await other.say("broadcast", text=scene.word())
    await scene.online(other)
    early = [message for message in agent.messages if message.manager != "AgentConfigurer"]
    expect(not early, f"{[message.raw[:100] for message in early]} came")


@TRIALS.add("handshake.online", "Who has answered is online.")
async def _online(scene: Scene) -> None:
    await scene.headset()


@TRIALS.add("handshake.not_online", "Who has not answered is not online.")
async def _not_online(scene: Scene) -> None:
    agent, other = await scene.connect(), await scene.headset()
    online = await scene.online(other)
    expect(agent.id not in online["unityAgentIds"] + online["rosAgentIds"], f"{agent.id} is")


def _spelling(name: str, about: str) -> None:
    @TRIALS.add(f"handshake.{name}", about)
    async def _answers(scene: Scene) -> None:
        await scene.headset(scene.group, name)


for _vector in vectors.read("headset_frames"):
    if _vector.name.startswith("configuration_"):
        _spelling(_vector.name, f"A configuration is understood: {_vector.about[0].lower()}{_vector.about[1:]}")


@TRIALS.add("handshake.bytewise", "A configuration that comes byte by byte is understood.")
async def _bytewise(scene: Scene) -> None:
    agent = await scene.connect()
    frame = agent.frame("configuration")
    await agent.send(frame, range(1, len(frame)))
    await scene.settled(agent)


@TRIALS.add("handshake.with_more_behind", "A configuration and what follows it may come at once.")
async def _with_more(scene: Scene) -> None:
    other = await scene.headset()
    agent = await scene.connect()
    word = scene.word()
    await agent.send(agent.frame("configuration") + agent.frame("unicast", peer=other.id, text=word))
    await other.wait(lambda message: word.encode() in message.data, "the message behind the configuration")


@TRIALS.add("handshake.early_message", "A message that comes before the configuration is passed on.")
async def _early(scene: Scene) -> None:
    other, agent = await scene.headset(), await scene.connect()
    word = scene.word()
    await agent.say("unicast", peer=other.id, text=word)
    await agent.say("configuration")
    await other.wait(lambda message: word.encode() in message.data, "the early message")


@TRIALS.add("handshake.two_answers", "Of two configurations the first may carry another connection's number.")
async def _two_answers(scene: Scene) -> None:
    other, agent = await scene.connect(), await scene.connect()
    await agent.say("configuration", request=other.request)
    await agent.say("configuration")
    await scene.settled(agent)


@TRIALS.add("handshake.later_group", "A second configuration changes the group.", Level.STRICT)
async def _later_group(scene: Scene) -> None:
    sender, agent = await scene.headset(), await scene.headset(scene.group)
    agent.group = scene.group + 1
    await agent.say("configuration")
    deadline = asyncio.get_running_loop().time() + scene.patience_s
    while not await scene.sends(sender, agent, "group"):  # others may learn of it a little later
        expect(asyncio.get_running_loop().time() < deadline, "nothing that goes to the new group comes")
        await asyncio.sleep(0.05)
    expect_copies(await scene.sends(sender, agent, "group", group=scene.group), 0)


@TRIALS.add(
    "handshake.own_id", "An agent has the id that it was given, whatever its configuration says.", Level.STRICT
)
async def _own_id(scene: Scene) -> None:
    sender, agent = await scene.headset(), await scene.connect()
    await agent.say("configuration", id=sender.id)
    await scene.settled(agent)
    expect_copies(await scene.sends(sender, agent, "unicast"), 1)


# -- who is online ---------------------------------------------------------------------------------------------------


async def _answer(scene: Scene, request: str = "online_request", **values: int) -> tuple[Agent, Received]:
    agent = await scene.headset()
    await agent.say(request, **{"number": 77, **values})
    return agent, await agent.wait(lambda message: "unityAgentIds" in message.json(), "who is online")


@TRIALS.add("online.number", "The answer has the question's requestId.")
async def _number(scene: Scene) -> None:
    _, answer = await _answer(scene, number=4711)
    expect(answer.fields.get("requestId") == 4711, f"it is {answer.fields.get('requestId')}")


@TRIALS.add("online.number_zero", "Request id 0 is answered as any other.")
async def _number_zero(scene: Scene) -> None:
    _, answer = await _answer(scene, "online_request_zero")
    expect(answer.fields.get("requestId") == 0, f"it is {answer.fields.get('requestId')}")


@TRIALS.add("online.number_largest", "So is the largest one, 4294967295.")
async def _number_largest(scene: Scene) -> None:
    _, answer = await _answer(scene, "online_request_largest")
    expect(answer.fields.get("requestId") == 0xFFFFFFFF, f"it is {answer.fields.get('requestId')}")


@TRIALS.add("online.plain", "The answer names no manager and no node: else a headset does not take it for one.")
async def _plain(scene: Scene) -> None:
    _, answer = await _answer(scene)
    named: list[Any] = [answer.fields.get(key) for key in ("messageManager", "nodeName")]
    expect(named == ["", ""], f"it names {named}")


@TRIALS.add("online.metadata", "Its metadata has the seven keys, with values of their types.")
async def _online_metadata(scene: Scene) -> None:
    expect_metadata((await _answer(scene))[1])


@TRIALS.add("online.sender_null", "Its sender is null.")
async def _online_sender(scene: Scene) -> None:
    fields = (await _answer(scene))[1].fields
    sender = [fields.get(key, "missing") for key in ("senderAgentType", "senderAgentId")]
    expect(sender == [None, None], f"it is {sender}")


@TRIALS.add("online.itself", "The asker is among those who are online.")
async def _itself(scene: Scene) -> None:
    agent, answer = await _answer(scene)
    expect(agent.id in answer.json()["unityAgentIds"], f"{agent.id} is not in {answer.json()}")


@TRIALS.add("online.snake_case", "The question is understood in snake_case.")
async def _online_snake(scene: Scene) -> None:
    await _answer(scene, "online_request_snake")


@TRIALS.add("online.upper_camel_case", "And in UpperCamelCase.")
async def _online_upper(scene: Scene) -> None:
    await _answer(scene, "online_request_upper")


@TRIALS.add("online.stale_id", "Who asks with an id of an earlier connection is answered.", Level.STRICT)
async def _stale(scene: Scene) -> None:
    await _answer(scene, "online_request_stale_id")


@TRIALS.add("online.ascending", "The ids ascend, so that two answers can be compared.", Level.STRICT)
async def _ascending(scene: Scene) -> None:
    for _ in range(3):
        await scene.headset()
    found = (await _answer(scene))[1].json()
    for ids in (found["rosAgentIds"], found["unityAgentIds"]):
        expect(ids == sorted(ids), f"they are {ids}")


# -- signs of life ---------------------------------------------------------------------------------------------------


def _heartbeat(name: str, vector: str, about: str) -> None:
    @TRIALS.add(name, about)
    async def _goes_on(scene: Scene) -> None:
        sender, receiver = await scene.headset(), await scene.headset()
        expect_copies(await scene.puts(sender, receiver, sender.frame(vector)), 0)
        await scene.settled(sender)


_heartbeat("heartbeat.quiet", "heartbeat", "A heartbeat goes to nobody, and its connection goes on.")
_heartbeat("heartbeat.snake_case", "heartbeat_snake", "So does one in snake_case.")
