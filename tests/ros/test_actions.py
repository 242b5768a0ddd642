"""Actions on a real action server: goal, feedback, result, cancel, and a result that waits."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.serialization import deserialize_message, serialize_message

from bridge.headset.actions import ABORTED, CANCELED, SUCCEEDED, ActionClient, Goal
from bridge.headset.frames import NodeSpec
from bridge.headset.nodes import Incoming
from bridge.ros.actions import ACCEPTED, EXECUTING
from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.errors import Refused, WireError
from macs_zenoh.protocol.messages import ActionVerb, Metadata, NodeType
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.wire import MACS, split_message
from tests.support.ros_peer import Peer, adding, known_action, pause
from tests.support.waiting import PATIENCE_S, until

COUNT = "macs_test_msgs/Count"


class Counter:
    """An action server: counts to ``to``, one per ``step_s``; refuses negative goals."""

    def __init__(self, peer: Peer, action: Any, name: str = "/count") -> None:
        self._action = action
        self._peer = peer
        self.server = ActionServer(
            peer.session.node,
            action,
            name,
            self._execute,
            goal_callback=lambda goal: GoalResponse.REJECT if goal.to < 0 else GoalResponse.ACCEPT,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    async def _execute(self, goal: Any) -> Any:
        """A coroutine, so that the server's one thread takes cancellations in between."""
        result = self._action.Result()
        for number in range(1, goal.request.to + 1):
            await pause(self._peer.session.node, goal.request.step_s)
            if goal.is_cancel_requested:
                goal.canceled()
                result.text = "canceled"
                return result
            goal.publish_feedback(self._action.Feedback(at=number))
            result.reached = number
        await pause(self._peer.session.node, 0.1)  # in ROS a result can overtake the feedback before it
        result.text = "done"
        goal.succeed()
        return result


class Headset:
    """A headset's action client, joined to robot 7's nodes without a wire between them."""

    def __init__(self, agent_id: int) -> None:
        self.id = agent_id
        self.nodes: InterfaceNodes
        self.online = True
        self.heard = 0
        self.client = ActionClient(self, NodeSpec(NodeType.ACTION, "/count", COUNT, 100))

    async def send_frame(self, frame: bytes) -> None:
        metadata, data = split_message(memoryview(frame)[MACS.header_bytes :])
        self.nodes.deliver(Message("unity", self.id, Metadata.decode(metadata), bytes(data)))

    async def tell(self, frame: Any) -> None: ...

    def forget(self, node: Any) -> None: ...

    def hear(self, metadata: Metadata, data: bytes) -> None:
        self.heard += 1
        if self.online:
            self.client.receive(Incoming(metadata, data))


@pytest.fixture
async def site(session: RosSession, peer: Peer, count_action: Any) -> AsyncIterator[SimpleNamespace]:
    """A counting robot, headsets 5 and 6 of group 3, and 9 of none."""
    headsets = {number: Headset(number) for number in (5, 6, 9)}
    rules = Rules(RobotSettings(call_timeout_s=30, rules=[TopicRule(match="/other", cancel_on_leave=True)]))
    robot = Robot(
        session,
        7,
        lambda node, frame: None,
        send=lambda to, metadata, data: headsets[to.id].hear(metadata, data),
        rules=rules,
        group_of=lambda agent: 0 if agent.id == 9 else 3,
    )
    nodes = InterfaceNodes(robot)
    for headset in headsets.values():
        headset.nodes = nodes
    counter = await peer.session.run(lambda: Counter(peer, count_action))
    await known_action(session, "/count")
    await nodes.add(adding("/count", COUNT, node_type=NodeType.ACTION))

    def goal(to: int, step_s: float = 0.01) -> bytes:
        return bytes(serialize_message(count_action.Goal(to=to, step_s=step_s)))

    yield SimpleNamespace(
        nodes=nodes,
        five=headsets[5],
        six=headsets[6],
        nine=headsets[9],
        action=count_action,
        goal=goal,
        peer=peer,
        counter=counter,
    )
    nodes.close()
    await peer.session.run(counter.server.destroy)


async def test_a_goal_gives_feedback_and_its_result(site: SimpleNamespace) -> None:
    """Every step is told, then the result with its status."""
    goal = await site.five.client.send_goal(7, site.goal(5))
    seen = [deserialize_message(feedback, site.action.Feedback).at async for feedback in goal]
    status, result = await goal.result(PATIENCE_S)
    assert seen == [1, 2, 3, 4, 5]
    assert status == SUCCEEDED
    assert deserialize_message(result, site.action.Result).text == "done"


