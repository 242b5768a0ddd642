"""From TCP agents to the mesh: what a connection sent goes on the keys of its destinations.

Frames that one read of a socket brought and that go the same way are put as one sample, since a put costs more than a
frame. What agents of this gateway get of it they get as it was judged here.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from macs_zenoh.mesh import Mesh, Payload, Traffic
from macs_zenoh.presses import GOES, STOP_NAME, WAITS, WAITS_INSTEAD, Presses
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.existing import asks
from macs_zenoh.protocol.guard import STOP_TYPES
from macs_zenoh.protocol.halts import halts, may_halt
from macs_zenoh.protocol.messages import ROS, Metadata, NodeType
from macs_zenoh.protocol.rate_limit import Passing
from macs_zenoh.protocol.routing import stream_key
from macs_zenoh.protocol.tcp_agent import Sent, Streamed

from .afar import Afar
from .agents import Agents
from .backpressure import ROBOT_HOLD_S, Backpressure
from .command_counts import CommandCounts
from .connection import Connection
from .judged import JudgedFrames, Read
from .latest import Latest
from .questions import Questions
from .routes import Route, Routes

PUBLISHER = int(NodeType.PUBLISHER)
STOP_BYTES = 64
"""A message of std_msgs/Bool has 5; what is larger is none, and counts as other commands do."""
SLOWED_EACH_S, SLOWED_S = 0.02, 0.25
"""So long for each who floods now nobody of them is read from, and so long at most: a headset may freeze."""

COMMAND, CALL, STREAM = Traffic.COMMAND, Traffic.CALL, Traffic.STREAM  # a Python call otherwise, for each message


@dataclass
class Run:
    """Frames of one connection that go the same way, gathered within one read of its socket."""

    keys: list[str]
    traffic: Traffic
    read: Read = field(default_factory=list)
    bytes: int = 0
    readable: bool = True
    """Whether all of them may go to existing programs as they are."""


OnNoRouter = Callable[[Connection, Metadata, list[int]], None]


class Forwarding:
    """For all connections of a gateway; within one read of a socket, for that connection. ``on_no_router`` hears of
    commands that go nowhere: whose, of what, and to which robots."""

    def __init__(
        self, mesh: Mesh, agents: Agents, directory: Directory, judged: JudgedFrames, on_no_router: OnNoRouter
    ) -> None:
        self._mesh = mesh
        self._on_no_router = on_no_router
        self._directory = directory
        self._judged = judged
        self._routes: dict[Connection, Routes] = {}
        self.afar = Afar(mesh, agents, directory, lambda connection, agent: self._routes[connection].reach(agent))
        self._slowed = self.afar.slowed
        self._runs: dict[str, Run] = {}
        """By where they go, in the order in which they began."""
        self._apart = True
        """Whether no two of them can have a receiver in common, so that their order does not matter."""
        self._latest = Latest(lambda route, newest: self._put(route.keys, newest.frame.data, COMMAND))
        self._counts = CommandCounts(mesh, directory)
        self._presses = Presses(mesh, directory)
        self._questions = Questions()
        self._flooding: dict[Connection, float] = {}
        """Who is not read from for having flooded, and until when."""
        self._backpressure = Backpressure()
        mesh.on_room(self._backpressure.release)
        self._streams = Backpressure()
        """Of robot programs whose large topic data waits."""
        mesh.streams.on_room(self._streams.release)

    def enter(self, connection: Connection) -> None:
        """A connection has an id."""
        self._routes[connection] = Routes(self._directory, self._mesh.limited, time.monotonic())

    def leave(self, connection: Connection) -> None:
        """It has ended."""
        self._latest.go(connection)
        self._presses.leave(connection.key)
        self._questions.leave(connection)
        self._flooding.pop(connection, None)
        self._routes.pop(connection, None)
        self.afar.leave(connection)

    def sleeps(self, connection: Connection) -> None:
        """Its socket has ended: nothing newer comes for now."""
        self.flush()
        self._latest.go(connection)
        self._questions.leave(connection)
        self._flooding.pop(connection, None)

    def never_mind(self, connection: Connection) -> None:
        """It was no agent of its own."""
        self._routes.pop(connection, None)

    def close(self) -> None:
        """Nothing is forwarded any more."""
        self._latest.close()
        self._counts.close()
        self._questions.close()
        self._presses.close()

    def forget(self, connection: Connection) -> None:
        """It is about to have another id: what it sent goes under the one that it had."""
        self.flush()
        self._latest.go(connection)
        self._presses.leave(connection.key)
        self._routes[connection].forget()

    def forward(self, connection: Connection, sent: Sent) -> None:
        """Put a frame on the keys of its destinations, at the latest with the next `finish`."""
        frame = sent.frame
        route = self._routes[connection].find(frame.destination)
        if route is None:
            route = self._work_out(connection, sent)
        if not route.keys:
            if not route.left_out:
                connection.complain("no_destination", "a message names no agent and no group", frame.count)
            return
        for agent in route.agents:
            if agent not in self._directory:
                problem = f"a message goes to {AgentId(*agent)}, not online"
                connection.complain("unknown_agent", problem, frame.count)
        metadata = sent.metadata
        traffic = COMMAND if metadata.node_type == PUBLISHER else CALL
        if traffic is CALL and (metadata.node_type or metadata.message_manager) and asks(metadata):
            connection.recipient.asks(metadata, frame.header)
        if route.to_robots:
            going = self._may_go(connection, sent, route, traffic)
            if going is None:
                return
            sent = going
        if route.limited:
            self.flush()
            self._put_singly(route.keys, sent, traffic)
        else:
            self._gather(connection, route.name, route.keys, sent, traffic, apart=route.apart)

    def stream(self, connection: Connection, event: Streamed) -> None:
        """Put a robot program's topic data where its registrants listen."""
        key = stream_key(ROS, connection.agent_id, event.metadata.node_name or "_")
        sent = Sent(event.frame, event.metadata, event.readable)
        if self._mesh.limited(key):
            self.flush()
            self._put_singly([key], sent, STREAM)
        else:
            self._gather(connection, key, [key], sent, STREAM, apart=False)

    def answered(self, connection: Connection, number: int) -> None:
        """What comes from now on was said after this question."""
        self._questions.answered(connection, number)

    def finish(self, connection: Connection) -> None:
        """All that one read of a socket brought is forwarded."""
        if self._runs:
            self.flush()
        if connection.drives:
            return
        if self._slowed and connection in self._slowed:
            self.afar.has_read(connection)
        if self._mesh.streams.backlogged and connection.peer.agent_type == ROS:
            self._streams.hold(connection, self._mesh.streams.sent, ROBOT_HOLD_S)
        if self._mesh.backlogged:
            self._backpressure.hold(connection, self._mesh.backlog_sent)

    def flush(self) -> None:
        """Put what is gathered."""
        runs, self._runs, self._apart = self._runs, {}, True
        for run in runs.values():
            read = run.read
            payload = read[0][0].data if len(read) == 1 else b"".join([frame.data for frame, _ in read])
            self._put(run.keys, payload, run.traffic, read if run.readable else None)

    def _work_out(self, connection: Connection, sent: Sent) -> Route:
        route = self._routes[connection].work_out(sent.frame, connection.key, time.monotonic())
        if route.left_out:
            problem = "it sends to many agents that are not online, or groups that it never named: left out"
            connection.complain("too_many_strangers", problem, route.left_out)
        return route

    def _gather(
        self, connection: Connection, name: str, keys: list[str], sent: Sent, traffic: Traffic, *, apart: bool
    ) -> None:
        size = len(sent.frame.data)
        run = self._runs.get(name)
        if run is None or run.traffic is not traffic or run.bytes + size > Mesh.LARGE_BYTES:
            if self._runs and (run is not None or not (apart and self._apart)):
                self.flush()
            run = self._runs[name] = Run(keys, traffic)
            self._apart = apart
        run.read.append((sent.frame, sent.metadata))
        run.bytes += size
        if not sent.readable or sent.metadata.sender_agent_id != connection.agent_id:  # judged under its former id
            run.readable = False

    def _put_singly(self, keys: list[str], sent: Sent, traffic: Traffic) -> None:
        """Where a traffic rule limits what goes there, messages count one by one."""
        for single in sent.frame.each():
            self._put(keys, single.data, traffic)

    def _put(self, keys: list[str], payload: Payload, traffic: Traffic, read: Read | None = None) -> None:
        mesh = self._mesh
        before = mesh.looped
        for key in keys:
            if traffic is STREAM:
                mesh.streams.put(key, payload)
            elif mesh.put(key, payload, traffic) and traffic is COMMAND:
                self._counts.put(key)
        copies = mesh.looped - before
        if copies:
            if read is not None:
                self._judged.note(payload, read, copies, alone=not before)
            mesh.make_room()

    def _may_go(self, connection: Connection, sent: Sent, route: Route, traffic: Traffic) -> Sent | None:
        """What of a frame to robots goes on now; a command that has waited may, after all that came with it."""
        now, count, size, metadata = time.monotonic(), sent.frame.count, len(sent.frame.data), sent.metadata
        if traffic is COMMAND and not self._mesh.linked:
            self._goes_nowhere(connection, metadata, route)
        if traffic is not COMMAND:
            passing = connection.pace.request(count, now, size)
        elif metadata.data_exchange_type in STOP_TYPES and len(sent.frame.last.body) <= STOP_BYTES:
            waits = metadata.node_name == STOP_NAME and self._waits_for_stop(connection, sent, route)
            return None if waits else sent
        else:
            passing = connection.pace.command((sent.frame.destination, metadata.node_name), count, now, size)
        if passing is Passing.FLOODED:
            halt = self._halt(connection, sent, passing, now) if traffic is COMMAND else None
            lost = count - (halt is not None)
            if lost:
                connection.complain("flooded", "it sends robots more than one agent may", lost)
            self._slow_down(connection, now)
            connection.peer.floods |= traffic is COMMAND
            return halt
        if traffic is COMMAND:
            connection.drove_at = now
            self._questions.drives(connection)
            return self._newest(connection, sent, route, passing, now)
        return sent

    def _goes_nowhere(self, connection: Connection, metadata: Metadata, route: Route) -> None:
        """There is no router: whoever is not at this gateway gets no command. The mesh counts those."""
        robots = [number for kind, number in route.agents if kind == ROS and not self._is_here(kind, number)]
        if robots or not route.agents:
            self._on_no_router(connection, metadata, robots)

    def _is_here(self, kind: int, number: int) -> bool:
        agent = self._directory.get(kind, number)
        return agent is not None and agent.zid == self._mesh.zid

    def _newest(self, connection: Connection, sent: Sent, route: Route, passing: Passing, now: float) -> Sent | None:
        """What of commands goes on now. Of those that have waited the newest is kept, and goes on before one that has
        not."""
        kind = sent.frame.destination, sent.metadata.node_name
        if passing is Passing.NOW:
            self._latest.follow(connection, kind)
            return sent
        if passing is Passing.TOO_OLD:
            halt = self._halt(connection, sent, passing, now)
            old = sent.frame.count - (halt is not None)
            if old:
                connection.complain("too_old", "commands that may have waited in its connection", old)
            return halt
        older = sent.frame.count - 1
        older += self._latest.hold(connection, kind, route, Sent(sent.frame.last, sent.metadata, sent.readable))
        if older:
            connection.complain("too_old", "commands that waited with newer ones", older)
        return None

    def _halt(self, connection: Connection, sent: Sent, passing: Passing, now: float) -> Sent | None:
        """Of commands that do not go on, the newest that says to stand still does: nobody may say it again. What waits
        of the same kind is older. Of a flood only the last is looked at."""
        metadata = sent.metadata
        if not may_halt(metadata.data_exchange_type):
            return None
        frames = sent.frame.each() if passing is Passing.TOO_OLD else (sent.frame.last,)
        halt = next((frame for frame in reversed(frames) if halts(metadata.data_exchange_type, frame.body)), None)
        if halt is None or (passing is Passing.FLOODED and not connection.pace.halt(now)):
            return None
        if self._latest.drop(connection, (sent.frame.destination, metadata.node_name)):
            connection.complain("too_old", "a command that waited with newer ones")
        return Sent(halt, metadata, sent.readable)

    def _slow_down(self, connection: Connection, now: float) -> None:
        """What is dropped has to be read first, which costs others the time of the loop: all who flood have a small
        part of it together."""
        self._flooding = {each: until for each, until in self._flooding.items() if until > now}
        hold_s = min(SLOWED_S, SLOWED_EACH_S * (1 + len(self._flooding)))
        if connection.slow_down(hold_s):
            self._flooding[connection] = now + hold_s

    def _waits_for_stop(self, connection: Connection, sent: Sent, route: Route) -> bool:
        """Whether a release, or what else may be on that topic, goes on later."""
        looked = self._presses.look(
            connection.key,
            sent.frame.header,
            bytes(sent.frame.last.body[:5]),
            lambda: self._put(route.keys, sent.frame.data, COMMAND),
        )
        if looked not in (GOES, WAITS):
            connection.complain("too_old", "a release that waited for a stop to be answered, and what came after it")
        return looked in (WAITS, WAITS_INSTEAD)
