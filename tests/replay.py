"""The recorded sessions of tests/vectors as scripts to play against a gateway: who connects, who sends what, and what
everybody else must then hear.

Recordings of the existing router show both sides; the recorded outcome is the expected one, except where `INSTEAD`
says why not. Recordings of the existing headset have a stand-in behind them, so there the expected outcome comes from
a small model of the protocol (`_outcome`), except where `NOT_TOLD` says why not.

Nothing here uses the code under test: headers and JSON are taken apart by hand.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from tests.support.recordings import VECTORS, reading, snake

HEADER = struct.Struct("<B10H10BII")
ROS, UNITY = 1, 2
NOBODY = 60_000
"""Added to recorded ids that nobody had, so that nobody has them here either."""

# -- differences, each with its reason; docs/compatibility.md tells them to users -----------------------------------

RULES = {
    "one copy": "an agent named twice, or by id and by group, gets a message once",
    "no echo": "nobody hears its own broadcast",
    "gone at once": "an agent whose connection ends is gone, and announced, at once and not at the next sweep",
    "closed when silent": "a connection that was given up is closed with FIN",
    "groups register": "a registration for a group reaches its robots; it killed the headset's thread in the router",
    "told once": "a robot that has an interface node for a headset is not told the same again: a second message makes "
    "the existing robot program create a second ROS node",
    "nothing to take back": "a robot is not told to remove what the headset has not registered there",
    "the connection goes on": "a bad management frame costs that frame; in the router it killed the whole connection",
    "lies stay here": "a message whose inner sizes do not add up is dropped; receivers lost the stream for good",
    "speaks for itself": "the connection decides who an agent is, not what it writes: nobody is kicked, "
    "configured or replaced by another",
    "the asker is answered": "who asks who is online gets the answer, whatever id it writes into the question",
    "robots stream": "topic data with a list of receivers is a robot's to send",
    "configured first": "what an agent sends before it has told its type waits until it has",
    "what it survives": "an existing program gets only what such programs are known to survive",
    "one serves": "a second registrant on a service of headsets is refused at the robot's gateway, with a reason",
    "ids ascend": "the ids of agents online come in ascending order, not in the order of a hash table",
}


# -- steps --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Connect:
    """Somebody connects, and is greeted as in the recording."""

    name: str
    welcome: bytes


@dataclass(frozen=True)
class Send:
    """Somebody sends a frame, in the pieces given by `CUT`."""

    name: str
    frame: bytes
    cut: str = ""


@dataclass(frozen=True)
class Hear:
    """Somebody must get a message; an empty name is everybody but those in ``never``."""

    name: str
    message: bytes
    never: tuple[str, ...] = ()


@dataclass(frozen=True)
class Leave:
    """Somebody closes its connection."""

    name: str


@dataclass(frozen=True)
class Ended:
    """The gateway closes somebody's connection."""

    name: str


@dataclass(frozen=True)
class Hush:
    """From now on this one sends no heartbeats."""

    name: str


Step = Connect | Send | Hear | Leave | Ended | Hush


class Person(NamedTuple):
    """One connection of a recording."""

    name: str
    type: int
    id: int
    group: int


class Scene(NamedTuple):
    """A recording with those that made its situation before it, ready to be played."""

    name: str
    cast: list[Person]
    """Who is online when it begins."""
    people: dict[str, Person]
    """Everybody in it."""
    steps: list[Step]
    settings: dict[str, Any]
    rules: list[str]
    """The differences that it shows."""


# -- the wire, by hand --------------------------------------------------------------------------------------------


def parts(frame: bytes) -> tuple[tuple[int, ...], bytes, bytes]:
    """Header fields, management data, message."""
    fields = HEADER.unpack_from(frame)
    message_at = HEADER.size + fields[-2]
    return fields[:-2], frame[HEADER.size : message_at], frame[message_at:]


def frame_of(head: tuple[int, ...], management: bytes, message: bytes) -> bytes:
    """The opposite of `parts`."""
    return HEADER.pack(*head, len(management), len(message)) + management + message


