"""Workers at the ends of a crowd: many robots without ROS, and many headsets, that stamp messages and time them.

``python -m benchmarks.crowd_ends robots PORT COUNT`` joins the router on that port as robots 1 to COUNT, which publish
their pose and pictures and answer requests; ``... headsets PORT COUNT`` is up to COUNT headsets on a gateway, each of
which watches one robot. A stamp is `robot_ends.STAMP`: when it was sent, and a number.
"""

from __future__ import annotations

import asyncio
import json
import select
import struct
import sys
import time
from collections import Counter
from contextlib import AsyncExitStack
from statistics import quantiles
from typing import Any

import uvloop

import macs_zenoh
from bridge.headset import frames
from bridge.headset.frames import NodeSpec
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AddNode,
    Metadata,
    NodeType,
    RemoveNode,
    StreamData,
    decode_data,
    encode_management,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams

from .headset import RECEIVE_BYTES, Headset
from .robot_ends import AT, STAMP, TYPE, stamped
from .worker import say, serve

POSE = NodeSpec(NodeType.SUBSCRIBER, "/pose", TYPE, 100)
IMAGE = NodeSpec(NodeType.SUBSCRIBER, "/image", TYPE, 10)
COMMAND = NodeSpec(NodeType.PUBLISHER, "/command", TYPE)
POSE_BYTES, IMAGE_BYTES, COMMAND_BYTES, GROUP_BYTES = 100, 64 << 10, 100, 200
POSE_HZ, IMAGE_HZ, COMMAND_HZ, GROUP_HZ, REQUEST_HZ = 100, 30, 50, 10, 10
GROUP = 7
ANSWER_BYTES = 64
QUIET_S = 1.0
"""What has not come so long after the last message was sent is lost."""

Report = dict[str, Any]
_U32 = struct.Struct("<I")
_KINDS = {len(stamped(POSE_BYTES)): "pose", len(stamped(IMAGE_BYTES)): "image", len(stamped(GROUP_BYTES)): "group"}
"""What a headset gets, by the length of its data."""


class Times:
    """How long messages of each kind took, and how many came after one that was sent later."""

    def __init__(self) -> None:
        self._took_s: dict[str, list[float]] = {}
        self.late: Counter[str] = Counter()

    def note(self, kind: str, sent: float, now: float) -> None:
        """One has come."""
        self._took_s.setdefault(kind, []).append(now - sent)

    def report(self) -> dict[str, Report]:
        """Of each kind how many, and their times in ms."""
        times = self._took_s.items()
        return {kind: {"got": len(took_s), "late": self.late[kind], **_middle(took_s)} for kind, took_s in times}


def _middle(took_s: list[float]) -> dict[str, float]:
    if len(took_s) < 2:
        return {"p50_ms": float("inf"), "p99_ms": float("inf")}
    cuts = quantiles(took_s, n=100)
    return {"p50_ms": cuts[49] * 1000, "p99_ms": cuts[98] * 1000}


# -- robots ----------------------------------------------------------------------------------------------------------


