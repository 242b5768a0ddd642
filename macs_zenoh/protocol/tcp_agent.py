"""One TCP agent, as a gateway sees it: bytes in, events and bytes out, time passed in. No socket, no clock.

::

    GREETED ── configuration ──> ONLINE ── go-offline, silence, fatal error ──> GONE
       └────────────── handshake limit, fatal error ─────────────────────────────┘

The connection's own id is the truth. What the agent's JSON says about its sender is corrected where it differs:
existing headsets send id 0 from nodes made before the handshake and old ids from nodes kept across a reconnect.
Frames that come before the configuration are held until it is there, because headsets do send registrations first.
One state machine, so one module: what each step may do depends on what the others have seen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from enum import Enum
from typing import NamedTuple

from msgspec import Struct, structs

from ..errors import BadField, BadJson, NotAdmitted, NotAllowed, NotPermitted, TooFast, UnknownManager, WireError
from . import greetings
from .credit import Credit
from .decoders import FrameDecoder
from .guard import COMMAND, is_press
from .halts import HALTS_PER_S, halts
from .judging import Judge
from .limits import (
    CONFIGURATION_BYTES,
    MANAGEMENT_BYTES,
    NAME_BYTES,
    NODE_AGENTS,
    NODES_EACH,
    PARTIAL_BYTES_PER_S,
    PARTIAL_WINDOW_S,
    REASON_CHARACTERS,
)
from .messages import (
    NO_CUSTOM,
    OPERATOR,
    ROS,
    UNITY,
    AddNode,
    Configuration,
    Custom,
    Functionality,
    GoOffline,
    Heartbeat,
    Management,
    Metadata,
    NodeRefused,
    OnlineRequest,
    Registration,
    RemoveNode,
    StreamData,
    Welcome,
    decode_data,
    decode_management,
)
from .recency import QUESTIONS, Recency
from .recipient import Recipient, to_agent
from .rights import OPEN, Grant, Rights
from .wire import MACS, MAX_FRAME_BYTES, Frame, Frames, Header, Layout, encode_frame, parse_frame


class State(Enum):
    """Where an agent stands."""

    GREETED = "greeted"
    ONLINE = "online"
    GONE = "gone"


GREETED, ONLINE, GONE = State  # a member of an Enum is looked up by a Python call, for each message


class Limits(NamedTuple):
    """What one TCP agent may cost, and how long it may be silent."""

    max_frame_bytes: int = MAX_FRAME_BYTES
    handshake_timeout_s: float = 10.0
    idle_timeout_s: float = 60.0
    held_frames: int = 256
    held_bytes: int = 1 << 20
    frames_per_s: float = 0.0
    """Frames of any kind beyond this rate (a second's worth at once) are dropped; 0 is no limit."""
    partial_bytes_per_s: float = PARTIAL_BYTES_PER_S
    """What comes of a frame that has begun must not be less, over ``partial_window_s``."""
    partial_window_s: float = PARTIAL_WINDOW_S


DEFAULT_LIMITS = Limits()


class Joined(NamedTuple):
    """The agent told its type and group, for the first time or differently than before."""

    agent_type: int
    group: int
    functionality: Functionality | None


class Sent:
    """A frame for other agents, or a run of them. Its sender is true. ``readable``: existing programs find in its
    metadata what we find."""

    __slots__ = ("frame", "metadata", "readable")

    def __init__(self, frame: Frames, metadata: Metadata, readable: bool = False) -> None:
        self.frame = frame
        self.metadata = metadata
        self.readable = readable


class Streamed(NamedTuple):
    """Topic data of a robot, for the registrants in ``targets``: (type, id) each."""

    frame: Frames
    metadata: Metadata
    readable: bool
    targets: list[tuple[int, int]]


class Registering(NamedTuple):
    """The agent registers on, or leaves, an interface node of these robots and groups of robots."""

    node: AddNode | RemoveNode
    robot_ids: list[int]
    groups: list[int]


class Answered(NamedTuple):
    """The agent has answered a later welcome: whatever comes behind this it said after that was sent."""

    number: int


class AskedOnline(NamedTuple):
    """The agent asks who is online; the answer carries this request id."""

    request_id: int


class Asked(NamedTuple):
    """A management message for a manager that somebody added."""

    manager: str
    data: Struct
    request_id: int


class RegistrationRefused(NamedTuple):
    """A registration was not accepted, for the agent to be told; a `Rejected` is beside it."""

    refused: NodeRefused


class Forbidden(NamedTuple):
    """A message was not let pass by the rights of the agent's token, for it to be told; a `Rejected` is beside it."""

    metadata: Metadata
    robots: tuple[int, ...]
    """Whom it named, if these were robots."""
    reason: str


class NotLetIn(NamedTuple):
    """The agent showed no valid token where one is wanted, for it to be told; a `Left` follows."""


class Withdrawn(NamedTuple):
    """Registrations that the rights of the agent's token, as they are now, do not permit any more."""

    nodes: list[tuple[AddNode, str]]
    """Each with the reason."""


class Rejected(NamedTuple):
    """A frame was not accepted. The connection goes on unless a `Left` follows."""

    error: WireError


class Failed(NamedTuple):
    """A frame, or a run of them, could not be read for a reason that nobody thought of."""

    error: Exception
    frames: int


class Left(NamedTuple):
    """The agent is gone; ``reason`` is for the log. Close the connection."""

    reason: str
    silent: bool = False
    """Whether nothing is wrong but that it says nothing: its network may be gone."""


class Resumed(NamedTuple):
    """The agent is one that was here before, over another connection: from now on it has that one's id and all else
    that was its own. ``spare_id`` and ``spare_credit`` are what it had until now."""

    former: TcpAgent
    spare_id: int
    spare_credit: Credit
    received: int
    """How many messages of its session it has."""
    heard: int
    """How many frames of it had come, without what follows in the same read."""


class NotResumed(NamedTuple):
    """The agent showed the secret of no session, or of none that is its own."""


class Arrived(NamedTuple):
    """The agent has so many messages of its session."""

    received: int


Event = (
    Joined
    | Sent
    | Streamed
    | Registering
    | Answered
    | AskedOnline
    | Asked
    | RegistrationRefused
    | Forbidden
    | NotLetIn
    | Withdrawn
    | Resumed
    | NotResumed
    | Arrived
    | Rejected
    | Failed
    | Left
)

Admit = Callable[[str | None], Grant | None]
"""What somebody gets who shows this token, or none; None: it is not let in."""

Resume = Callable[[str, Grant, int], "TcpAgent | None"]
"""Who was here before with this session's secret, if whoever shows it has the same token and is of the same type."""

STRANGER_HELD_BYTES = 64 << 10
"""What may wait of somebody who has yet to show a token: less than of an agent."""


class TcpAgent:
    """The protocol of one TCP agent.

    ``drops`` counts, by name, what was not passed on; ``corrected`` counts frames whose sender had to be put right.
    """

    STOPS_PER_S = 20
    """Presses of a stop that pass beyond a rate limit."""
    TOPICS = 128
    TOPIC_BYTES = 1024
    """So many lists of a topic's registrants are remembered, if they are not longer."""
    PERMITTED = 1024
    """So many kinds of frames are remembered as permitted, or not, by the rights of a token."""

    returns = False
    """Whether the agent says that it comes back when its connection ends."""
    heard = 0
    """How many frames of its session have come: all but the first configuration on each connection."""
    grant: Grant = OPEN
    _rights: Rights | None = None
    agent_type = 0
    group = 0
    extensions = 0
    """Version of our extensions that the agent says it understands; 0 is an existing program."""
    functionality: Functionality | None = None
    """What a robot last said that it offers."""
    state = GREETED
    corrected = 0
    floods = False
    """Whether it sends robots more commands than it may: those are dropped unread, until whoever set this resets
    it."""
    partial_bytes = 0
    """How much memory a frame has that has begun and is not whole."""
    _held_bytes = 0
    _partial_since: float | None = None
    _partial_begun = 0

    def __init__(
        self,
        agent_id: int,
        connection_number: int,
        now: float,
        *,
        limits: Limits = DEFAULT_LIMITS,
        custom: Mapping[str, type[Struct]] = NO_CUSTOM,
        layout: Layout = MACS,
        scratch: bytearray | None = None,
        credit: Credit | None = None,
        closed_groups: Collection[int] = (),
        admit: Admit | None = None,
        stranger: bool = False,
        recipient: Recipient | None = None,
        resume: Resume | None = None,
        members: Callable[[int], Collection[int]] | None = None,
    ) -> None:
        """``credit`` is what an earlier connection left, if there was one; ``closed_groups`` are not to be chosen.
        ``admit`` judges the token in the first configuration; without it whoever comes is let in. ``stranger``: a
        token is wanted, and until it is shown less may be said. ``resume`` finds who comes back with a session's
        secret; without it nobody is expected back. ``members`` has the robots in a group."""
        self._closed_groups = closed_groups
        self._admit = admit
        self._resume = resume
        self._members = members
        self._permitted: dict[tuple[bytes, int, str, str], str | None] = {}
        """Of an agent with a token: why what goes there, and is that, may not go on."""
        self._questions: list[int] = []
        """What it was asked last and has not answered."""
        self._registered: dict[tuple[int, str], Registering] = {}
        """Of an agent with a token: what it registered, by node type and name, and where."""
        self._refused_at: dict[tuple[int, str], set[int]] = {}
        """Of these, which robots refused which."""
        self.agent_id = agent_id
        self.former_ids: set[int] = set()
        self.connection_number = connection_number
        self.drops: Counter[str] = Counter()
        self._limits = limits
        self._custom = custom
        self.recipient = recipient or Recipient()
        """What may be said to the agent."""
        self.credit = credit or Credit(limits.frames_per_s, now)
        self._layout = layout
        self._decoder = FrameDecoder(limits.max_frame_bytes, layout, scratch)
        if stranger:  # a frame behind its configuration may have come with it: its size is judged as an agent's
            self._limits = limits._replace(held_bytes=min(limits.held_bytes, STRANGER_HELD_BYTES))
        self._held: list[Frames] = []
        self._stops = Credit(self.STOPS_PER_S, now)
        self._halts = Credit(HALTS_PER_S, now)
        self._connected_at = now
        self._heard_at = now
        self._judge = Judge(0, agent_id)
        self._topics: dict[bytes, StreamData] = {}
        """Of a robot: management data that was read, by its bytes."""

    def __repr__(self) -> str:
        return f"agent {self.agent_id} ({self.state.value})"

    # -- out -----------------------------------------------------------------------------------------------------

    def welcome(self, number: int = 0) -> bytes:
        """The first message on every connection; agents give up when anything else comes before it. A headset takes a
        later one as its new id, and answers again; with a ``number`` (`recency`) it is `Answered`."""
        if number:
            self._questions = [*self._questions[1 - 2 * Recency.OPEN :], number]
        return to_agent(Welcome(agent_id=self.agent_id), request_id=number or self.connection_number)

    @property
    def dials_a_router(self) -> bool:
        """Whether this is a Zenoh program that has come to the wrong port."""
        return greetings.begins_as_client(self._decoder.begun_header)

    def renumber(self, agent_id: int) -> None:
        """From now on the agent has another id. `welcome` tells it; until it has read that it uses the former one."""
        self.former_ids.add(self.agent_id)
        self.agent_id = agent_id
        self._judge = Judge(self.agent_type, agent_id)

    # -- in ------------------------------------------------------------------------------------------------------

    def space(self) -> memoryview:
        """Where the next received bytes belong; then call `advance`."""
        return self._decoder.space()

    def advance(self, size: int, now: float) -> Iterator[Event] | None:
        """``size`` bytes were received into `space`. Frames are read as their events are asked for: whoever asks may
        do other things between them, and receive more, whose events come behind these. None: no frame is whole."""
        if self.state is GONE:
            return None
        self._heard_at = now
        decoder = self._decoder
        frames = decoder.advance(size)
        begun, self.partial_bytes = decoder.begun, decoder.partial_bytes
        if not begun:
            self._partial_since = None
        elif self._partial_since is None or begun < self._partial_begun:  # a new one
            self._partial_since, self._partial_begun = now, begun
        return self._read(frames, decoder.error, now) if frames or decoder.error is not None else None

    def _read(self, frames: list[Frames | WireError], error: WireError | None, now: float) -> Iterator[Event]:
        """The events of frames, behind which there is maybe one that ends it all."""
        for frame in frames:
            if self._gone():
                return
            events: list[Event] = []
            try:
                self._read_frame(frame, now, events)
            except Exception as fault:  # noqa: BLE001 - ours to mend; it costs no other frame that came with this one
                events.append(Failed(fault, 1 if isinstance(frame, WireError) else frame.count))
            yield from events
        if error is not None and not self._gone():
            self.drops["FrameTooLarge"] += 1
            yield Rejected(error)
            yield self._leave("its next frame cannot be found")

    def _read_frame(self, frame: Frames | WireError, now: float, events: list[Event]) -> None:
        if isinstance(frame, WireError):
            self.heard += self.state is ONLINE
            self._reject(frame, 1, events)
            return
        if self.state is ONLINE:
            self.heard += frame.count
        try:
            if (self._limits.frames_per_s or self.grant.credit is not None) and not self._covered(frame, now):
                self._too_fast(frame, now, events)
            elif self.state is ONLINE and not frame.has_management:
                if self.floods and self._is_one_more(frame):
                    self.drops["flooded"] += frame.count
                else:
                    self._send(frame, events)
            else:
                self._frame(frame, events)
        except NotPermitted as error:
            self._forbid(error, frame, events)
        except WireError as error:
            self._reject(error, frame.count, events)

    def receive(self, data: bytes, now: float) -> list[Event]:
        """The same for bytes that are already somewhere."""
        events: list[Event] = []
        view = memoryview(data)
        while len(view):
            space = self.space()
            size = min(len(space), len(view))
            space[:size] = view[:size]
            del space
            events += self.advance(size, now) or ()
            view = view[size:]
        return events

    @property
    def heard_at(self) -> float:
        """When anything was last heard of the agent."""
        return self._heard_at

    def next_deadline(self) -> float:
        """When `tick` is due at the latest."""
        if self.state is GREETED:
            return self._connected_at + self._limits.handshake_timeout_s
        due = self._heard_at + self._limits.idle_timeout_s
        if self._partial_since is not None:
            return min(due, self._partial_since + self._limits.partial_window_s)
        return due

    def tick(self, now: float) -> list[Event]:
        """Judge the time that has passed."""
        if self.state is GONE or now < self.next_deadline():
            return []
        if self.state is GREETED:
            return [self._leave(f"no configuration within {self._limits.handshake_timeout_s:g} s")]
        if now >= self._heard_at + self._limits.idle_timeout_s:
            return [self._leave(f"silent for {self._limits.idle_timeout_s:g} s")._replace(silent=True)]
        return self._judge_partial(now)

    def _judge_partial(self, now: float) -> list[Event]:
        """A frame had its time to come on."""
        begun, window_s = self._decoder.begun, self._limits.partial_window_s
        if begun - self._partial_begun < window_s * self._limits.partial_bytes_per_s:
            self.drops["unfinished_frame"] += 1
            return [self._leave(f"of a frame {begun} bytes have come, and next to nothing for {window_s:g} s")]
        self._partial_since, self._partial_begun = now, begun
        return []

    def lost(self) -> None:
        """The connection has ended."""
        self.state = GONE
        self._forget_owner()
        self.recipient.lost()

    def _forget_owner(self) -> None:
        """It knows the connection: a circle, which would keep a frame's megabytes for a while."""
        self._admit = self._resume = None

    # -- frames --------------------------------------------------------------------------------------------------

    def _reject(self, error: WireError, count: int, events: list[Event]) -> None:
        self.drops[type(error).__name__] += count
        # where it was raised leads to the frame, and back here through ``events``: a circle, which would keep the
        # frame's megabytes until Python looks for circles
        error.__traceback__ = error.__cause__ = error.__context__ = None
        events.append(Rejected(error))

    def _forbid(self, error: NotPermitted, frame: Frames, events: list[Event]) -> None:
        told = bool(events) and isinstance(events[-1], RegistrationRefused)
        self._reject(error, frame.count, events)
        if told:
            return
        metadata, header = Metadata(), frame.header
        with suppress(WireError):
            metadata = Metadata.decode(frame.metadata)
        robots = header.ids if header.agent_type == ROS and not frame.has_management else ()
        events.append(Forbidden(metadata, robots, str(error)))

    def _covered(self, frame: Frames, now: float) -> bool:
        """Whether the rate limits let a frame pass. Each counts, but not what the gateway asked for: the one that
        configures the agent, and the first answer to each question (`recency`)."""
        greeted = self.state is GREETED
        if frame.has_management and (greeted or self._questions):
            management = self._management(frame)
            if isinstance(management, Configuration):
                if greeted:
                    return True
                if management.request_id in self._questions:
                    self._questions.remove(management.request_id)
                    return True
        limited, shared = self._limits.frames_per_s, self.grant.credit
        return (not limited or self.credit.take(frame.count, now)) and (
            shared is None or shared.take(frame.count, now)
        )

    def _too_fast(self, frame: Frames, now: float, events: list[Event]) -> None:
        """A frame beyond the rate limit is dropped, but who leaves may say so, and who may stops a robot. A
        registration is answered, which a topic's data cannot be."""
        if self.state is ONLINE and self._presses(frame, now, events):
            return
        error = TooFast(self._limits.frames_per_s or (self._rights.frames_per_s if self._rights else 0))
        if frame.has_management:
            with suppress(BadJson, BadField, UnknownManager):
                management = self._management(frame)
                if isinstance(management, GoOffline):
                    self._frame(frame, events)
                    return
                if isinstance(management, Registration):
                    events.append(_refusal(management, error))
        raise error

    def _presses(self, frame: Frames, now: float, events: list[Event]) -> bool:
        """Let a press of an emergency stop pass, or a velocity of zero, a few of each in a second; whether it was
        one."""
        if not isinstance(frame, Frame) or frame.has_management or not frame.metadata:
            return False  # who is held to a rate sends no runs
        metadata = Metadata.decode(frame.metadata)
        if is_press(metadata, frame.body):
            credit = self._stops
        elif metadata.node_type == COMMAND and halts(metadata.data_exchange_type, frame.body):
            credit = self._halts
        else:
            return False
        if not credit.take(1, now):
            return False
        self._send(frame, events)
        return True

    def _management(self, frame: Frames) -> Management | Custom:
        raw = frame.management
        topic = self._topics.get(raw)
        if topic is not None:
            return topic
        most = CONFIGURATION_BYTES if self.state is GREETED else MANAGEMENT_BYTES
        management = decode_management(raw, self._custom, most)
        if isinstance(management, StreamData) and len(raw) <= self.TOPIC_BYTES:
            if len(self._topics) >= self.TOPICS:
                self._topics.clear()
            self._topics[raw] = management
        return management

    def _read_management(self, frame: Frame, events: list[Event]) -> Management | Custom:
        """The same; who meant to register hears why it cannot be read."""
        try:
            return self._management(frame)
        except WireError as error:
            if Registration.manager.encode() in frame.management:
                events.append(_refusal(None, error))
            raise

    def _frame(self, frame: Frames, events: list[Event]) -> None:
        if isinstance(frame, Frame) and frame.has_management:
            management = self._read_management(frame, events)
            if isinstance(management, Configuration):
                self._configure(management, events)
                return
            if isinstance(management, Heartbeat):
                if management.received is not None:
                    events.append(Arrived(management.received))
                return
            if isinstance(management, GoOffline):
                self._go_offline(management, events)
                return
            if self.state is ONLINE:
                try:
                    events.append(self._manage(management, frame))
                except WireError as error:
                    if isinstance(management, Registration):
                        events.append(_refusal(management, error))
                    raise
                return
        elif self.state is ONLINE:
            self._send(frame, events)
            return
        self._hold(frame)

    def _hold(self, frame: Frames) -> None:
        if len(self._held) >= self._limits.held_frames or self._held_bytes + len(frame.data) > self._limits.held_bytes:
            self.drops["before_configuration"] += frame.count
            return
        self._held.append(frame)
        self._held_bytes += len(frame.data)

    def _configure(self, configuration: Configuration, events: list[Event]) -> None:
        """The first configuration counts, whatever id and request it names; a later one may change the group."""
        kind, group = configuration.agent_type, configuration.group_id
        if kind == 0:
            raise BadField("configuration", "agent type 0 is no agent")
        if kind == OPERATOR:
            raise NotAllowed("operators come over Zenoh, where a router can check who they are")
        if self.state is ONLINE and kind != self.agent_type:
            raise NotAllowed(f"a configured agent of type {self.agent_type} cannot become type {kind}")
        if self.state is GREETED and not self._let_in(configuration, events):
            return
        if self.state is GREETED:
            self._look_for_session(configuration, events)
        same = configuration.extensions == self.extensions
        if group in self._closed_groups:
            self._reject(NotAllowed(f"group {group} is not to be chosen from there (gateway.groups)"), 1, events)
            group = 0
        if self._rights is not None and not self._rights.may_be_in(group):
            error = NotPermitted(f"group {group} is not among the groups of this token")
            self._reject(error, 1, events)
            events.append(Forbidden(Metadata(), (), str(error)))
            group = 0
        self.extensions = configuration.extensions
        self.functionality = configuration.functionality or self.functionality
        if self.state is ONLINE and configuration.request_id > QUESTIONS:
            events.append(Answered(configuration.request_id))
        if self.state is ONLINE and group == self.group and same:
            return
        self.state = ONLINE
        # a rate limit is for each frame
        self._decoder.runs = not self._limits.frames_per_s and self.grant.credit is None
        if kind != self.agent_type:
            self._judge = Judge(kind, self.agent_id)
        self.agent_type, self.group = kind, group
        self.recipient.configured(kind, existing=not self.extensions)
        events.append(Joined(kind, group, configuration.functionality))
        held, self._held, self._held_bytes = self._held, [], 0
        for frame in held:
            try:
                self._frame(frame, events)
            except NotPermitted as error:
                self._forbid(error, frame, events)
            except WireError as error:
                self._reject(error, 1, events)
            except Exception as error:  # noqa: BLE001 - as in `_read`
                events.append(Failed(error, frame.count))

    def _let_in(self, configuration: Configuration, events: list[Event]) -> bool:
        """Judge the token that an agent shows, or does not show."""
        if self._admit is None:
            return True
        grant = self._admit(configuration.token)
        rights = grant.rights if grant is not None else None
        is_robot = configuration.agent_type != UNITY
        if grant is None or (rights is not None and is_robot != rights.has("robot")):
            self._reject(NotAdmitted(), 1, events)
            events += [NotLetIn(), self._leave("it has no valid token")]
            return False
        self.grant, self._rights = grant, grant.rights
        return True

    def _look_for_session(self, configuration: Configuration, events: list[Event]) -> None:
        """Be who was here before, if the agent shows that it is."""
        resume, shown = self._resume, configuration.session
        self._forget_owner()
        if shown is None or not configuration.extensions or resume is None:
            return
        self.returns = True
        if not shown:
            return
        former = resume(shown, self.grant, configuration.agent_type)
        if former is None:
            events.append(NotResumed())
            return
        events.append(Resumed(former, self.agent_id, self.credit, configuration.received, former.heard))
        self._take_over(former, events)

    def _take_over(self, former: TcpAgent, events: list[Event]) -> None:
        """Have all that was the other's own. What the token permits is judged anew."""
        self.agent_id, self.former_ids = former.agent_id, former.former_ids
        self.connection_number, self.heard = former.connection_number, former.heard
        self.agent_type, self.group, self.functionality = former.agent_type, former.group, former.functionality
        self.extensions = former.extensions
        self.drops += former.drops
        self.corrected += former.corrected
        self.credit, self._stops, self._halts = former.credit, former._stops, former._halts
        self.recipient = former.recipient
        self._registered, self._refused_at = former._registered, former._refused_at
        self._judge = Judge(self.agent_type, self.agent_id)
        former.state, self.state = GONE, ONLINE
        if self._held:  # who knows sessions says nothing before
            self.drops["before_configuration"] += sum(frame.count for frame in self._held)
            self._held.clear()
        if self.grant.rights != former.grant.rights:
            events += self.rights_change(self.grant)
        self._decoder.runs = not self._limits.frames_per_s and self.grant.credit is None

    def rights_change(self, grant: Grant) -> list[Event]:
        """The agent's token has other rights from now on. What is not permitted any more ends."""
        self.grant, self._rights = grant, grant.rights
        self._permitted.clear()
        self._decoder.runs = not self._limits.frames_per_s and grant.credit is None
        if grant.rights is not None and (self.agent_type != UNITY) != grant.rights.has("robot"):
            return [self._leave(f"its token is for a {'robot' if grant.rights.has('robot') else 'headset'} now")]
        withdrawn: list[tuple[AddNode, str]] = []
        for key, registering in list(self._registered.items()):
            node, why = registering.node, None
            if grant.rights is not None:
                why = grant.rights.of_registration(node, registering.robot_ids, registering.groups)
            if why is not None and isinstance(node, AddNode):
                del self._registered[key]
                withdrawn.append((node, why))
        events: list[Event] = [Withdrawn(withdrawn)] if withdrawn else []
        if grant.rights is not None and not grant.rights.may_be_in(self.group):
            self.group = 0
            events.append(Joined(self.agent_type, 0, None))
        return events

    def _go_offline(self, message: GoOffline, events: list[Event]) -> None:
        if message.agent_id not in {0, self.agent_id, *self.former_ids}:
            raise NotAllowed(f"agent {self.agent_id} cannot send agent {message.agent_id} offline")
        events.append(self._leave("went offline"))

    def _manage(self, management: Management | Custom, frame: Frame) -> Event:
        if isinstance(management, Custom):
            if self._rights is not None and not self._rights.has("ask"):
                raise NotPermitted("this token does not give the right to ask")
            return Asked(management.manager, management.data, self._decode(frame).request_id)
        if isinstance(management, OnlineRequest):
            return AskedOnline(self._decode(frame).request_id)
        if isinstance(management, Registration):
            return self._registration(management, frame)
        if isinstance(management, StreamData):
            return self._stream(management, frame)
        raise NotAllowed(f"{management.manager} is not for an agent to send")

    def _registration(self, registration: Registration, frame: Frame) -> Registering:
        named = max(len(registration.registrar_agent_ids), len(registration.registrar_group_ids))
        if named > NODE_AGENTS:
            raise BadField("registration", f"it names {named} robots or groups, at most {NODE_AGENTS} are allowed")
        manager = self._decode(frame).message_manager
        node: AddNode | RemoveNode
        if manager == AddNode.manager:
            node = decode_data(AddNode, frame.body)
        elif manager == RemoveNode.manager:
            node = decode_data(RemoveNode, frame.body)
        else:
            raise BadField("registration", _NO_NODE)
        if (node.registrant_agent_type, node.registrant_agent_id) != (self.agent_type, self.agent_id):
            self.corrected += 1
            node = structs.replace(node, registrant_agent_type=self.agent_type, registrant_agent_id=self.agent_id)
        registering = Registering(node, registration.registrar_agent_ids, registration.registrar_group_ids)
        if self._rights is not None:
            self._permit_registration(registering, self._rights)
        return registering

    def _permit_registration(self, registering: Registering, rights: Rights) -> None:
        node, robots, groups = registering
        why = rights.of_registration(node, robots, groups)
        if why is not None:
            raise NotPermitted(why)
        key = node.node_type, node.node_name
        self._permitted.clear()
        before = self._registered.get(key)
        if not isinstance(node, AddNode):
            if before is not None:
                left = before._replace(
                    robot_ids=[robot for robot in before.robot_ids if robot not in robots],
                    groups=[group for group in before.groups if group not in groups],
                )
                self._registered[key] = left
                if not left.robot_ids and not left.groups:
                    del self._registered[key]
            return
        if before is not None and isinstance(before.node, AddNode) and before.node.tos_name == node.tos_name:
            robots = sorted({*before.robot_ids, *robots})
            groups = sorted({*before.groups, *groups})
        elif len(self._registered) >= NODES_EACH:
            raise NotPermitted(f"each may have {NODES_EACH} interface nodes")
        self._registered[key] = Registering(node, robots, groups)
        self._refused_at.pop(key, None)

    def registration_refused(self, refused: NodeRefused) -> None:
        """A robot refused what the agent registered. Messages say only the name of a node, which there may be another
        topic's, so those of an agent with a token are not let pass to that robot; a stop is, which needs no node."""
        if not refused.robot_id or (self._rights is not None and self._rights.is_stop(refused.tos_name)):
            return
        key = refused.node_type, refused.node_name
        if key in self._registered:
            self._refused_at.setdefault(key, set()).add(refused.robot_id)

    def topic_of(self, node_type: int, node_name: str) -> str:
        """The topic that an agent with a token has registered under this node's name; empty when it has none."""
        registered = self._registered.get((node_type, node_name))
        return registered.node.tos_name if registered is not None and isinstance(registered.node, AddNode) else ""

    def _permit(self, frame: Frames, metadata: Metadata, rights: Rights) -> None:
        """Whether a frame for others may go on: judged once for each destination and node. Raises NotPermitted."""
        about = frame.destination, metadata.node_type, metadata.node_name, metadata.message_manager
        try:
            why = self._permitted[about]
        except KeyError:
            topic = self.topic_of(metadata.node_type, metadata.node_name)
            why = rights.of_frame(frame.header, metadata, topic or None)
            if len(self._permitted) >= self.PERMITTED:
                self._permitted.clear()
            self._permitted[about] = why
        if why is not None:
            raise NotPermitted(why)

    def _around(self, sent: Sent, refused: set[int]) -> list[Event]:
        """What becomes of a message whose node these robots have refused: of a group the others get it, by their ids.
        Raises NotPermitted."""
        header, events = sent.frame.header, list[Event]()
        members = self._members_of(header)
        if header.agent_type == UNITY or (header.agent_type and refused.isdisjoint(members.union(header.ids))):
            return [sent]
        inside = sorted(refused.intersection(members))
        reason = f"robot {(inside or sorted(refused))[0]} refused this node"
        others = sorted(members.union(header.ids) - refused)
        if not header.agent_type or not others or not refused.isdisjoint(header.ids):
            raise NotPermitted(reason)
        layout, slots = self._layout, self._layout.id_slots
        for single in sent.frame.each():
            for begin in range(0, len(others), slots):
                frame = encode_frame(ROS, others[begin : begin + slots], message=single.message, layout=layout)
                events.append(Sent(parse_frame(frame, layout), sent.metadata, sent.readable))
        return [*events, Forbidden(sent.metadata, tuple(inside), reason)]

    def _members_of(self, header: Header) -> set[int]:
        """The robots in the groups that a message is for; where nobody knows them, all that have refused anything."""
        if not header.groups:
            return set()
        if self._members is None:
            return set().union(*self._refused_at.values())
        return {robot for group in header.groups for robot in self._members(group)}

    def _stream(self, stream: StreamData, frame: Frame) -> Streamed:
        if self.agent_type != ROS:
            raise NotAllowed("only a robot sends topic data")
        sent = self._judged(frame)
        return Streamed(sent.frame, sent.metadata, sent.readable, stream.targets())

    def _is_one_more(self, frame: Frames) -> bool:
        """Whether a frame is a command to robots, and surely none that stops one. Not parsed: that is what a flood
        costs."""
        if frame.data[0] != ROS:
            return False
        raw = frame.metadata
        return _IS_COMMAND in raw and not any(word in raw for word in _MAY_STOP)

    def _send(self, frame: Frames, events: list[Event]) -> None:
        sent = self._judged(frame)
        if self._rights is not None:
            metadata = sent.metadata
            self._permit(sent.frame, metadata, self._rights)
            if self._refused_at and (refused := self._refused_at.get((metadata.node_type, metadata.node_name))):
                events += self._around(sent, refused)
                return
        events.append(sent)

    def _judged(self, frame: Frames) -> Sent:
        raw = frame.metadata
        if not raw:
            raise BadField("metadata", "a message for other agents needs metadata")
        judged = self._judge(raw)
        if judged.true is not raw and judged.true != raw:
            self.corrected += frame.count
            frame = frame.with_metadata(judged.true)
        return Sent(frame, judged.metadata, judged.readable)

    def _decode(self, frame: Frame) -> Metadata:
        raw = frame.metadata
        return Metadata.decode(raw) if raw else Metadata()

    def _leave(self, reason: str) -> Left:
        self.state = GONE
        return Left(reason)

    def _gone(self) -> bool:
        return self.state is GONE


_IS_COMMAND = b'"nodeType":%d,' % COMMAND
_MAY_STOP = (b"Bool", b"Twist")
"""In the types of messages that stop a robot, or say that it stand still (`guard.STOP_TYPES`, `halts`)."""

_NO_NODE = (
    f"its message names neither {AddNode.manager} nor {RemoveNode.manager}: management data and message are one "
    "frame, not two (docs/unity.md)"
)


def _refusal(registration: Registration | None, error: WireError) -> RegistrationRefused:
    """What the agent is told, with its own words as far as they can be read; no robot has heard of it."""
    refused = NodeRefused(0, 0, "", "", str(error)[:REASON_CHARACTERS])
    if registration is not None:
        refused = structs.replace(
            refused,
            node_type=registration.node_type,
            node_name=registration.node_name[:NAME_BYTES],
            tos_name=registration.tos_name[:NAME_BYTES],
        )
    return RegistrationRefused(refused)
