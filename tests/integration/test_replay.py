"""Every recorded session of the existing programs, played against our gateways over real sockets and a real router.

What the recorded agents sent is sent, in the recorded order, each frame after everything was heard that the recording
shows before it. Then everybody must have heard what the recording shows, no more and no less; messages of one sender
in order. Differences that are meant are in `tests.replay.RULES`.
"""

from __future__ import annotations

import asyncio
import json
import struct
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import suppress

import pytest

from bridge.gateway import Gateway
from tests.replay import (
    INSTEAD,
    NAMES,
    NOT_TOLD,
    ROS,
    RULES,
    TWINS,
    UNITY,
    Connect,
    Ended,
    Hear,
    Hush,
    Ids,
    Leave,
    Person,
    Scene,
    Send,
    files_on_disk,
    frame_of,
    meaning,
    message_of,
    scene,
    sender,
    split,
)
from tests.support.given import StartGateway
from tests.support.waiting import PATIENCE_S, until

MARKER = "ReplayMarker"
"""Manager of a message that shows a headset that all before it was dealt with."""
MARKED = {"nodeType": 2, "nodeName": "nd__replay_marker", "dataExchangeType": "std_msgs/Empty"}
"""Node of such a message to an existing robot, which survives no manager."""
MARKED_TOPIC = "/replay_marker"
HEARTBEAT = frame_of((0,) * 21, b'{"messageManager":"HeartbeatHandler"}', bytes(8))
HEARTBEAT_S = 0.3


class Player:
    """One recorded connection, as a socket to a gateway."""

    def __init__(self, person: Person, gateway: Gateway) -> None:
        self.person = person
        self.gateway = gateway
        self.id = 0
        self.number = 0
        self.configured = False
        self.left = False
        self.ended = asyncio.Event()
        self.heard: list[bytes] = []
        self.markers: Counter[str] = Counter()
        self.writer: asyncio.StreamWriter
        self._buffer = bytearray()
        self._reading: asyncio.Task[None]

    async def connect(self) -> bytes:
        """Connect and take the first message, which is returned."""
        reader, self.writer = await asyncio.open_connection("127.0.0.1", self.gateway.port)
        self._reading = asyncio.create_task(self._read(reader))
        await until(lambda: self.heard)
        welcome = self.heard.pop(0)
        metadata, data = split(welcome)
        self.number = json.loads(metadata)["requestId"]
        self.id = json.loads(data)["agentId"]
        return welcome

    def configure(self) -> None:
        """Answer the first message as existing programs do."""
        told = {"agentType": self.person.type, "agentId": self.id, "groupId": self.person.group}
        management = json.dumps({**told, "requestId": self.number, "messageManager": "AgentclientConfigurer"})
        self.writer.write(frame_of((0,) * 21, management.encode(), bytes(8)))
        self.configured = True

    def mark(self, text: str) -> None:
        """Tell everybody, after all that was sent before."""
        me = {"senderAgentType": self.person.type, "senderAgentId": self.id}
        metadata = {**me, "messageManager": MARKER}
        self.writer.write(frame_of((0,) * 21, b"", message_of(json.dumps(metadata).encode(), text.encode())))
        if self.person.type == UNITY:
            data = b"\x00\x01\x00\x00" + text.encode()
            self.writer.write(frame_of((0,) * 21, b"", message_of(json.dumps({**me, **MARKED}).encode(), data)))

    def register_marks(self, robots: Sequence[int]) -> None:
        """Let robots take marks."""
        me = {"registrantAgentType": self.person.type, "registrantAgentId": self.id}
        node = {**me, **MARKED, "tosName": MARKED_TOPIC}
        management = {"messageManager": "RosAgentNodeRegistrationForwarder", "registrarAgentIds": robots, **node}
        message = message_of(b'{"messageManager":"InterfaceNodeAdder"}', json.dumps(node).encode())
        self.writer.write(frame_of((0,) * 21, json.dumps(management).encode(), message))

    @property
    def online(self) -> bool:
        """Whether it takes part in broadcasts."""
        return self.configured and not self.left and not self.ended.is_set()

    def leave(self) -> None:
        """Close the connection."""
        self.left = True
        self.writer.close()

    async def close(self) -> None:
        """End everything."""
        self.writer.close()
        self._reading.cancel()
        with suppress(asyncio.CancelledError, ConnectionError):
            await self._reading

    async def _read(self, reader: asyncio.StreamReader) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(65536):
                self._buffer += data
                while (message := self._next()) is not None:
                    self._take(message)
        self.ended.set()

    def _take(self, message: bytes) -> None:
        metadata, data = split(message)
        if json.loads(metadata).get("messageManager") == MARKER:
            self.markers[data.decode()] += 1
        elif b"nd__replay_marker" in metadata:
            self.markers[data[4:].decode()] += self.person.type == ROS
        elif b"nd__replay_marker" in data:
            self.markers["registered"] += 1
        else:
            self.heard.append(message)

    def _next(self) -> bytes | None:
        """One whole message of the stream, read by hand."""
        if len(self._buffer) < 8:
            return None
        (size,) = struct.unpack_from("<I", self._buffer)
        if len(self._buffer) < 8 + size:
            return None
        (data_size,) = struct.unpack_from("<I", self._buffer, 4 + size)
        whole = 8 + size + data_size
        if len(self._buffer) < whole:
            return None
        message = bytes(self._buffer[:whole])
        del self._buffer[:whole]
        return message