async def test_goals_of_several_headsets_run_at_once(site: SimpleNamespace) -> None:
    """Each headset hears of its own goals and of nothing else."""
    goals: list[Goal] = await asyncio.gather(
        *(
            headset.client.send_goal(7, site.goal(to))
            for headset, to in ((site.five, 3), (site.six, 4), (site.five, 5))
        )
    )
    reached = [deserialize_message((await goal.result(PATIENCE_S)).data, site.action.Result).reached for goal in goals]
    assert reached == [3, 4, 5]


async def test_a_goal_is_canceled(site: SimpleNamespace) -> None:
    """The action agrees to stop, and the result says that it did."""
    goal = await site.five.client.send_goal(7, site.goal(1000))
    await goal.cancel()
    status, result = await goal.result(PATIENCE_S)
    assert status == CANCELED
    assert deserialize_message(result, site.action.Result).text == "canceled"


@pytest.mark.parametrize("bad", [b"", b"\x00\x01\x00\x00", b"\xff" * 20], ids=["empty", "short", "no CDR"])
async def test_what_is_no_goal_is_refused(site: SimpleNamespace, bad: bytes) -> None:
    """The reason names the type, and the next goal is taken."""
    with pytest.raises(Refused, match="the goal is no macs_test_msgs/action/Count"):
        await site.five.client.send_goal(7, bad)
    await site.five.client.send_goal(7, site.goal(1))


async def test_a_rejected_goal_is_refused(site: SimpleNamespace) -> None:
    """What the action does not accept, the headset hears."""
    with pytest.raises(Refused, match="/count rejected the goal"):
        await site.five.client.send_goal(7, site.goal(-1))


async def test_an_absent_action_is_told(site: SimpleNamespace) -> None:
    """A goal for an action that nobody runs is refused in time."""
    await site.nodes.add(adding("/nowhere", COUNT, node_type=NodeType.ACTION))
    client = ActionClient(site.five, NodeSpec(NodeType.ACTION, "/nowhere", COUNT))
    site.five.client, before = client, site.five.client
    with pytest.raises(Refused, match="there is no action /nowhere on this robot"):
        await client.send_goal(7, site.goal(1))
    site.five.client = before


async def test_a_result_survives_a_lost_connection(site: SimpleNamespace) -> None:
    """A headset that was away while the goal ended gets the result when it asks again; its node has waited."""
    goal = await site.five.client.send_goal(7, site.goal(5))
    site.five.online = False
    site.nodes.forget(Registrant(2, 5))
    node = site.nodes.get(NodeType.ACTION, "nd__count")
    await until(lambda: node.status().goals[0].finished)
    site.five.online = True
    await site.five.client.ask_again()
    assert (await goal.result(PATIENCE_S)).status == SUCCEEDED


async def test_a_successor_of_the_group_finds_the_goal(site: SimpleNamespace) -> None:
    """Another headset of the same group sees the goal, and has its feedback and result from then on."""
    goal = await site.five.client.send_goal(7, site.goal(1000, 0.005))
    site.nodes.forget(Registrant(2, 5))
    (known,) = await site.six.client.goals(7)
    assert known == {"goal": goal.id.hex(), "status": known["status"], "owner": "unity/5", "finished": False}
    assert await site.nine.client.goals(7) == []
    mine = await site.six.client.resume(7, bytes.fromhex(known["goal"]))
    async for feedback in mine:
        assert deserialize_message(feedback, site.action.Feedback).at > 0
        break
    await mine.cancel()
    assert (await mine.result(PATIENCE_S)).status == CANCELED


async def test_a_goal_is_not_the_next_ones_who_has_the_id(site: SimpleNamespace) -> None:
    """Who gets a freed id hears nothing of its predecessor's goal, neither feedback nor result nor its number; who has
    only been away goes on hearing of it."""
    goal = await site.nine.client.send_goal(7, site.goal(1000, 0.005))
    site.nodes.forget(Registrant(2, 9))
    site.nodes.returned(Registrant(2, 9))
    steps = aiter(goal)
    seen = [deserialize_message(await anext(steps), site.action.Feedback).at for _ in range(3)]
    site.nodes.forget(Registrant(2, 9))
    site.nodes.forget(Registrant(2, 9), for_good=True)  # another one came
    site.nodes.returned(Registrant(2, 9))
    heard = site.nine.heard
    assert site.nodes.get(NodeType.ACTION, "nd__count").status().goals[0].owner == ""
    assert await site.nine.client.goals(7) == []
    await asyncio.sleep(0.1)
    assert site.nine.heard == heard + 1, "more than the empty list"
    mine = await site.nine.client.resume(7, goal.id)  # with the goal's id it is found again
    assert deserialize_message(await anext(aiter(mine)), site.action.Feedback).at > seen[-1]
    await mine.cancel()


