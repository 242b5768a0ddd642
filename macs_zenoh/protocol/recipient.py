"""What may be said to one TCP agent: the nodes that it registered, what it asked and was told, a gateway's own words.

Pure. The rules for existing programs are in `existing` and `robot_nodes`; here is what they depend on.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from msgspec import UNSET, Struct, structs

from .existing import Asked, OwnNode, Verdict, to_headset, to_newer, to_robot
from .messages import ROS, AddNode, Functionality, GoneAgent, Metadata, NodeType, RemoveNode, encode_data
from .offers import short_type
from .robot_nodes import RobotNodes
from .wire import Header, encode_message

LAST_NODES = 4096
"""Of how many names it is remembered which node the agent last had."""

VERDICTS = 1024
"""How many metadata are remembered as already judged."""

USUAL_DEPTH = (10, False)
"""What waits of a topic whose registration is not known any more."""

Subject = tuple[object, ...]
"""Metadata without its request id."""


def subject(metadata: Metadata) -> Subject:
    """What a verdict depends on."""
    return (
        metadata.sender_agent_id,
        metadata.node_name,
        metadata.message_manager,
        metadata.node_type,
        metadata.data_exchange_type,
        metadata.sender_agent_type,
    )


def to_agent(said: Struct | bytes, *, request_id: int = 0) -> bytes:
    """A gateway's own message: what one of the protocol's managers says, which is known by its name, or an answer."""
    manager = getattr(type(said), "manager", "")
    data = said if isinstance(said, bytes) else encode_data(said)
    return encode_message(Metadata(request_id=request_id, message_manager=manager).encode(), data)


def registration(node: AddNode | RemoveNode) -> bytes:
    """A registration as a robot program gets it, in the name of who registers; written anew, so that the program reads
    of it what was judged here, however it takes keys named twice."""
    metadata = Metadata(node.registrant_agent_type, node.registrant_agent_id, message_manager=node.manager)
    return encode_message(metadata.encode(), encode_data(node))


def _nowhere(metadata: Metadata) -> bool:
    """Of an agent that is registered on no robot."""
    return False


class Recipient:
    """One agent. ``registered_there(metadata)`` says whether it registered a message's node on the robot that sends
    it; ``packages`` are those that an existing robot program has besides the common ones."""

    def __init__(
        self, registered_there: Callable[[Metadata], bool] = _nowhere, packages: Collection[str] = ()
    ) -> None:
        self._registered_there = registered_there
        self._is_robot = False
        self.existing = True
        """Whether the agent is an existing program, which gets only what those are known to survive."""
        self.asked = Asked()
        self.robot_nodes = RobotNodes(packages)
        """Of a robot program: what it was told."""
        self.node_count = 0
        """How many interface nodes the agent has, by type and name."""
        self._topic_types: dict[str, str] = {}
        """Of which type the agent takes a topic's messages, by node, as existing robots write it."""
        self._nodes: dict[str, set[int]] = {}
        self._depths: dict[str, tuple[int, bool]] = {}
        self._last: dict[str, OwnNode] = {}
        """An existing headset keeps its nodes by name: of two under one name it has the last."""
        self._verdicts: dict[Subject, Verdict] = {}

    def lost(self) -> None:
        """The agent has left. Who asked for its registrations knows its connection: a circle, which would keep what
        that has until Python looks for circles."""
        self._registered_there = _nowhere

    def configured(self, agent_type: int, *, existing: bool) -> None:
        """The agent has said what it is."""
        self._is_robot, self.existing = agent_type == ROS, existing
        self._verdicts.clear()

    # -- its nodes -------------------------------------------------------------------------------------------------

    def registered(self, node: AddNode) -> None:
        """The agent has this interface node."""
        node_name, node_type = node.node_name, node.node_type
        types = self._nodes.setdefault(node_name, set())
        self.node_count += node_type not in types
        types.add(node_type)
        data_type = short_type(node.data_exchange_type)
        self._last.pop(node_name, None)
        self._last[node_name] = OwnNode(node_type, data_type)
        if len(self._last) > LAST_NODES:
            del self._last[next(name for name in self._last if name not in self._nodes)]
        self._verdicts.clear()
        if node_type == NodeType.SUBSCRIBER:
            self._depths[node_name] = node.buffer_size, node.drop_new
            self._topic_types[node_name] = data_type

    @property
    def only_listens(self) -> bool:
        """Whether all its nodes take messages of topics: nothing that it said before goes on."""
        return not any(types - {NodeType.SUBSCRIBER} for types in self._nodes.values())

    def is_registered(self, node: AddNode) -> bool:
        """Whether the agent has this interface node already."""
        return node.node_type in self._nodes.get(node.node_name, ())

    def has(self, metadata: Metadata) -> bool:
        """Whether the agent registered the node of this name and type itself."""
        return metadata.node_type in self._nodes.get(metadata.node_name, ())

    def other_type(self, node: AddNode) -> int | None:
        """The type that this node's name had until now, if it is another one."""
        before = self._last.get(node.node_name)
        return None if before is None or before.node_type == node.node_type else before.node_type

    def unregistered(self, node_name: str, node_type: int) -> None:
        """The agent has taken it back from everybody."""
        types = self._nodes.get(node_name, set())
        self.node_count -= node_type in types
        types.discard(node_type)
        if node_type == NodeType.SUBSCRIBER:
            self._depths.pop(node_name, None)
            self._topic_types.pop(node_name, None)
        if not types:
            self._nodes.pop(node_name, None)
        self._verdicts.clear()

    def depth_of(self, node_name: str) -> tuple[int, bool]:
        """How many messages of a topic may wait, and whether new ones are dropped rather than old ones."""
        return self._depths.get(node_name, USUAL_DEPTH)

    def takes(self, node_name: str, data_type: str, fits: bool = True) -> bool:
        """Whether a topic's message may go to the agent as it is: to an existing program only what ``fits`` and is of
        the type that it registered."""
        return not self.existing or (fits and self._topic_types.get(node_name) == data_type)

    # -- what others send to it ------------------------------------------------------------------------------------

    def verdict(self, metadata: Metadata, about: Subject | None = None) -> Verdict:
        """Whether a message with this metadata may be sent, and what its data must be. ``about`` is its `subject`, for
        who asks several."""
        about = about or subject(metadata)
        verdict = self._verdicts.get(about)
        if verdict is None:
            verdict = self._judge(metadata)
            if verdict.stays:
                if len(self._verdicts) >= VERDICTS:
                    self._verdicts.clear()
                self._verdicts[about] = verdict
        return verdict

    def _judge(self, metadata: Metadata) -> Verdict:
        if not self.existing:
            return to_newer(metadata, self._nodes)
        if self._is_robot:
            node = self.robot_nodes.find(metadata.node_type, metadata.node_name)
            return to_robot(metadata, node, self.asked)
        registered_there = bool(metadata.node_name) and self._registered_there(metadata)
        return to_headset(metadata, self._last, self.asked, registered_there=registered_there)

    def asks(self, metadata: Metadata, header: Header) -> None:
        """The agent sends a request to others, which they may answer."""
        self.asked.note(metadata, header)
        if not metadata.node_name:
            self._verdicts.clear()  # from now on a plain message may be the answer

    # -- what a robot program is told ------------------------------------------------------------------------------

    def tell(self, node: AddNode | RemoveNode, offered: Functionality | None) -> bytes | None:
        """The message that tells a robot program of a registration or its end; None when it knows. ``offered`` is what
        the program says it has. Raises Refused for what it would not survive."""
        if isinstance(node, AddNode):
            node = structs.replace(node, unity_cdr=UNSET)  # a robot program passes CDR on as it is
            to_tell = self.robot_nodes.add(node, offered, existing=self.existing)
        else:
            to_tell = self.robot_nodes.remove(node)
        if not to_tell:
            return None
        self._verdicts.clear()
        return registration(node)

    def gone(self, agents: Sequence[GoneAgent]) -> None:
        """The agent is told that these have left (`AgentsGone`), which takes them off a robot program's nodes."""
        self.robot_nodes.gone(agents)
        self._verdicts.clear()