def split(message: bytes) -> tuple[bytes, bytes]:
    """Metadata and data of a message whose sizes are right; ValueError for others."""
    try:
        (size,) = struct.unpack_from("<I", message)
        (data_size,) = struct.unpack_from("<I", message, 4 + size)
    except struct.error as error:
        raise ValueError("no message") from error
    if 8 + size + data_size != len(message):
        raise ValueError("no message")
    return message[4 : 4 + size], message[8 + size :]


def message_of(metadata: bytes, data: bytes) -> bytes:
    """The opposite of `split`."""
    return struct.pack("<I", len(metadata)) + metadata + struct.pack("<I", len(data)) + data


def meaning(message: bytes) -> str:
    """What a message says: JSON by value, other data by its bytes."""
    metadata, data = split(message)
    known = reading(metadata)
    if known.get("node_name") or not data.startswith(b"{"):
        return f"{json.dumps(known, sort_keys=True)} {data.hex()}"
    said = reading(data)
    for key in ("ros_agent_ids", "unity_agent_ids"):
        if key in said:
            said[key] = sorted(said[key])
    return f"{json.dumps(known, sort_keys=True)} {json.dumps(said, sort_keys=True)}"


def sender(text: str) -> tuple[object, object]:
    """Who a meaning is from."""
    known, _ = json.JSONDecoder().raw_decode(text)
    return known["sender_agent_type"], known["sender_agent_id"]


def answers_online(message: bytes) -> dict[str, Any] | None:
    """The ids in an answer to OnlineAgentsGetter, None when it is something else."""
    try:
        said = reading(split(message)[1])
    except ValueError:
        return None
    return said if "unity_agent_ids" in said else None


# -- recorded ids → the ids that our gateway gave ------------------------------------------------------------------


class Ids:
    """Recorded (type, id) → our id, and recorded connection numbers → ours."""

    def __init__(self) -> None:
        self._ids: dict[tuple[int, int], int] = {}

    def learn(self, agent_type: int, recorded: int, ours: int) -> None:
        """An agent has its id. One that is used again in a recording need not be used again here, as long as there are
        others that were never given out."""
        self._ids[agent_type, recorded] = ours

    def of(self, agent_type: int, recorded: int) -> int:
        """Our id for a recorded one; 0 stays 0."""
        return self._ids.get((agent_type, recorded), recorded and recorded + NOBODY)

    def frame(self, frame: bytes, me: Person, number: int) -> bytes:
        """A recorded frame with our ids. ``number`` is what our gateway called the sender's connection."""
        head, management, message = parts(frame)
        slots = tuple(self.of(head[0], slot) for slot in head[1:11])
        if head[0] == 0:
            slots = head[1:11]
        head = (head[0], *slots, *head[11:])
        return frame_of(head, self._json(management, me, number), self.message(message, me))

    def message(self, message: bytes, me: Person | None = None) -> bytes:
        """A recorded message with our ids; what is no message stays as it is."""
        try:
            metadata, data = split(message)
        except ValueError:
            return message
        is_json = data.startswith(b"{")
        return message_of(self._json(metadata, me), self._json(data, me) if is_json else data)

    def _json(self, data: bytes, me: Person | None, number: int | None = None) -> bytes:
        try:
            fields = json.loads(data)
        except ValueError:
            return data
        known = reading(data)
        changed = {key: self._value(snake(key), value, known, me, number) for key, value in fields.items()}
        separators = (", ", ": ") if b'": ' in data else (",", ":")
        return json.dumps(changed, separators=separators).encode()

    def _value(self, key: str, value: Any, known: dict[str, Any], me: Person | None, number: int | None) -> Any:
        mine = me.type if me else UNITY
        if key == "agent_id":
            return self.of(known.get("agent_type", mine), value)
        if key == "request_id" and number is not None and "group_id" in known:
            return number
        if key == "sender_agent_id" and value is not None:
            return self.of(known["sender_agent_type"], value)
        if key == "registrant_agent_id":
            return self.of(known.get("registrant_agent_type", UNITY), value)
        if key in ("registrar_agent_ids", "ros_agent_ids"):
            return [self.of(ROS, each) for each in value]
        if key == "unity_agent_ids":
            return [self.of(UNITY, each) for each in value]
        if key == "dest_agents":
            return {kind: [self.of(int(kind), each) for each in ids] for kind, ids in value.items()}
        if key == "agents":
            return [{**each, "agent_id": self.of(each["agent_type"], each["agent_id"])} for each in value]
        return value