async def test_goals_end_with_their_headset_where_a_rule_says_so(site: SimpleNamespace) -> None:
    """With cancel_on_leave a headset's goals are canceled when it leaves, also one not yet accepted; others' go on."""
    counter = await site.peer.session.run(lambda: Counter(site.peer, site.action, "/other"))
    await known_action(site.nodes.robot.session, "/other")
    for registrant in (5, 6):
        await site.nodes.add(adding("/other", COUNT, node_type=NodeType.ACTION, registrant=registrant))
    spec = NodeSpec(NodeType.ACTION, "/other", COUNT)
    five, six = ActionClient(site.five, spec), ActionClient(site.six, spec)
    elsewhere = await site.five.client.send_goal(7, site.goal(1000))
    site.five.client, site.six.client = five, six
    ended, stays = await five.send_goal(7, site.goal(1000)), await six.send_goal(7, site.goal(1000))
    late = asyncio.create_task(five.send_goal(7, site.goal(1000)))
    node = site.nodes.get(NodeType.ACTION, "nd__other")
    await until(lambda: len(node.status().goals) == 3)
    site.nodes.forget(Registrant(2, 5))

    def states(of: Any) -> dict[str, int]:
        return {goal.goal: goal.status for goal in of.status().goals}

    await until(lambda: list(states(node).values()).count(CANCELED) == 2)
    assert states(node)[ended.id.hex()] == CANCELED
    assert states(node)[stays.id.hex()] in (ACCEPTED, EXECUTING)
    assert states(site.nodes.get(NodeType.ACTION, "nd__count"))[elsewhere.id.hex()] in (ACCEPTED, EXECUTING)
    await stays.cancel()
    assert (await stays.result(PATIENCE_S)).status == CANCELED
    late.cancel()
    await site.peer.session.run(counter.server.destroy)


async def test_another_type_is_refused(site: SimpleNamespace) -> None:
    """Who registers an action as what it is not, hears which type it has."""
    site.nodes.forget(Registrant(2, 5))
    with pytest.raises(Refused, match="/count has type macs_test_msgs/action/Count on this robot, not"):
        await site.nodes.add(adding("/count", "example_interfaces/Fibonacci", node_type=NodeType.ACTION))


async def test_an_unknown_goal_is_told(site: SimpleNamespace) -> None:
    """Who asks for a result that nobody has, hears so."""
    goal = await site.five.client.resume(7, bytes(16))
    with pytest.raises(Refused, match="there is no such goal"):
        await goal.result(PATIENCE_S)


async def test_results_are_not_kept_for_ever(site: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the configured time the result is gone, and without registrants the node too."""
    settings = site.nodes.robot.rules.settings
    site.nodes.robot.rules.settings = RobotSettings(call_timeout_s=settings.call_timeout_s, result_timeout_s=1)
    monkeypatch.setattr("bridge.ros.actions.WATCH_S", 0.05)
    goal = await site.five.client.send_goal(7, site.goal(1))
    await goal.result(PATIENCE_S)
    site.nodes.forget(Registrant(2, 5))
    await until(lambda: site.nodes.get(NodeType.ACTION, "nd__count") is None)


async def test_an_emergency_stop_cancels_goals(site: SimpleNamespace) -> None:
    """Goals that run are canceled, new ones refused, until it is released."""
    await site.nodes.open_stop("/emergency_stop")
    goal = await site.five.client.send_goal(7, site.goal(1000))
    site.nodes.stop.press("unity/5")
    assert (await goal.result(PATIENCE_S)).status == CANCELED
    with pytest.raises(Refused, match="the emergency stop by unity/5 holds"):
        await site.five.client.send_goal(7, site.goal(1))
    site.nodes.stop.release("unity/5")
    await site.five.client.send_goal(7, site.goal(1))


async def test_whoever_cancels_a_goal_that_ends_in_this_moment_is_answered(site: SimpleNamespace) -> None:
    """It has ended by the time the ROS thread comes to it."""
    goal = await site.five.client.send_goal(7, site.goal(1000))
    node, go_on = site.nodes.get(NodeType.ACTION, "nd__count"), threading.Event()
    site.nodes.robot.session.submit(go_on.wait)
    try:
        canceling = asyncio.create_task(goal.cancel(PATIENCE_S))
        await asyncio.sleep(0.05)
        node._finished(node._goals[goal.id], ABORTED, b"it has ended")
    finally:
        go_on.set()
    with pytest.raises(Refused, match="the goal has finished"):
        await canceling


async def test_a_cancellation_whose_answer_is_lost_is_asked_for_again(
    site: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that does not know our client for cancellations yet answers nobody; who cancels a goal, which may take
    its time to end, hears of it all the same."""
    monkeypatch.setattr("bridge.ros.actions.CANCEL_AGAIN_S", 0.1)
    lost = Answers(site.counter.server._handle)
    monkeypatch.setattr(site.counter.server, "_handle", lost)
    goal = await site.five.client.send_goal(7, site.goal(1, 3600.0))
    await goal.cancel()
    assert lost.count == 1


class Answers:
    """The inner part of an action server, of whose answers to cancellations the first is lost as ROS loses it."""

    def __init__(self, handle: Any) -> None:
        self._handle = handle
        self.count = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._handle, name)

    def send_cancel_response(self, *answer: Any) -> None:
        if self.count:
            self._handle.send_cancel_response(*answer)
        else:
            self.count = 1


