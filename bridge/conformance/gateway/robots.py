"""What goes between headsets and robots: registrations, topics, commands, calls and services."""

from __future__ import annotations

from typing import Any

from ..agents import Agent, Received
from ..checks import Level
from .scene import Scene, Trials, expect, expect_copies

TRIALS = Trials()

_TOPIC, _COMMAND = "nd__conformance_text", "nd__conformance_command"


def _is_add(message: Received, node_type: int) -> bool:
    return message.manager == "InterfaceNodeAdder" and message.json().get("nodeType") == node_type


async def registered(
    scene: Scene, headset: Agent, robot: Agent, vector: str, node_type: int, **values: int
) -> Received:
    """What the robot is told when a headset registers. Raises NotHeld."""
    await headset.say(vector, **{"robot": robot.id, **values})
    return await robot.wait(lambda message: _is_add(message, node_type), f"the registration ({vector})")


async def _pair(scene: Scene) -> tuple[Agent, Agent]:
    robot = await scene.robot()
    return await scene.headset(), robot


@TRIALS.add("robots.online", "A robot is among the robots who are online, and not among headsets.")
async def _online(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    online = await scene.online(headset)
    expect(robot.id in online["rosAgentIds"], f"{robot.id} is not in {online}")


@TRIALS.add("robots.heartbeat", "A robot's heartbeat, whose sender's id is null, keeps its connection.")
async def _heartbeat(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await robot.say("heartbeat")
    await registered(scene, headset, robot, "register_topic", 1)


def _registration(name: str, vector: str, node_type: int) -> None:
    @TRIALS.add(f"registering.{name}", f"A robot is told who registers on a node of type {node_type}.")
    async def _is_told(scene: Scene) -> None:
        headset, robot = await _pair(scene)
        told = (await registered(scene, headset, robot, vector, node_type)).json()
        registrant = told.get("registrantAgentType"), told.get("registrantAgentId")
        expect(registrant == (2, headset.id), f"the registrant is {registrant}, true is (2, {headset.id})")


_registration("topic", "register_topic", 1)
_registration("command", "register_command", 2)
_registration("call", "register_call", 3)
_registration("service", "register_service", 4)


@TRIALS.add("registering.keys", "That message has every key that the existing robot reads.")
async def _keys(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    told = (await registered(scene, headset, robot, "register_topic", 1)).json()
    wanted: dict[str, Any] = {
        "registrantAgentType": 2,
        "nodeType": 1,
        "nodeName": _TOPIC,
        "tosName": "/conformance/text",
        "dataExchangeType": "std_msgs/String",
        "bufferSize": 10,
        "dropNew": False,
        "isLatched": False,
    }
    other = {key: told.get(key) for key, value in wanted.items() if told.get(key) != value}
    expect(not other, f"it says {other}")


@TRIALS.add("registering.early", "A registration that comes before the configuration reaches the robot.")
async def _early(scene: Scene) -> None:
    robot, headset = await scene.robot(), await scene.connect()
    await headset.say("register_topic", robot=robot.id)
    await headset.say("configuration")
    await robot.wait(lambda message: _is_add(message, 1), "the early registration")


@TRIALS.add("registering.removed", "A robot is told who takes itself off a node.")
async def _removed(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await registered(scene, headset, robot, "register_topic", 1)
    await headset.say("deregister_topic", robot=robot.id)
    await robot.wait(lambda message: message.manager == "InterfaceNodeRemover", "the removal")


@TRIALS.add("registering.nobody", "A registration for nobody costs nothing: what follows reaches the robot.")
async def _nobody(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await headset.say("register_nobody")
    await registered(scene, headset, robot, "register_command", 2)


@TRIALS.add(
    "registering.stale_id", "A registrant of 0, as of nodes made before the handshake, is put right.", Level.STRICT
)
async def _stale(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    told = (await registered(scene, headset, robot, "register_stale_id", 1)).json()
    expect(told.get("registrantAgentId") == headset.id, f"it is {told.get('registrantAgentId')}")


@TRIALS.add("registering.group", "A registration for a group reaches the robots in it.", Level.STRICT)
async def _group(scene: Scene) -> None:
    robot = await scene.robot(scene.group)
    headset = await scene.headset()
    await registered(scene, headset, robot, "register_group", 1, group_of_robots=scene.group)


@TRIALS.add("registering.absent_robot", "A registration for a robot that is not there costs nothing.", Level.STRICT)
async def _absent(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await headset.say("register_topic", robot=65_020)
    await registered(scene, headset, robot, "register_command", 2)


@TRIALS.add("registering.twice", "What a headset registers twice the robot is told once.", Level.STRICT)
async def _twice(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await registered(scene, headset, robot, "register_topic", 1)
    await headset.say("register_topic", robot=robot.id)
    seen: list[Received] = []

    def is_second(message: Received) -> bool:
        seen.append(message)
        return _is_add(message, 2)

    await headset.say("register_command", robot=robot.id)
    await robot.wait(is_second, "the next registration")
    expect(not [message for message in seen if _is_add(message, 1)], "it is told again")


@TRIALS.add(
    "registering.one_serves", "A second registrant of a service of headsets is refused, and told.", Level.STRICT
)
async def _one_serves(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    second = await scene.headset()
    await registered(scene, headset, robot, "register_service", 4)
    await second.say("register_service", robot=robot.id)
    await second.wait(lambda message: message.manager == "InterfaceNodeRefused", "a refusal")


# -- from robots -----------------------------------------------------------------------------------------------------


async def _streamed(scene: Scene, vector: str, copies: int, **values: int) -> None:
    headset, robot = await _pair(scene)
    await registered(scene, headset, robot, "register_topic", 1)
    frame = robot.frame(vector, **{"peer": headset.id, **values})
    await robot.send(frame)
    last = robot.frame("topic", peer=headset.id)
    await robot.send(last)
    arrived = [await headset.wait(_is_topic, "a topic's message") for _ in range(copies + 1)]
    expect_copies(arrived, copies + 1)


def _is_topic(message: Received) -> bool:
    return message.fields.get("nodeName") == _TOPIC


@TRIALS.add("topics.to_one", "A topic's message comes to the headset in its list.")
async def _to_one(scene: Scene) -> None:
    await _streamed(scene, "topic", 1)


@TRIALS.add("topics.to_many", "The list may be longer than a header has slots, with ids that nobody has.")
async def _to_many(scene: Scene) -> None:
    await _streamed(scene, "topic_for_many", 1)


@TRIALS.add("topics.to_nobody", "It may be empty.")
async def _to_nobody(scene: Scene) -> None:
    await _streamed(scene, "topic_for_nobody", 0)


@TRIALS.add("topics.bytes", "Its data arrives as it was sent, from a sender of type 1.")
async def _bytes(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await registered(scene, headset, robot, "register_topic", 1)
    frame = robot.frame("topic", peer=headset.id)
    await robot.send(frame)
    arrived = await headset.wait(_is_topic, "a topic's message")
    expect(frame.endswith(arrived.data) and len(arrived.data) == 14, f"its data is {arrived.data!r}")
    expect(arrived.fields.get("senderAgentType") == 1, f"its sender's type is {arrived.fields.get('senderAgentType')}")


@TRIALS.add("topics.header_ignored", "With management data the destinations in the header are ignored.")
async def _header(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    bystander = await scene.headset()
    await registered(scene, headset, robot, "register_topic", 1)
    await registered(scene, bystander, robot, "register_topic", 1)
    await robot.say("topic_named", peer=headset.id, bystander=bystander.id)
    await robot.say("topic", peer=headset.id)
    for _ in range(2):
        await headset.wait(_is_topic, "a topic's message")
    expect_copies([message for message in bystander.messages if _is_topic(message)], 0)


@TRIALS.add("services.request", "A robot's request comes to the headset that serves, and its answer to the robot.")
async def _request(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await registered(scene, headset, robot, "register_service", 4)
    await robot.say("request", peer=headset.id, number=12)
    request = await headset.wait(lambda message: message.fields.get("nodeType") == 4, "the request")
    expect(request.fields.get("requestId") == 12, f"its number is {request.fields.get('requestId')}")
    await headset.say("response", robot=robot.id, number=12)
    answer = await robot.wait(lambda message: message.fields.get("nodeType") == 4, "the answer")
    expect(answer.fields.get("requestId") == 12, f"the answer's number is {answer.fields.get('requestId')}")


# -- to robots -------------------------------------------------------------------------------------------------------


@TRIALS.add("commands.arrive", "A command comes to the robot, with its sender.")
async def _command(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await registered(scene, headset, robot, "register_command", 2)
    frame = headset.frame("command", robot=robot.id)
    await headset.send(frame)
    arrived = await robot.wait(lambda message: message.fields.get("nodeName") == _COMMAND, "the command")
    expect(frame.endswith(arrived.data) and arrived.data, f"its data is {arrived.data!r}")
    expect(arrived.fields.get("senderAgentId") == headset.id, f"its sender is {arrived.fields.get('senderAgentId')}")


@TRIALS.add("commands.of_anybody", "So does one of a headset that never registered, where another one has.")
async def _of_anybody(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    other = await scene.headset()
    await registered(scene, headset, robot, "register_command", 2)
    await other.say("command", robot=robot.id)
    await robot.wait(lambda message: message.fields.get("senderAgentId") == other.id, "the command")


@TRIALS.add("calls.answered", "A call comes to the robot, and its answer to the headset, under one number.")
async def _call(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await registered(scene, headset, robot, "register_call", 3)
    for number in (0, 7):
        await headset.say("call", robot=robot.id, number=number)
        call = await robot.wait(lambda message: message.fields.get("nodeType") == 3, "the call")
        expect(call.fields.get("requestId") == number, f"its number is {call.fields.get('requestId')}")
        await robot.say("answer", peer=headset.id, number=number)
        answer = await headset.wait(lambda message: message.fields.get("nodeType") == 3, f"the answer {number}")
        expect(answer.fields.get("requestId") == number, f"the answer's number is {answer.fields.get('requestId')}")


@TRIALS.add("calls.of_anybody", "So does one of a headset that never registered, where another one has.")
async def _call_of_anybody(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    other = await scene.headset()
    await registered(scene, headset, robot, "register_call", 3)
    await other.say("call", robot=robot.id, number=3)
    await robot.wait(lambda message: message.fields.get("senderAgentId") == other.id, "the call")


@TRIALS.add(
    "robots.other_node_type", "Data under a registered node's name with another type never comes.", Level.STRICT
)
async def _other_type(scene: Scene) -> None:
    headset, robot = await _pair(scene)
    await registered(scene, headset, robot, "register_topic", 1)
    await registered(scene, headset, robot, "register_call", 3)
    wrong = robot.frame("answer", peer=headset.id, number=9).replace(b"nd__conformance_set", _TOPIC.encode())
    frame = bytearray(wrong)
    frame[35:39] = (len(wrong) - 39).to_bytes(4, "little")
    size = int.from_bytes(frame[39:43], "little") + len(_TOPIC) - len("nd__conformance_set")
    frame[39:43] = size.to_bytes(4, "little")
    await robot.send(bytes(frame))
    await robot.say("topic", peer=headset.id)
    first = await headset.wait(_is_topic, "a topic's message")
    expect(first.fields.get("nodeType") == 1, f"it came, with type {first.fields.get('nodeType')}")