# -- messages that the recordings do not have -------------------------------------------------------------------


def _from_router(data: object, *, manager: str = "", request_id: int = 0) -> bytes:
    metadata = {"senderAgentType": None, "senderAgentId": None, "requestId": request_id, "messageManager": manager}
    metadata |= {"nodeType": 0, "nodeName": "", "dataExchangeType": ""}
    return message_of(json.dumps(metadata).encode(), json.dumps(data).encode())


def gone(agent_type: int, agent_id: int) -> bytes:
    """The announcement that an agent has left."""
    agents = [{"agent_type": agent_type, "agent_id": agent_id}]
    return _from_router({"agents": agents}, manager="PrunedUnityAgentsInterfaceNodesCleaner")


def online(ros: list[int], unity: list[int], request_id: int = 0) -> bytes:
    """The answer to OnlineAgentsGetter."""
    return _from_router({"rosAgentIds": ros, "unityAgentIds": unity}, request_id=request_id)


# -- files ----------------------------------------------------------------------------------------------------------


class Row(NamedTuple):
    """One line of a file; an end of stream has no bytes."""

    sent: bool
    name: str
    data: bytes
    note: str


def rows_of(name: str) -> list[Row]:
    """A file's lines."""
    rows = json.loads((VECTORS / f"{name}.json").read_text(encoding="utf-8"))
    return [Row(r["dir"] == "agent->router", r.get("conn", ""), bytes.fromhex(r["hex"]), str(r["note"])) for r in rows]


NAMES = sorted(str(path.relative_to(VECTORS).with_suffix("")) for path in VECTORS.glob("*/*.json"))

BEFORE = {
    "router/type1_second_registrant": ["router/type1_subscriber_register_and_data"],
    "router/type1_first_deregisters": [
        "router/type1_subscriber_register_and_data",
        "router/type1_second_registrant",
    ],
    "router/type1_last_leaves": [
        "router/type1_subscriber_register_and_data",
        "router/type1_second_registrant",
        "router/type1_first_deregisters",
    ],
    "router/type2_unregistered_sender_still_publishes": ["router/type2_publisher_register_and_data"],
    "router/type2_second_registrant": ["router/type2_publisher_register_and_data"],
    "router/type2_deregister_all": [
        "router/type2_publisher_register_and_data",
        "router/type2_second_registrant",
    ],
    "router/type3_second_registrant_and_call": ["router/type3_service_register_and_call"],
    "router/type3_call_by_unregistered": ["router/type3_service_register_and_call"],
    "router/type3_deregister": [
        "router/type3_service_register_and_call",
        "router/type3_second_registrant_and_call",
    ],
    "router/type4_second_registrant_must_fail": ["router/type4_client_register_and_call"],
    "router/type4_deregister_then_other_registers": ["router/type4_client_register_and_call"],
    "router/id_reuse_after_offline": ["router/go_offline_last_registrant"],
    "router/rosagent_killed_prune": ["router/abrupt_disconnect_prune"],
    "headset/register_more": ["headset/register"],
    "headset/deregister": ["headset/register", "headset/register_more"],
    "headset/publish": ["headset/register", "headset/register_more"],
    "headset/call_service": ["headset/register"],
    "headset/serve_service": ["headset/register"],
    "headset/subscribe_data": ["headset/register", "headset/register_more"],
    "headset/noros2_register_more": ["headset/noros2_register"],
    "headset/noros2_deregister": ["headset/noros2_register", "headset/noros2_register_more"],
    "headset/noros2_publish": ["headset/noros2_register", "headset/noros2_register_more"],
}
"""The files that recorded the situation in which a file begins, in order."""