async def test_a_short_stop_cancels_goals(site: SimpleNamespace) -> None:
    """Also when it is released before the loop comes to it; a goal that waits for its action is never given."""
    await site.nodes.open_stop("/emergency_stop")
    await site.nodes.add(adding("/late", COUNT, node_type=NodeType.ACTION))
    goal = await site.five.client.send_goal(7, site.goal(1000))
    site.six.client = ActionClient(site.six, NodeSpec(NodeType.ACTION, "/late", COUNT))
    late = asyncio.create_task(site.six.client.send_goal(7, site.goal(1000)))
    node = site.nodes.get(NodeType.ACTION, "nd__late")
    await until(lambda: node.status().goals)
    site.nodes.stop.press("unity/5")
    site.nodes.stop.release("unity/5")
    counter = await site.peer.session.run(lambda: Counter(site.peer, site.action, "/late"))
    assert (await goal.result(PATIENCE_S)).status == CANCELED
    with pytest.raises(Refused, match=r"stopped meanwhile|there is no action"):
        await late
    await site.peer.session.run(counter.server.destroy)


async def test_goals_end_with_the_mesh_where_a_rule_says_so(site: SimpleNamespace) -> None:
    """With cancel_on_leave the robot cancels them when it loses the mesh."""
    counter = await site.peer.session.run(lambda: Counter(site.peer, site.action, "/other"))
    await known_action(site.nodes.robot.session, "/other")
    await site.nodes.add(adding("/other", COUNT, node_type=NodeType.ACTION))
    elsewhere = await site.five.client.send_goal(7, site.goal(1000))
    site.five.client = ActionClient(site.five, NodeSpec(NodeType.ACTION, "/other", COUNT))
    goal = await site.five.client.send_goal(7, site.goal(1000))
    for node in site.nodes:
        node.cut_off()
    assert (await goal.result(PATIENCE_S)).status == CANCELED
    (state,) = site.nodes.get(NodeType.ACTION, "nd__count").status().goals
    assert (state.goal, state.finished) == (elsewhere.id.hex(), False)
    await site.peer.session.run(counter.server.destroy)


async def test_a_server_that_dies_aborts_its_goals(
    site: SimpleNamespace, count_action: Any, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When the action server is gone for a while, the headset hears that its goal has ended."""
    monkeypatch.setattr("bridge.ros.actions.WATCH_S", 0.05)
    monkeypatch.setattr("bridge.ros.actions.GONE_S", 0.3)
    goal = await site.five.client.send_goal(7, site.goal(1000, 0.05))
    node = site.nodes.get(NodeType.ACTION, "nd__count")
    monkeypatch.setattr(node._client, "is_ready", lambda: False)
    assert (await goal.result(PATIENCE_S)).status == ABORTED


@pytest.mark.parametrize("data", [b"", b"short", bytes(16), bytes(17)])
@pytest.mark.parametrize("verb", ["", "ActionGoal", "ActionCancel", "ActionResult", "ActionFeedback", "x" * 500])
async def test_a_bad_message_harms_nothing(site: SimpleNamespace, verb: str, data: bytes) -> None:
    """Whatever is said to the node, the next goal is taken."""
    metadata = Metadata(2, 5, 0, verb, NodeType.ACTION, "nd__count", COUNT)
    site.nodes.deliver(Message("unity", 5, metadata, data))
    goal = await site.five.client.send_goal(7, site.goal(1))
    assert (await goal.result(PATIENCE_S)).status == SUCCEEDED


async def test_the_headset_side_survives_bad_messages(site: SimpleNamespace) -> None:
    """A robot's message that is too short costs that message."""
    with pytest.raises(WireError, match="too short"):
        site.five.client.receive(Incoming(Metadata(1, 7, 0, ActionVerb.RESULT.value, 5, "nd__count"), b""))