class Robot:
    """One robot: takes every registration, publishes to who registered, and answers requests."""

    def __init__(self, agent: macs_zenoh.Agent, times: Times) -> None:
        self.registrants: dict[str, set[int]] = {POSE.name: set(), IMAGE.name: set(), COMMAND.name: set()}
        self.steady: dict[str, frozenset[int]] = {}
        """Of these, by topic, who stays to the end: passers-by have others' former ids, but never theirs."""
        self.due: Counter[str] = Counter()
        """How many messages those who stay are to get, by kind."""
        self._agent = agent
        self._streams = Streams(agent)
        self._times = times
        agent.serve("add_node", self._add)
        agent.serve("remove_node", self._remove)
        agent.on_message(self._take)
        agent.on_presence(self._presence)

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(AddNode, call.data)
        self.registrants[node.node_name].add(node.registrant_agent_id)
        return b""

    async def _remove(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(RemoveNode, call.data)
        self.registrants[node.node_name].discard(node.registrant_agent_id)
        return b""

    def _presence(self, agent: macs_zenoh.AgentInfo, online: bool) -> None:
        if agent.type == UNITY and not online:
            for registrants in self.registrants.values():
                registrants.discard(agent.id)

    def _take(self, message: macs_zenoh.Message) -> None:
        if message.data[:1] == b"{":
            self._agent.reply(message, message.data)
            return
        sent, _ = STAMP.unpack_from(message.data, AT)
        self._times.note("command", sent, time.monotonic())

    async def publish(self, node: NodeSpec, kind: str, size: int, hz: float, until: float) -> None:
        """Publish on one topic at a rate, to whoever is registered then; due are messages to those who stay. A late
        one does not delay the next."""
        cdr = stamped(size)
        metadata = Metadata(ROS, self._agent.id, 0, StreamData.manager, int(NodeType.SUBSCRIBER), node.name, TYPE)
        began, number = time.monotonic() + self._agent.id / (hz * 61), 0
        registrants = self.registrants[node.name]
        steady = self.steady[node.name]
        while (due := began + number / hz) < until:
            await asyncio.sleep(due - time.monotonic())
            STAMP.pack_into(cdr, AT, time.monotonic(), number)
            management = encode_management(StreamData({str(UNITY): sorted(registrants)}))
            message = encode_message(metadata.encode(), cdr)
            self._streams.publish(node.name, encode_frame(ROS, management=management, message=message))
            self.due[kind] += len(registrants & steady)
            number += 1


class Robots:
    """What the run asks of all robots together."""

    def __init__(self, agents: list[macs_zenoh.Agent]) -> None:
        self._times = Times()
        self._first = agents[0]
        self._robots = [Robot(agent, self._times) for agent in agents]

    async def count(self) -> Report:
        """How many headsets are online, and how many registrations hold."""
        registered = sum(len(names) for robot in self._robots for names in robot.registrants.values())
        return {"headsets": len(self._first.directory.ids(UNITY)), "registered": registered}

    async def settle(self) -> Report:
        """Whoever is registered now stays."""
        for robot in self._robots:
            robot.steady = {name: frozenset(each) for name, each in robot.registrants.items()}
        return {}

    async def run(self, until: float) -> Report:
        """Publish until then; how many messages were due to headsets, and the commands that came."""
        for robot in self._robots:
            robot.due.clear()
        await asyncio.gather(
            *(robot.publish(POSE, "pose", POSE_BYTES, POSE_HZ, until) for robot in self._robots),
            *(robot.publish(IMAGE, "image", IMAGE_BYTES, IMAGE_HZ, until) for robot in self._robots),
        )
        await asyncio.sleep(QUIET_S)
        due = sum((robot.due for robot in self._robots), Counter[str]())
        report, self._times = self._times.report(), Times()
        for robot in self._robots:
            robot._times = self._times
        return {"due": due, "times": report}

    async def dropped(self) -> Report:
        """What the robots' agents have lost, by name."""
        agents = [robot._agent for robot in self._robots]
        return {"dropped": sum((agent.drops + agent.mesh.drops for agent in agents), Counter[str]())}


async def robots(port: str, count: int) -> None:
    """Be the robots."""
    loop = asyncio.get_running_loop()
    async with AsyncExitStack() as stack:
        connect = [f"tcp/127.0.0.1:{port}"]
        joining = (macs_zenoh.join("ros", id=i, connect=connect) for i in range(1, count + 1))
        worker = Robots([await stack.enter_async_context(agent) for agent in joining])
        say({})
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            command = json.loads(line)
            say(await getattr(worker, command.pop("do"))(**command))


# -- headsets --------------------------------------------------------------------------------------------------------


class Watcher:
    """One headset: what it receives is cut into messages and timed when its last bytes are there."""

    def __init__(self, headset: Headset, robot: int, *, steady: bool = True) -> None:
        self.headset = headset
        self.robot = robot
        self.steady = steady
        """Whether it stays to the end, so that what it misses is lost."""
        self._begun = b""
        self._skip = 0
        self._open: tuple[str, float] | None = None
        self._last: dict[str, float] = {}

    def feed(self, piece: memoryview, now: float, times: Times) -> None:
        """Take what has come."""
        at, end = min(self._skip, len(piece)), len(piece)
        self._skip -= at
        if self._open is not None and not self._skip:
            self._note(self._open, now, times)
            self._open = None
        if self._begun:
            piece = memoryview(self._begun + piece[at:])
            at, end, self._begun = 0, len(piece), b""
        while at < end:
            body_at = at + 4 + _U32.unpack_from(piece, at)[0] if end - at >= 4 else end
            if body_at + 4 > end:
                break
            size = _U32.unpack_from(piece, body_at)[0]
            if end - body_at < 4 + min(size, AT + STAMP.size, ANSWER_BYTES):
                break
            stop = body_at + 4 + size
            found = self._read(piece, body_at + 4, size, stop <= end)
            if stop > end:
                self._skip, self._open = stop - end, found
                return
            if found is not None:
                self._note(found, now, times)
            at = stop
        self._begun = bytes(piece[at:])

    def _note(self, found: tuple[str, float], now: float, times: Times) -> None:
        kind, sent = found
        times.note(kind, sent, now)
        times.late[kind] += sent < self._last.get(kind, 0.0)
        self._last[kind] = sent

    def _read(self, piece: memoryview, at: int, size: int, whole: bool) -> tuple[str, float] | None:
        """Kind and time of a message of ours."""
        kind = _KINDS.get(size)
        if kind is not None:
            if not self.steady:
                kind += " of passers-by"
            return kind, STAMP.unpack_from(piece, at + AT)[0]
        if whole and size == ANSWER_BYTES and piece[at : at + 8] == b'{"sent":':
            return "request", json.loads(bytes(piece[at : at + size]))["sent"]
        return None


class Headsets:
    """What the run asks of all headsets together: those that stay, and with ``churn`` some that come and go."""

    def __init__(self, port: int, count: int) -> None:
        self._port = port
        self._count = count
        self._robots = 1
        self._watchers: list[Watcher] = []
        self._by_descriptor: dict[int, Watcher] = {}
        self._ready = select.epoll()
        self._buffer = memoryview(bytearray(RECEIVE_BYTES))
        self._passing: list[Watcher] = []

    def beat(self) -> None:
        """Heartbeats, where due."""
        for watcher in self._watchers:
            watcher.headset.beat()

    def join(self) -> Report:
        """All of them connect."""
        for i in range(self._count):
            self._enter(i)
        return {}

    def _enter(self, number: int, *, steady: bool = True) -> Watcher:
        watcher = Watcher(Headset.join(self._port, GROUP), number % self._robots + 1, steady=steady)
        self._watchers.append(watcher)
        self._by_descriptor[watcher.headset.socket.fileno()] = watcher
        self._ready.register(watcher.headset.socket, select.EPOLLIN)
        return watcher

    def register(self, robots: int) -> Report:
        """Each watches the pose of a robot; the first one of each robot its pictures too, and commands it."""
        self._robots = robots
        for number, watcher in enumerate(self._watchers):
            watcher.robot = number % robots + 1
            for node in (POSE, IMAGE, COMMAND) if number < robots else (POSE,):
                self._register(watcher, node)
        return {"registered": len(self._watchers) + 2 * min(robots, len(self._watchers))}

    def _register(self, watcher: Watcher, node: NodeSpec) -> None:
        watcher.headset.socket.sendall(frames.registration(watcher.headset.id, node, [watcher.robot], []))

    def leave(self) -> Report:
        """All of them are gone."""
        for watcher in self._watchers:
            self._close(watcher)
        self._watchers.clear()
        return {}

    def _close(self, watcher: Watcher) -> None:
        del self._by_descriptor[watcher.headset.socket.fileno()]
        self._ready.unregister(watcher.headset.socket)
        watcher.headset.socket.close()

    def run(self, until: float, mixed: bool) -> Report:
        """Send commands, and with ``mixed`` group messages and requests while others come and go; what was sent, and
        what came."""
        times, sent = Times(), Counter[str]()
        plans = [self._commands(sent)]
        if mixed:
            plans += [self._group_messages(sent), self._requests(sent), self._passers_by()]
        nexts = [time.monotonic()] * len(plans)
        last = time.monotonic()
        while (now := time.monotonic()) < until or now - last < QUIET_S:
            for i, (period_s, act) in enumerate(plans):
                if nexts[i] <= now < until:
                    act()
                    nexts[i] = max(nexts[i] + period_s, now - 0.1)
            wait_s = max(0.0, min(nexts) - time.monotonic()) if now < until else 0.05
            if self._receive(wait_s, times):
                last = time.monotonic()
            self.beat()
        while self._passing:
            self._pass()
        return {"sent": sent, "times": times.report()}

    def _receive(self, wait_s: float, times: Times) -> bool:
        events = self._ready.poll(wait_s)
        for descriptor, _ in events:
            watcher = self._by_descriptor[descriptor]
            got = watcher.headset.take(self._buffer)
            if not got:
                raise EOFError(f"headset {watcher.headset.id} was closed")
            watcher.feed(self._buffer[:got], time.monotonic(), times)
        return bool(events)

    def _commands(self, sent: Counter[str]) -> tuple[float, Any]:
        cdr = stamped(COMMAND_BYTES)
        commanders = [
            (watcher.headset, bytearray(frames.node_data(watcher.headset.id, COMMAND, cdr, [watcher.robot])))
            for watcher in self._watchers[: self._robots]
        ]
        turn = 0

        def act() -> None:
            nonlocal turn
            headset, frame = commanders[turn % len(commanders)]
            STAMP.pack_into(frame, len(frame) - len(cdr) + AT, time.monotonic(), turn)
            headset.socket.sendall(frame)
            sent["command"] += 1
            turn += 1

        return 1 / (COMMAND_HZ * len(commanders)), act

    def _group_messages(self, sent: Counter[str]) -> tuple[float, Any]:
        first, cdr = self._watchers[0].headset, stamped(GROUP_BYTES)
        others = sum(watcher.steady for watcher in self._watchers) - 1

        def act() -> None:
            STAMP.pack_into(cdr, AT, time.monotonic(), 0)
            first.socket.sendall(
                frames.plain_data(first.id, bytes(cdr), to_type=UNITY, groups=[GROUP], request_id=4_000_000)
            )
            sent["group"] += others

        return 1 / GROUP_HZ, act

    def _requests(self, sent: Counter[str]) -> tuple[float, Any]:
        asker = self._watchers[-1]
        assert asker.steady

        def act() -> None:
            data = json.dumps({"sent": round(time.monotonic(), 6)}, separators=(",", ":")).ljust(ANSWER_BYTES).encode()
            sent["request"] += 1
            asker.headset.socket.sendall(
                frames.plain_data(
                    asker.headset.id, data, to_type=ROS, ids=[asker.robot], request_id=sent["request"] % 1_000_000 + 1
                )
            )

        return 1 / REQUEST_HZ, act

    def _passers_by(self) -> tuple[float, Any]:
        """Each second one comes and watches a robot, and after three seconds it is gone."""

        def act() -> None:
            if len(self._passing) == 3:
                self._pass()
            came = self._enter(len(self._passing), steady=False)
            self._register(came, POSE)
            self._passing.append(came)

        return 1.0, act

    def _pass(self) -> None:
        gone = self._passing.pop(0)
        self._close(gone)
        self._watchers.remove(gone)


def main() -> None:
    """Run the worker."""
    kind, port, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    if kind == "robots":
        uvloop.run(robots(port, count))
        return
    headsets = Headsets(int(port), count)
    works = {name: getattr(headsets, name) for name in ("join", "register", "leave", "run")}
    serve({}, works, headsets.beat)


if __name__ == "__main__":
    main()