SETTINGS: dict[str, dict[str, Any]] = {
    "router/rosagent_killed_prune": {"handshake_timeout_s": 4.0, "idle_timeout_s": 4.0},
    "router/bad_data_exchange_types": {"tell_refusals": False},
    "router/type4_second_registrant_must_fail": {"tell_refusals": False},
}
"""Gateway settings for recordings that took their time, and for those in which headsets hear of no refusal."""

CUT = {("router/fault_fragmented_and_coalesced", row): cut for row, cut in ((4, "bytes"), (6, "next"), (10, "half"))}
"""How frames went over the socket: byte by byte, together with the next one, in two halves."""

H1, H2, H3 = "headset H1 (id 3, no group)", "headset H2 (id 4, group 5)", "headset H3 (id 5, group 3)"
R1, R2 = "ros agent R1 (id 1, group 3)", "ros agent R2 (id 2, no group)"
C0, C1, C2 = (f"agent connection {n} (id {n + 1})" for n in range(3))


class Difference(NamedTuple):
    """A row of a recording that does not hold here: the rule, and what to do in its place."""

    rule: str
    instead: Callable[[list[Row], int], list[Step]]


def _not(rule: str) -> Difference:
    """The row is not heard."""
    return Difference(rule, lambda rows, at: [])


def _also(rule: str, *more: Step) -> Difference:
    """The row, and something else."""
    return Difference(rule, lambda rows, at: [*_step(rows[at]), *more])


def _but(rule: str, *steps: Step) -> Difference:
    """Something else than the row."""
    return Difference(rule, lambda rows, at: list(steps))


def _delivered(rule: str, name: str) -> Difference:
    """The frame of the row reaches somebody, which the recording does not show."""
    return Difference(rule, lambda rows, at: [*_step(rows[at]), Hear(name, parts(rows[at].data)[2])])


def _heard_by(rule: str, name: str, row: int | None = None) -> Difference:
    """Somebody else hears it; with ``row``, it hears the message of the frame in that row."""
    return Difference(
        rule,
        lambda rows, at: [Hear(name, rows[at].data if row is None else parts(rows[row].data)[2])],
    )


GOES_ON = "the connection goes on"
ITSELF = "speaks for itself"
AT_ONCE = "gone at once"
SURVIVES = "what it survives"
LATER = [3, 4, 5, 9, 10, 11, 12, 13, 14, 6]

INSTEAD: dict[tuple[str, int], Difference] = {
    ("router/abrupt_disconnect_prune", 11): _also(AT_ONCE, Hear("", gone(UNITY, 7))),
    ("router/abrupt_disconnect_prune", 13): _but(AT_ONCE, Hear(H1, online([1, 2], [8, *LATER], 3))),
    ("router/broadcast_type0", 13): _not("no echo"),
    ("router/group_multicast_type0_is_broadcast", 12): _not("no echo"),
    ("router/group_and_agent_both", 2): _not("one copy"),
    ("router/unicast_1_to_10", 124): _not("one copy"),
    ("router/unicast_1_to_10", 125): _not("one copy"),
    ("router/fault_zero_ids_between", 6): _not("one copy"),
    ("router/group_registration_crash", 0): _delivered("groups register", R1),
    ("router/group_registration_crash", 1): _also("groups register", Hear(H3, online([1], LATER))),
    ("router/rosagent_killed_prune", 0): _also(AT_ONCE, Hear("", gone(ROS, 2)), Hush("headset #5")),
    ("router/type1_deregister_unknown_node", 1): _not("nothing to take back"),
    ("router/fault_configure_twice", 5): _delivered(GOES_ON, C1),
    ("router/fault_mgmt_bad_json", 5): _delivered(GOES_ON, C1),
    ("router/fault_mgmt_without_messageManager", 5): _delivered(GOES_ON, C1),
    ("router/fault_remove_unknown_id", 5): _delivered(GOES_ON, C1),
    ("router/fault_unknown_message_manager", 7): _delivered(GOES_ON, C1),
    ("router/fault_inner_size_lie", 6): _heard_by("lies stay here", C1, row=5),
    ("router/fault_kick_other_agent", 5): _not(ITSELF),
    ("router/fault_kick_other_agent", 7): _but(ITSELF, Hear(C1, online([], [1, 2]))),
    ("router/fault_lying_agent_id", 7): _heard_by(ITSELF, C0),
    ("router/fault_lying_agent_type", 5): _but(ITSELF, Hear(C1, online([1], [2]))),
    ("router/fault_online_agents_for_other", 5): _heard_by("the asker is answered", C0),
    ("router/fault_subscriber_forwarder_from_headset", 5): _not("robots stream"),
    ("router/fault_unconfigured_sender", 4): _not("configured first"),
    **{("router/bad_data_exchange_types", row): _not(SURVIVES) for row in (1, 3, 5, 7, 9)},
    **{("router/broadcast_type0", row): _not(SURVIVES) for row in (4, 9)},
    **{("router/group_multicast_type0_is_broadcast", row): _not(SURVIVES) for row in (1, 6)},
    ("router/type2_deregister_all", 5): _not(SURVIVES),  # the robot has no such node any more
    ("router/group_multicast_type1", 1): _not(SURVIVES),
    ("router/type4_second_registrant_must_fail", 1): _not("one serves"),
}
"""(file, row) → how it is here."""

