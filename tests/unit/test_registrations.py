"""A robot has the interface nodes that headsets want of it, whoever came first and whatever happened in between."""

from __future__ import annotations

from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.protocol.messages import AddNode, NodeType, RemoveNode
from macs_zenoh.protocol.registrations import AgentKey, Registrations, Task

NODES = ["nd__chatter", "nd__camera"]


def adding(headset: int, node: str, node_type: int = 1, buffer_size: int = 10) -> AddNode:
    """A headset registers on a node."""
    return AddNode(2, headset, node_type, node, "/" + node[4:], "std_msgs/String", buffer_size=buffer_size)


def removing(headset: int, node: str, node_type: int = 1) -> RemoveNode:
    """A headset leaves a node."""
    return RemoveNode(2, headset, node_type, node)


Key = tuple[AgentKey, int, str]


def key_of(node: AddNode | RemoveNode) -> Key:
    """Registrant, node type and node name."""
    return (node.registrant_agent_type, node.registrant_agent_id), node.node_type, node.node_name


class Story:
    """Registrations, the robots that do what they are told, and what headsets want of whom."""

    def __init__(self) -> None:
        self.registrations = Registrations()
        self.robots: dict[int, int] = {}
        self.seen: dict[int, int] = {}
        self.have: dict[int, set[Key]] = {}
        self.wanted: dict[Key, tuple[set[int], set[int]]] = {}

    def tell(self, tasks: list[Task]) -> None:
        """Robots do what they are told."""
        assert len({(task.robot_id, key_of(task.node)) for task in tasks}) == len(tasks), "told twice"
        for robot_id, node in tasks:
            assert robot_id in self.robots, "told while it is away"
            if isinstance(node, AddNode):
                assert self.registrations.holds(Task(robot_id, node), self.robots)
                self.have[robot_id].add(key_of(node))
            else:
                assert not self.registrations.holds(Task(robot_id, node), self.robots)
                self.have[robot_id].discard(key_of(node))

    def register(self, headset: int, node: str, node_type: int, ids: set[int], groups: set[int]) -> None:
        """A headset asks for a node."""
        wish = adding(headset, node, node_type)
        robot_ids, robot_groups = self.wanted.setdefault(key_of(wish), (set(), set()))
        robot_ids |= ids
        robot_groups |= groups
        self.tell(self.registrations.add(wish, ids, groups, self.robots))

    def deregister(self, headset: int, node: str, node_type: int, ids: set[int], groups: set[int]) -> None:
        """A headset takes a node back."""
        wish = removing(headset, node, node_type)
        robot_ids, robot_groups = self.wanted.get(key_of(wish), (set(), set()))
        robot_ids -= ids
        robot_groups -= groups
        self.tell(self.registrations.remove(wish, ids, groups, self.robots))

    def leave(self, headset: int) -> None:
        """A headset is gone; robots notice by themselves."""
        self.registrations.leave((2, headset))
        self.wanted = {key: wish for key, wish in self.wanted.items() if key[0] != (2, headset)}
        for nodes in self.have.values():
            nodes -= {key for key in nodes if key[0] == (2, headset)}

    def come(self, robot_id: int, group: int) -> None:
        """A robot starts, with no nodes."""
        self.robots[robot_id] = self.seen[robot_id] = group
        self.have[robot_id] = set()
        self.registrations.seen(robot_id, group)
        self.tell(self.registrations.of_robot(robot_id, group))

    def regroup(self, robot_id: int, group: int) -> None:
        """A robot that is there changes its group, if it is."""
        if robot_id in self.robots:
            self.robots[robot_id] = self.seen[robot_id] = group
            self.tell(self.registrations.seen(robot_id, group))
            self.tell(self.registrations.of_robot(robot_id, group))

    def go(self, robot_id: int) -> None:
        """A robot stops."""
        self.robots.pop(robot_id, None)
        self.have.pop(robot_id, None)

    def should_have(self, robot_id: int) -> set[Key]:
        """The nodes that headsets want of a robot."""
        group = self.robots[robot_id]
        return {key for key, (ids, groups) in self.wanted.items() if robot_id in ids or (group and group in groups)}