class Stage:
    """Plays one scene on some gateways."""

    def __init__(self, scene: Scene, gateways: Sequence[Gateway]) -> None:
        self.scene = scene
        self.gateways = gateways
        self.ids = Ids()
        self.players: dict[str, Player] = {}
        self.expected: defaultdict[str, list[str]] = defaultdict(list)
        self._hushed: set[str] = set()
        self._held = b""

    async def play(self) -> None:
        """Bring the cast up, play the steps, and compare."""
        for person in reversed(self.scene.cast):  # so that ids differ from the recorded ones
            player = self._player(person)
            await player.connect()
            self.ids.learn(person.type, person.id, player.id)
            player.configure()
        await self._all_known()
        beating = asyncio.create_task(self._heartbeats())
        try:
            for step in self.scene.steps:
                await self._do(step)
            await self._settle()
            for number in (1, 2):
                await self._marks(f"round {number}")
            self._compare()
        finally:
            beating.cancel()

    async def close(self) -> None:
        """Close all connections."""
        await asyncio.gather(*(player.close() for player in self.players.values()))

    def _player(self, person: Person) -> Player:
        """Robots on the last gateway, headsets on all in turn: most messages cross the mesh when there are two."""
        gateway = self.gateways[-1] if person.type == ROS else self.gateways[person.id % len(self.gateways)]
        return self.players.setdefault(person.name, Player(person, gateway))

    async def _do(self, step: object) -> None:
        if isinstance(step, Hear):
            names = [step.name] if step.name else [name for name, player in self.players.items() if player.online]
            text = meaning(self.ids.message(step.message))
            for name in names:
                self.expected[name].append(text)
            return
        await self._settle()
        if isinstance(step, Connect):
            await self._connect(step)
        elif isinstance(step, Send):
            await self._send(step)
        elif isinstance(step, Leave):
            self.players[step.name].leave()
        elif isinstance(step, Ended):
            player = self.players[step.name]
            await asyncio.wait_for(player.ended.wait(), PATIENCE_S)
        elif isinstance(step, Hush):
            self._hushed.add(step.name)

    async def _connect(self, step: Connect) -> None:
        person = self.scene.people[step.name]
        player = self._player(person)
        welcome = await player.connect()
        assert _welcomes(welcome) == _welcomes(step.welcome)
        self.ids.learn(person.type, person.id, player.id)

    async def _send(self, step: Send) -> None:
        player = self.players[step.name]
        frame = self._held + self.ids.frame(step.frame, player.person, player.number)
        self._held = b""
        if step.cut == "next":
            self._held = frame
            return
        pieces = [frame]
        if step.cut == "bytes":
            pieces = [frame[at : at + 1] for at in range(len(frame))]
        elif step.cut == "half":
            pieces = [frame[: len(frame) // 2], frame[len(frame) // 2 :]]
        for piece in pieces:
            player.writer.write(piece)
            await asyncio.sleep(0)
        if b"gentclientConfigurer" in frame:
            player.configured = True
            await self._all_known()

    async def _all_known(self) -> None:
        """Every gateway knows of everybody."""
        agents = {(player.person.type, player.id) for player in self.players.values() if player.online}
        await until(lambda: all(agent in gateway.directory for gateway in self.gateways for agent in agents))

    async def _settle(self) -> None:
        """Everybody has heard as much as the recording shows up to here, and gateways have what they asked for. (Who
        leaves while a robot has not answered yet is taken off it expressly.)"""

        def settled() -> bool:
            heard = all(len(self.players[name].heard) >= len(texts) for name, texts in self.expected.items())
            return heard and not any(gateway._registry.robots._calls for gateway in self.gateways)

        try:
            await until(settled)
        except AssertionError:
            self._compare()  # it says who has not heard what
            raise

    async def _marks(self, text: str) -> None:
        """Everybody hears from everybody else: whatever was sent before has been dealt with."""
        players = [player for player in self.players.values() if player.online]
        headsets = [player for player in players if player.person.type == UNITY]
        robots = [player for player in players if player.person.type == ROS]
        if headsets:
            headsets[0].register_marks([robot.id for robot in robots])
            await until(lambda: all(robot.markers["registered"] for robot in robots))
        for player in players:
            player.mark(text)
        await until(lambda: all(headset.markers[text] == len(players) - 1 for headset in headsets))
        await until(lambda: all(robot.markers[text] == len(headsets) for robot in robots))

    async def _heartbeats(self) -> None:
        while True:
            await asyncio.sleep(HEARTBEAT_S)
            for name, player in self.players.items():
                if player.online and name not in self._hushed:
                    player.writer.write(HEARTBEAT)

    def _compare(self) -> None:
        for name, player in self.players.items():
            heard = [meaning(message) for message in player.heard]
            both = ["", *heard, "and not", *self.expected[name]]
            assert _by_sender(heard) == _by_sender(self.expected[name]), f"what {name} heard: " + "\n".join(both)


def _by_sender(texts: list[str]) -> dict[tuple[object, object], list[str]]:
    found: defaultdict[tuple[object, object], list[str]] = defaultdict(list)
    for text in texts:
        found[sender(text)].append(text)
    return dict(found)


def _welcomes(message: bytes) -> tuple[dict[str, object], list[str]]:
    """A first message without its numbers."""
    metadata, data = (json.loads(part) for part in split(message))
    assert type(metadata["requestId"]) is type(data["agentId"]) is int
    return {**metadata, "requestId": 0}, list(data)


@pytest.mark.parametrize(
    ("name", "gateways"),
    [
        # each once in any run, on one gateway or on two; on both in that of all tests
        pytest.param(name, gateways, marks=[] if number % 2 == gateways - 1 else [pytest.mark.soak])
        for number, name in enumerate(NAMES)
        for gateways in (1, 2)
    ],
)
async def test_a_recorded_session(name: str, gateways: int, start_gateway: StartGateway) -> None:
    """Everybody hears what the recording shows, except where a rule says otherwise."""
    the_scene = scene(name)
    running = await asyncio.gather(*(start_gateway(**the_scene.settings) for _ in range(gateways)))
    stage = Stage(the_scene, running)
    try:
        await stage.play()
    finally:
        await stage.close()


def test_all_recordings_are_replayed() -> None:
    """As many files are replayed as there are."""
    assert len(NAMES) == len(set(NAMES)) == files_on_disk() >= 83


def test_every_rule_is_used() -> None:
    """Each difference is shown by a recording, and no recording shows one that has no reason."""
    used = Counter(rule for name in NAMES for rule in scene(name).rules)
    assert set(used) == set(RULES)
    assert used.total() - used["ids ascend"] == len(INSTEAD) + len(NOT_TOLD) + TWINS