for _row, _name in enumerate(row.name for row in rows_of("router/rosagent_killed_prune")):
    if _row in {105, 106, 107, 108, 109, 110, 111, 113, 114, 115, 116}:  # each leaves by itself; 7 has left before
        INSTEAD["router/rosagent_killed_prune", _row] = _but(AT_ONCE, Hear(_name, gone(UNITY, 8)))
INSTEAD["router/rosagent_killed_prune", 104] = _but("closed when silent", Ended("headset #5"))

NOT_TOLD = {
    ("headset/register_more", 5): ("told once", ["robot 9"]),  # it is in group 4, which has the node since row 2
    ("headset/deregister", 1): ("nothing to take back", ["robot 4"]),
    ("headset/deregister", 4): ("nothing to take back", ["robot 2", "robot 3"]),  # taken back in row 2
    ("headset/call_service", 2): (SURVIVES, ["robot 2"]),  # where the service was not registered
    ("headset/communicator", 0): (SURVIVES, ["robot 5"]),
    ("headset/communicator", 2): (SURVIVES, ["robot 9"]),
    ("headset/communicator", 3): (SURVIVES, ["robot 1", "robot 2", "robot 5", "robot 9"]),
    ("headset/communicator", 4): (SURVIVES, ["robot 5"]),
}
"""(file, row) of the existing headset → robots that do not hear of it. The Android build's files are the same, except
for what it publishes: its bytes are not those of ROS 2."""

TWINS = sum(file.replace("/", "/noros2_") in NAMES for file, _ in NOT_TOLD)
_ALL = [1, 2, 3, 5, 9]
for _row, _robots in enumerate([_ALL, _ALL, _ALL, [9], [1, 9], [1, 9], _ALL, _ALL, _ALL]):
    NOT_TOLD["headset/noros2_publish", _row] = (SURVIVES, [f"robot {_id}" for _id in _robots])

REFUSED = b'{"refused":"an existing robot program does not survive messages of SomeManager"}'
ANSWERED = {
    ("headset/communicator", 4): message_of(
        b'{"senderAgentType":1,"senderAgentId":5,"messageManager":"","requestId":2,"nodeType":0,"nodeName":"",'
        b'"dataExchangeType":""}',
        REFUSED,
    )
}
"""(file, row) of the existing headset → the gateway's answer in a robot's place."""

GROUPS = {(ROS, 9): 4, (ROS, 5): 5}
"""Groups of the agents that the existing headset talks to."""

HEADSET = "headset 7"


# -- building scenes ------------------------------------------------------------------------------------------------