headsets = st.sampled_from([7, 8])
robots = st.sampled_from([1, 2, 3])
wishes = st.tuples(
    headsets, st.sampled_from(NODES), st.sampled_from([1, 2]), st.sets(robots), st.sets(st.integers(1, 2))
)
steps = st.lists(
    st.tuples(st.just("register"), wishes)
    | st.tuples(st.just("deregister"), wishes)
    | st.tuples(st.just("leave"), st.tuples(headsets))
    | st.tuples(st.just("come"), st.tuples(robots, st.integers(0, 2)))
    | st.tuples(st.just("regroup"), st.tuples(robots, st.integers(0, 2)))
    | st.tuples(st.just("go"), st.tuples(robots)),
    max_size=30,
)


@given(steps)
def test_robots_have_what_is_wanted_of_them(story_steps: list[tuple[str, tuple[object, ...]]]) -> None:
    """After any sequence of events each robot online that did what it was told has exactly the nodes that are wanted
    of it, by id or by group."""
    story = Story()
    for what, arguments in story_steps:
        getattr(story, what)(*arguments)
        for robot_id in story.robots:
            assert story.have[robot_id] == story.should_have(robot_id)
        wanted = [key for key, (ids, groups) in story.wanted.items() if ids or groups]
        assert len(story.registrations) == len(wanted)
        for headset in range(20):
            named = [len(ids) + len(groups) for key, (ids, groups) in story.wanted.items() if key[0] == (2, headset)]
            assert story.registrations.named((2, headset)) == sum(named)
        for agent, node_type, name in wanted:
            assert story.registrations.find(agent, node_type, name) is not None


@given(steps)
def test_streams_are_those_that_somebody_wants(story_steps: list[tuple[str, tuple[object, ...]]]) -> None:
    """A gateway listens to the topics of robots that have a registrant here, also while one is away that it has seen,
    and knows for each who is registered once it asks: for robot 1 at once, for 2 later, for all in the end. Of what it
    was told and nobody wants any more it hears, and of nothing else."""
    story = Story()
    known: dict[tuple[int, str], set[AgentKey]] = {}
    for step, (what, arguments) in enumerate(story_steps):
        getattr(story, what)(*arguments)
        expected: dict[tuple[int, str], set[AgentKey]] = {}
        for (agent, node_type, name), (ids, groups) in story.wanted.items():
            if node_type == NodeType.SUBSCRIBER:
                for robot_id, group in story.seen.items():
                    if robot_id in ids or (group and group in groups):
                        expected.setdefault((robot_id, name), set()).add(agent)
        assert story.registrations.streams == expected
        for key in story.registrations.gone():
            del known[key]
        assert known.keys() <= expected.keys()
        known |= told(story.registrations, {key for key in expected if key[0] == 1 or (key[0] == 2 and step % 3)})
        assert {key: known[key] for key in known if key[0] == 1} == {k: v for k, v in expected.items() if k[0] == 1}
    known |= told(story.registrations, story.registrations.streams)
    assert known == story.registrations.streams
    assert told(story.registrations, known) == {}


def told(registrations: Registrations, keys: Iterable[tuple[int, str]]) -> dict[tuple[int, str], set[AgentKey]]:
    """What is told of these streams, now that somebody asks."""
    return {key: registrants for key in keys if (registrants := registrations.wanted(key)) is not None}


# -- examples --------------------------------------------------------------------------------------------------------


def test_a_robot_that_comes_later_is_told() -> None:
    """A registration by id and by group waits for robots that are not there yet."""
    registrations = Registrations()
    node = adding(7, NODES[0])
    assert registrations.add(node, [1], [3], {}) == []
    assert registrations.of_robot(1, 0) == [Task(1, node)]
    assert registrations.of_robot(2, 3) == [Task(2, node)]
    assert registrations.of_robot(2, 0) == []


def test_empty_lists_repeat_what_is_known() -> None:
    """A headset that registers a known robot again sends empty lists: the robot is told again; nobody else is."""
    registrations = Registrations()
    node = adding(7, NODES[0])
    assert registrations.add(node, [], [], {1: 0}) == []
    assert len(registrations) == 0
    registrations.add(node, [1], [], {1: 0, 2: 0})
    assert registrations.add(node, [], [], {1: 0, 2: 0}) == [Task(1, node)]


def test_a_new_buffer_size_replaces_the_old_one() -> None:
    """Registering again with other settings changes them, and every robot of the registration is told."""
    registrations = Registrations()
    registrations.add(adding(7, NODES[0], buffer_size=10), [1], [], {1: 0})
    changed = adding(7, NODES[0], buffer_size=2)
    assert registrations.add(changed, [2], [], {1: 0, 2: 0}) == [Task(1, changed), Task(2, changed)]
    assert registrations.find((2, 7), 1, NODES[0]) == changed


