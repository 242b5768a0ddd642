"""From the mesh to TCP agents: who of ours gets a sample, and that nothing reaches them that would harm them.

Existing programs go deaf for good on much that is legal (`macs_zenoh.protocol.existing`), and on metadata that is none
and sizes that do not add up. So every sample is checked here again, whoever put it.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from macs_zenoh.errors import WireError
from macs_zenoh.losses import Losses
from macs_zenoh.mesh import Payload, Sample
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.existing import CDR, PASS, PASS_ONCE, Data, Verdict, fitting, least_bytes, refuses
from macs_zenoh.protocol.judging import Judge
from macs_zenoh.protocol.keyexpr import BROADCAST, GROUP, UNICAST
from macs_zenoh.protocol.least_bytes import TEXT_TYPE, is_whole
from macs_zenoh.protocol.messages import ROS, Metadata, NodeType, StreamData, decode_management
from macs_zenoh.protocol.recipient import subject
from macs_zenoh.protocol.registrations import AgentKey
from macs_zenoh.protocol.robot_state import StreamCount
from macs_zenoh.protocol.routing import takes_group_copy
from macs_zenoh.protocol.wire import Buffer, Frame, Frames, Layout, is_probe, parse_frame, parse_runs

from .afar import Afar
from .agents import Agents
from .backpressure import ROBOT_HOLD_S
from .connection import Connection
from .judged import JudgedFrames, Read
from .on_the_way import OnTheWay, Stream
from .shares import Rounds
from .stead import Stead

log = logging.getLogger("macs.gateway")

ANSWERS = frozenset((NodeType.CLIENT, NodeType.ACTION))
"""Nodes of headsets to which robots answer."""

KNOWN = 4096
"""How many keys and registrant lists are remembered as already read."""

SENDERS, KNOWN_EACH = 512, 32
"""Of how many senders metadata is remembered as already judged, and how many of each."""

KNOWN_CIRCLES = 256
"""Of how many keys for several it is remembered whom they reach: that can be everybody here."""

KNOWN_BYTES = 4096
"""Longer ones are read each time: what others choose must not decide how much is kept here."""

SEEN = 512
"""How many messages are remembered by their beginnings."""

NOBODY: frozenset[AgentKey] = frozenset()

Circle = tuple[AgentKey, list[Connection]]
"""Who sends, and all of ours that hear it."""


class Seen(NamedTuple):
    """A message of a topic that was read: one that is as long and begins like it differs in its data only."""

    beginning: bytes
    message_at: int
    registrants: list[AgentKey]
    data_type: str
    is_text: bool
    """Whether its data has a length in it, which each message is judged by."""


class Delivery:
    """Samples of the mesh → messages to connections. Each method takes a batch and flushes at its end.

    The sender is the one of the key, which routers can hold it to: metadata that names another is put right.

    ``drops`` counts ``bad_frame``, ``nobody_with_this_id``, ``not_registered`` (topic data for an agent that did not
    register it on this robot, or has just taken that back) and ``wrong_sender``, which is put right and delivered.
    What an agent must not get is counted at its connection.
    """

    def __init__(
        self,
        agents: Agents,
        directory: Directory,
        layout: Layout,
        stead: Stead,
        session_drops: Counter[str],
        judged: JudgedFrames,
        afar: Afar,
        rounds: Rounds,
    ) -> None:
        self.drops = Losses(log)
        self._on_the_way = OnTheWay(self.drops, session_drops)
        self._agents = agents
        self._directory = directory
        self._stead = stead
        self._afar = afar
        self._rounds = rounds
        self._layout = layout
        self.streams: dict[str, Stream] = {}
        """By their keys."""
        self._targets: dict[str, tuple[Connection, AgentKey]] = {}
        self._circles: dict[str, Circle] = {}
        """By keys of groups and of everybody."""
        self._group_takers: dict[tuple[str, bytes], list[Connection]] = {}
        """By key and destination: who of a group has not the copy for its id."""
        self._judged = judged
        self._judges: dict[AgentKey, Judge] = {}
        self._registrants: dict[bytes, list[AgentKey]] = {}
        self._seen: dict[tuple[str, int], Seen] = {}
        self._gathered: list[Connection] = []

    def inbox(self, batch: Iterator[Sample]) -> None:
        """Frames sent to ids of ours."""
        began = time.monotonic()
        for key, payload in batch:
            target = self._targets.get(key)
            if target is None:
                if is_probe(payload, self._layout):
                    continue
                target = self._find(key)
            if target is None:
                if self._agents.former:
                    self._late_answer(key, payload)
                continue
            connection, sender = target
            self._send_all(connection, self._read(key, payload, sender))
            if connection.congested:
                self._hold_sender(sender, [connection])
        self._flush(began)

    def group(self, batch: Iterator[Sample]) -> None:
        """Frames sent to groups that one of ours is in."""
        began = time.monotonic()
        for key, payload in batch:
            circle = self._circles.get(key) or self._members(key)
            if circle is None:
                continue
            sender, members = circle
            for frame, metadata in self._read(key, payload, sender):
                self._send_each(self._takers(key, frame, circle), frame, metadata)
            self._hold_sender(sender, members)
        self._flush(began)

    def broadcast(self, batch: Iterator[Sample]) -> None:
        """Frames sent to everybody."""
        began = time.monotonic()
        for key, payload in batch:
            circle = self._circles.get(key) or self._others(key)
            if circle is None:
                continue
            sender, others = circle
            for frame, metadata in self._read(key, payload, sender):
                self._send_each(others, frame, metadata)
            self._hold_sender(sender, others)
        self._flush(began)

    def stream(self, batch: Iterator[Sample]) -> None:
        """A robot's topic data, for those of its registrants that are ours."""
        began = time.monotonic()
        for key, payload in batch:
            stream = self.streams.get(key)
            if stream is None:
                continue  # the last registrant has just left
            stream.came.samples += 1
            robot = self._agents.find(*stream.robot)
            may_hold: bool | None = None
            for frame, metadata in self._read(key, payload, stream.robot):
                registered = stream.registrants if stream.carries(metadata) else NOBODY
                data_type = metadata.data_exchange_type
                fits = isinstance(frame, Frame) and _fits(frame, metadata)  # a run lists no registrants
                messages = frame.messages
                registrants = self._registrants.get(frame.management) or self._read_registrants(key, frame)
                if not registrants and metadata.message_manager == StreamCount.manager:
                    self._told_how_much(key, stream, frame)
                for registrant in registrants:
                    connection = self._agents.find(*registrant)
                    if connection is None:
                        continue
                    if registrant in registered:
                        keep = False
                        if robot is not None and connection.full and not connection.asleep:
                            if may_hold is None:  # once for the sample: it looks at everybody
                                may_hold = self._all_are_full(robot)
                            keep = may_hold and connection.robot_backpressure.hold(
                                robot, connection.moved, ROBOT_HOLD_S
                            )
                        if not connection.recipient.takes(stream.node, data_type, fits):
                            self._send_topic(connection, frame, metadata, keep)
                        else:
                            self._gather_stream(connection, stream.node, messages, keep=keep)
                    else:
                        self._unregistered(connection, frame, metadata)
        self._flush(began)

    def stream_at_once(self, key: str, payload: Payload) -> bool:
        """The same for one message in a thread of Zenoh's, if nothing about it is new and all its receivers are
        free."""
        stream = self.streams.get(key)
        if stream is None:
            return False
        seen = self._seen.get((key, len(payload)))
        if seen is None or not payload.startswith(seen.beginning):
            seen = self._look(key, payload, stream)
            if seen is None:
                return False
        if seen.is_text and not is_whole(memoryview(payload)[len(seen.beginning) - len(CDR) :], TEXT_TYPE):
            return False
        receivers = []
        for registrant in seen.registrants:
            connection = self._agents.find(*registrant)
            if connection is not None:
                if registrant not in stream.registrants or not connection.free:
                    return False
                if not connection.recipient.takes(stream.node, seen.data_type):
                    return False
                receivers.append(connection)
        stream.came.samples += 1
        message = bytes(payload[seen.message_at :])
        for connection in receivers:
            connection.send_now(message)
        return True

    def _look(self, key: str, payload: Payload, stream: Stream) -> Seen | None:
        """What a message says of itself, if it is one, and `stream` has read all of that before."""
        try:
            frame = parse_frame(payload, self._layout)
        except WireError:
            return None
        judging = self._judges.get(stream.robot)
        judged = judging.known(frame.metadata) if judging is not None else None
        registrants = self._registrants.get(frame.management)
        if judged is None or not judged.readable or registrants is None or not stream.carries(judged.metadata):
            return None
        if len(self._seen) >= SEEN:
            self._seen.clear()
        if judged.true != frame.metadata or not frame.carries(CDR, least_bytes(judged.metadata)):
            return None
        data_type = judged.metadata.data_exchange_type
        seen = self._seen[key, len(payload)] = Seen(
            frame.beginning + CDR, frame.message_at, registrants, data_type, data_type == TEXT_TYPE
        )
        return seen

    def _told_how_much(self, key: str, stream: Stream, frame: Frames) -> None:
        try:
            self._on_the_way.told(key, stream, bytes(frame.last.body))
        except WireError as error:
            self._bad(key, error)

    def _flush(self, began: float) -> None:
        """Write what was gathered since then, one write per connection."""
        self._rounds.add(time.monotonic() - began)
        gathered, self._gathered = self._gathered, []
        for connection in gathered:
            connection.flush()

    def _gather_calls(self, connection: Connection, messages: Sequence[Buffer]) -> None:
        if connection.gather_calls(messages):
            self._gathered.append(connection)

    def _gather_stream(self, connection: Connection, node: str, messages: Sequence[Buffer], *, keep: bool) -> None:
        if connection.gather_stream(node, messages, keep=keep):
            self._gathered.append(connection)

    def forget(self) -> None:
        """Agents came or went: look keys up anew."""
        self._targets.clear()
        self._circles.clear()
        self._group_takers.clear()

    def _send_each(self, connections: list[Connection], frame: Frames, metadata: Metadata) -> None:
        """The same frame to several."""
        messages = frame.messages
        size = sum(map(len, messages))
        about = subject(metadata)
        for connection in connections:
            verdict = connection.recipient.verdict(metadata, about)
            if verdict is PASS or verdict is PASS_ONCE:
                if connection.gather_calls(messages, size):
                    self._gathered.append(connection)
            else:
                self._send_judged(connection, frame, metadata, verdict, by_id=False)

    def _send(self, connection: Connection, frame: Frames, metadata: Metadata, *, by_id: bool = False) -> None:
        verdict = connection.recipient.verdict(metadata)
        if verdict is PASS or verdict is PASS_ONCE:
            self._gather_calls(connection, frame.messages)
        else:
            self._send_judged(connection, frame, metadata, verdict, by_id=by_id)

    def _send_all(self, connection: Connection, read: Read) -> None:
        """The frames of one sample that was sent to the agent's id."""
        messages: list[Buffer] = []
        for frame, metadata in read:
            verdict = connection.recipient.verdict(metadata)
            if verdict is PASS or verdict is PASS_ONCE:
                messages += frame.messages
                continue
            if messages:
                self._gather_calls(connection, messages)
                messages = []
            self._send_judged(connection, frame, metadata, verdict, by_id=True)
        if messages:
            self._gather_calls(connection, messages)

    def _send_judged(
        self, connection: Connection, frame: Frames, metadata: Metadata, verdict: Verdict, *, by_id: bool
    ) -> None:
        """What does not simply pass."""
        if verdict.name:
            self._refuse(connection, frame, metadata, verdict, by_id=by_id)
        elif verdict.answers:
            connection.recipient.asked.answered(metadata)
            first = frame.each()[0]
            if connection.recipient.existing and not metadata.request_id and refuses(first):
                return  # what is not meant as a question has number 0 as well, and then the next question may have it
            self._send_fitting(connection, first, metadata, verdict.data)
        else:
            self._send_fitting(connection, frame, metadata, verdict.data)

    def _send_topic(self, connection: Connection, frame: Frames, metadata: Metadata, keep: bool) -> None:
        """Topic data that does not simply pass to an existing program."""
        verdict = connection.recipient.verdict(metadata)
        if verdict.name:
            self._refuse(connection, frame, metadata, verdict, by_id=False)
        else:
            self._send_fitting(connection, frame, metadata, verdict.data, metadata.node_name, keep)

    def _refuse(
        self, connection: Connection, frame: Frames, metadata: Metadata, verdict: Verdict, *, by_id: bool
    ) -> None:
        if connection.recipient.existing and connection.peer.agent_type == ROS:
            singles = frame.each() if metadata.message_manager else ()  # each question of a run is answered
            answered = [self._stead.answered(connection, metadata, verdict.why, by_id=by_id) for _ in singles]
            if answered and all(answered):
                return
        connection.complain(verdict.name, f"{verdict.why} (sent by {_who(metadata)})", frame.count)

    def _send_fitting(
        self,
        connection: Connection,
        frame: Frames,
        metadata: Metadata,
        data: Data,
        stream: str | None = None,
        keep: bool = False,
    ) -> None:
        """Send what has data that the agent survives; with ``stream`` as topic data of that node."""
        messages, others = fitting(frame, data, metadata)
        if others:
            about = metadata.node_name[:80] or "a request"
            problem = f"data for {about} that is not {data.value} (sent by {_who(metadata)})"
            connection.complain("not_survived", problem, others)
        if not messages:
            return
        if stream is None:
            self._gather_calls(connection, messages)
        else:
            self._gather_stream(connection, stream, messages, keep=keep)

    def _unregistered(self, connection: Connection, frame: Frames, metadata: Metadata) -> None:
        """Topic data for who did not register it there: a forged list; or it is older than the agent, which has
        another's id."""
        verdict = connection.recipient.verdict(metadata)
        if verdict.name == "wrong_node_type":
            connection.complain(verdict.name, verdict.why, frame.count)
            return
        problem, node = "%s lists %s as a receiver of %s, registered nowhere", metadata.node_name[:80]
        self.drops.once("not_registered", problem, _who(metadata), connection, node, count=frame.count)

    def _find(self, key: str) -> tuple[Connection, AgentKey] | None:
        """Who of ours a frame is for, and who sent it."""
        fields = UNICAST.parse(key)
        if fields is None:
            return None
        connection = self._agents.find(fields.type, fields.id)
        if connection is None:
            if (fields.type, fields.id) not in self._directory:  # else it is in our block, but somebody else's
                self.drops["nobody_with_this_id"] += 1
            return None
        if len(self._targets) >= KNOWN:
            self._targets.clear()
        target = self._targets[key] = (connection, fields.sender)
        return target

    def _members(self, key: str) -> Circle | None:
        """Who of ours is in the group of a key, and who sends to it."""
        fields = GROUP.parse(key)
        if fields is None:
            return None
        return self._remember(key, fields.sender, self._agents.members(fields.type, fields.group))

    def _others(self, key: str) -> Circle | None:
        """All of ours but the one that sends with a key to everybody."""
        fields = BROADCAST.parse(key)
        if fields is None:
            return None
        others = [each for each in self._agents.online() if each.key != fields.sender]
        return self._remember(key, fields.sender, others)

    def _remember(self, key: str, sender: AgentKey, connections: list[Connection]) -> Circle:
        if len(self._circles) >= KNOWN_CIRCLES:
            self._circles.clear()
        circle = self._circles[key] = sender, connections
        return circle

    def _takers(self, key: str, frame: Frames, circle: Circle) -> list[Connection]:
        """Those members of a group who keep this copy of a frame."""
        to = key, frame.destination
        takers = self._group_takers.get(to)
        if takers is None:
            header, (sender, members) = frame.header, circle
            if len(self._group_takers) >= KNOWN_CIRCLES:
                self._group_takers.clear()
            takers = self._group_takers[to] = [
                each for each in members if takes_group_copy(header, each.agent_id, sender, each.peer.agent_type)
            ]
        return takers

    def _late_answer(self, key: str, payload: bytes | bytearray) -> None:
        """An answer to a service call that an agent made under the id it had then. Anything else that is sent to
        that id is for whoever has it now."""
        fields = UNICAST.parse(key)
        if fields is None or fields.from_type != ROS:
            return
        connection = self._agents.former.get((fields.type, fields.id))
        if connection is not None:
            for frame, metadata in self._read(key, payload, fields.sender):
                if metadata.node_type in ANSWERS and connection.recipient.has(metadata):
                    self._send(connection, frame, metadata)

    def _hold_sender(self, sender: AgentKey, receivers: list[Connection]) -> None:
        """Slow down a sender while a receiver is full. Behind no gateway nobody does: the outbox's limit decides."""
        for receiver in receivers:
            if not receiver.congested:
                continue
            if (connection := self._agents.find(*sender)) is not None:
                if not connection.drives:
                    receiver.backpressure.hold(connection, receiver.moved)
            else:
                self._afar.hold(sender, receiver)

    def _all_are_full(self, robot: Connection) -> bool:
        """Whether nobody who registered on a robot program of this gateway could take more, so that it may be held: a
        headset that reads slowly must not slow down the others' topics."""
        for registrant in robot.recipient.robot_nodes.registrants():
            other = self._agents.find(registrant.agent_type, registrant.agent_id)
            if other is None or not other.full:
                return False
        return True

    def _read_registrants(self, key: str, frame: Frames) -> list[AgentKey]:
        """Each registrant, once. The list changes only with registrations, so each is read once."""
        try:
            management = decode_management(frame.management)
        except WireError as error:
            self._bad(key, error)
            return []
        registrants = list(dict.fromkeys(management.targets())) if isinstance(management, StreamData) else []
        if len(frame.management) <= KNOWN_BYTES:
            if len(self._registrants) >= KNOWN:
                self._registrants.clear()
            self._registrants[frame.management] = registrants
        return registrants

    def _read(self, key: str, payload: bytes | bytearray, sender: AgentKey) -> Read:
        """The frames of a sample with their metadata; those that no agent must see are left out. What this gateway
        judged when it came in is not judged again."""
        if (known := self._judged.take(payload)) is not None:
            return known
        try:
            frames = parse_runs(payload, self._layout)
        except WireError as error:
            self._bad(key, error)
            return []
        judging = self._judges.get(sender)
        if judging is None:
            if len(self._judges) >= SENDERS:
                self._judges.clear()
            judging = self._judges[sender] = Judge(*sender, limit=KNOWN_EACH)
        return [judged for frame in frames if (judged := self._judge(key, frame, judging)) is not None]

    def _judge(self, key: str, frame: Frames, judging: Judge) -> tuple[Frames, Metadata] | None:
        """A frame with its true sender, and its metadata."""
        raw = frame.metadata
        try:
            metadata, true, readable = judging(raw)
            if readable and (true is raw or true == raw):
                return frame, metadata
            named = Metadata.decode(raw)
            sender = (metadata.sender_agent_type, metadata.sender_agent_id)
            if (named.sender_agent_type, named.sender_agent_id) != sender:
                self._wrong_sender(key, (named.sender_agent_type, named.sender_agent_id), frame.count)
        except WireError as error:
            self._bad(key, error)
            return None
        return frame.with_metadata(true if readable else metadata.encode()), metadata

    def _wrong_sender(self, key: str, named: tuple[int | None, int | None], count: int) -> None:
        who = "nobody" if None in named else AgentId(named[0] or 0, named[1] or 0)
        self.drops.once("wrong_sender", "a frame on %s names %s as its sender: put right", key, who, count=count)

    def _bad(self, key: str, error: WireError) -> None:
        self.drops.once("bad_frame", "a frame on %s cannot be used: %s", key, error)


def _fits(frame: Frame, metadata: Metadata) -> bool:
    return frame.carries(CDR, least_bytes(metadata)) and is_whole(frame.body, metadata.data_exchange_type)


def _who(metadata: Metadata) -> str:
    return str(AgentId(metadata.sender_agent_type or 0, metadata.sender_agent_id or 0))