def scene(name: str) -> Scene:
    """A file and those before it."""
    files = [*BEFORE.get(name, []), name]
    settings = {key: value for file in files for key, value in SETTINGS.get(file, {}).items()}
    people = _people_of_headset(files) if name.startswith("headset/") else _people_of_router(files)
    rules: list[str] = []
    steps: list[Step] = []
    for file in files:
        found: list[str] = []
        steps += list(
            _headset_steps(file, people, found) if file.startswith("headset/") else _router_steps(file, found)
        )
        rules += found if file == name else []
    comers = {step.name for step in steps if isinstance(step, Connect)}
    cast = [person for person in people.values() if person.name not in comers]
    return Scene(name, cast, people, steps, settings, rules)


def _step(row: Row) -> list[Step]:
    """A row of a router's recording as it stands there."""
    if not row.data:
        return [Leave(row.name)] if row.note == "EOF from agent side" else []
    if row.sent:
        return [Send(row.name, row.data)]
    if b'"AgentConfigurer"' in row.data:
        return [Connect(row.name, row.data)]
    return [Hear(row.name, row.data)]


def _router_steps(file: str, rules: list[str]) -> Iterator[Step]:
    rows = rows_of(file)
    for at, row in enumerate(rows):
        difference = INSTEAD.get((file, at))
        if difference is not None:
            rules.append(difference.rule)
            steps = difference.instead(rows, at)
        else:
            steps = _step(row)
        if not row.data and row.note == "EOF from router side" and file == "router/go_offline":
            steps = [Ended(row.name)]
        for step in steps:
            ids = answers_online(step.message) if isinstance(step, Hear) and difference is None else None
            if ids and ids["unity_agent_ids"] != sorted(ids["unity_agent_ids"]):
                rules.append("ids ascend")
            if isinstance(step, Send) and (cut := CUT.get((file, at))):
                yield Send(step.name, step.frame, cut)
            else:
                yield step


def _people_of_router(files: list[str]) -> dict[str, Person]:
    """Who is in the rows, and who is only named in an answer: by its connection."""
    rows = [row for file in files for row in rows_of(file)]
    people: dict[str, Person] = {}
    for row in rows:
        people.setdefault(row.name, _person(row.name, rows))
    held = {(person.type, person.id) for person in people.values()}
    for agent in sorted({agent for row in rows if not row.sent and row.data for agent in _named(row.data)} - held):
        if agent in _HOLDERS:
            person = _HOLDERS[agent]
            people[person.name] = person
    return people


def _named(message: bytes) -> set[tuple[int, int]]:
    """Agents in an answer about who is online, or in an announcement of who has left."""
    try:
        metadata, data = split(message)
        said = reading(data) if not reading(metadata).get("node_name") else {}
    except ValueError:
        return set()
    found = {(ROS, each) for each in said.get("ros_agent_ids", [])}
    found |= {(UNITY, each) for each in said.get("unity_agent_ids", [])}
    return found | {(each["agent_type"], each["agent_id"]) for each in said.get("agents", [])}


def _person(name: str, rows: list[Row]) -> Person:
    if known := re.match(r"(ros agent|headset) \w+ \(id (\d+), (?:no group|group (\d+))\)", name):
        return Person(name, ROS if known[1] == "ros agent" else UNITY, int(known[2]), int(known[3] or 0))
    if known := re.match(r"agent connection \d \(id (\d+)\)", name):
        told = [reading(parts(row.data)[1]) for row in rows if row.sent and row.name == name and b"lient" in row.data]
        return Person(
            name, next((each["agent_type"] for each in told if "agent_type" in each), UNITY), int(known[1]), 0
        )
    return Person(name, UNITY, _IDS[name], 0)


def _welcomed() -> dict[str, int]:
    """Connection → recorded id, from all files in which a headset is greeted."""
    found: dict[str, int] = {}
    for file in NAMES:
        for row in rows_of(file) if file.startswith("router/") else []:
            if row.name.startswith("headset #") and b'"AgentConfigurer"' in row.data:
                found[row.name] = reading(split(row.data)[1])["agent_id"]
    return found