def test_a_robot_covered_twice_keeps_its_node() -> None:
    """Taking back a group leaves the node on its members that are named by id as well."""
    registrations = Registrations()
    robots = {1: 3, 2: 3}
    registrations.add(adding(7, NODES[0]), [1], [3], robots)
    assert registrations.remove(removing(7, NODES[0]), [], [3], robots) == [Task(2, removing(7, NODES[0]))]
    assert registrations.remove(removing(7, NODES[0]), [1], [], robots) == [Task(1, removing(7, NODES[0]))]
    assert len(registrations) == 0


def test_group_0_is_no_group() -> None:
    """Robots without a group are not covered by a registration for group 0."""
    registrations = Registrations()
    assert registrations.add(adding(7, NODES[0]), [], [0], {1: 0}) == []


def test_taking_back_what_nobody_has_is_nothing() -> None:
    """Removing an unknown registration tells nobody anything."""
    registrations = Registrations()
    registrations.add(adding(7, NODES[0]), [1], [], {1: 0})
    for other in (removing(8, NODES[0]), removing(7, NODES[1]), removing(7, NODES[0], node_type=2)):
        assert registrations.remove(other, [1], [], {1: 0}) == []
    assert len(registrations) == 1


def test_a_task_holds_while_it_is_wanted() -> None:
    """A task is dropped when its robot is away, has left the group, or its registration was taken back."""
    registrations = Registrations()
    node = adding(7, NODES[0])
    (task,) = registrations.add(node, [], [3], {1: 3})
    assert registrations.holds(task, {1: 3})
    assert not registrations.holds(task, {1: 4})
    assert not registrations.holds(task, {})
    registrations.leave((2, 7))
    assert not registrations.holds(task, {1: 3})
    assert registrations.find((2, 7), 1, NODES[0]) is None


def test_another_id_takes_all_registrations_along() -> None:
    """What a headset registered is its own under its next id: for robots online and for those that come later; other
    headsets' registrations stay as they are."""
    registrations = Registrations()
    robots = {1: 0, 2: 3}
    registrations.add(adding(5, NODES[0]), [1], [3], robots)
    registrations.add(adding(5, NODES[1]), [1], [], robots)
    registrations.add(adding(6, NODES[0]), [1], [], robots)
    registrations.rename((2, 5), 300)
    assert registrations.of_agent((2, 5), robots) == []
    theirs = [Task(1, adding(300, NODES[0])), Task(2, adding(300, NODES[0])), Task(1, adding(300, NODES[1]))]
    assert sorted(registrations.of_agent((2, 300), robots), key=str) == sorted(theirs, key=str)
    assert registrations.of_agent((2, 6), robots) == [Task(1, adding(6, NODES[0]))]
    assert registrations.of_robot(9, 3) == [Task(9, adding(300, NODES[0]))]
    assert registrations.remove(removing(300, NODES[1]), [1], [], robots) == [Task(1, removing(300, NODES[1]))]


def test_robots_that_nobody_has_seen_cost_nothing() -> None:
    """A registration that names robots that are not there makes no stream; when one comes, its own."""
    registrations = Registrations()
    registrations.add(adding(7, NODES[0]), range(1, 1000), [], {})
    assert registrations.streams == {}
    registrations.seen(500, 0)
    assert told(registrations, registrations.streams) == {(500, NODES[0]): {(2, 7)}}


def test_who_holds_a_service_keeps_it() -> None:
    """What a robot refused because another agent has it is not asked again when the robot comes back, but when that
    agent has left, or when the headset asks again."""
    registrations = Registrations()
    node = adding(7, NODES[0], node_type=4)
    (task,) = registrations.add(node, [1], [], {1: 0})
    registrations.refused(task, (2, 8))
    assert registrations.of_robot(1, 0) == []
    assert registrations.holder_left((2, 9), {1: 0}) == []
    assert registrations.holder_left((2, 8), {1: 0}) == [task]
    assert registrations.of_robot(1, 0) == [task]
    registrations.refused(task, (2, 8))
    assert registrations.add(node, [], [], {1: 0}) == [task]
    assert registrations.of_robot(1, 0) == [task]
    registrations.refused(task, (2, 8))
    assert registrations.holder_left((2, 8), {}) == []
    assert registrations.of_robot(1, 0) == [task]