_IDS = _welcomed()
_HOLDERS = {
    (person.type, person.id): person
    for person in (_person(name, []) for name in [*sorted(_IDS, key=lambda n: int(n[9:])), H1, H2, H3, R1, R2])
}


# -- the existing headset -------------------------------------------------------------------------------------------


def _people_of_headset(files: list[str]) -> dict[str, Person]:
    agents = {(ROS, 1), (ROS, 2), (UNITY, 7)}
    for row in (row for file in files for row in rows_of(file)):
        if not row.sent:
            metadata = reading(split(row.data)[0]) if row.data else {}
            if metadata.get("sender_agent_type"):
                agents.add((ROS, metadata["sender_agent_id"]))
            continue
        head, management, _ = parts(row.data)
        agents |= {(head[0], each) for each in head[1:11] if each}
        agents |= {agent for agent, group in GROUPS.items() if group in head[11:]}
        if management:
            named = reading(management)
            agents |= {(ROS, each) for each in named.get("registrar_agent_ids", [])}
            agents |= {agent for agent, group in GROUPS.items() if group in named.get("registrar_group_ids", [])}
    return {
        (name := f"{'robot' if kind == ROS else 'headset'} {each}"): Person(
            name, kind, each, GROUPS.get((kind, each), 0)
        )
        for kind, each in sorted(agents)
    }


def _headset_steps(file: str, people: dict[str, Person], rules: list[str]) -> Iterator[Step]:
    for at, row in enumerate(rows_of(file)):
        if not row.data:
            continue
        if row.sent:
            plain = (file.replace("noros2_", ""), at)
            rule, not_told = NOT_TOLD.get((file, at)) or NOT_TOLD.get(plain, ("", []))
            rules += [rule] if rule else []
            yield Send(HEADSET, row.data)
            outcome = list(_outcome(row.data, people))
            assert set(not_told) <= {step.name for step in outcome if isinstance(step, Hear)}, "nothing to leave out"
            yield from (step for step in outcome if not (isinstance(step, Hear) and step.name in not_told))
            if (file, at) in ANSWERED:
                yield Hear(HEADSET, ANSWERED[file, at])
            continue
        metadata = reading(split(row.data)[0])
        if metadata["message_manager"] == "AgentConfigurer":
            yield Connect(HEADSET, row.data)
            continue
        if metadata["sender_agent_type"] == ROS:
            yield Send(f"robot {metadata['sender_agent_id']}", _by_robot(metadata, row.data))
        yield Hear(HEADSET, row.data)


def _by_robot(metadata: dict[str, Any], message: bytes) -> bytes:
    """The frame with which a robot sends this message to headset 7."""
    if metadata["node_type"] == 1:
        management = {"messageManager": "RosAgentSubscriberDataForwarder", "destAgents": {"2": [7]}}
        return frame_of((ROS, *[0] * 20), json.dumps(management).encode(), message)
    return frame_of((UNITY, 7, *[0] * 19), b"", message)


def _outcome(frame: bytes, people: dict[str, Person]) -> Iterator[Step]:
    """What the protocol makes of a frame of headset 7: who hears it, once each."""
    head, management, message = parts(frame)
    others = [person for person in people.values() if person.name != HEADSET]
    if not management:
        for person in others:
            named = person.type == head[0] and (
                person.id in head[1:11] or (person.group and person.group in head[11:])
            )
            if head[0] == 0 or named:
                yield Hear(person.name, message)
        return
    said = reading(management)
    if said["message_manager"] == "RosAgentNodeRegistrationForwarder":
        for person in others:
            by_group = person.group and person.group in said["registrar_group_ids"]
            if person.type == ROS and (person.id in said["registrar_agent_ids"] or by_group):
                yield Hear(person.name, message)
    elif said["message_manager"] == "UnityAgentclientRemover":
        yield Ended(HEADSET)
        yield from (Hear(person.name, gone(UNITY, 7)) for person in others)


def files_on_disk(folder: Path = VECTORS) -> int:
    """How many recordings there are."""
    return sum(1 for path in folder.rglob("*.json") if path.is_file())
