"""A TCP agent that keeps no rule: frames with whatever sizes and bytes, over a blocking socket.

Nothing here uses the code under test; frames are packed by hand.
"""

from __future__ import annotations

import json
import socket
import struct
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress

from tests.attack.ways import Stream, Way, opened

FROM = "127.0.0.2"
"""Where attackers come from, so that what is counted per address is not the neighbours'."""
ROS, UNITY = 1, 2
HEADER = struct.Struct("<B10H10BII")
KNOWN = ("senderAgentType", "senderAgentId", "requestId", "messageManager", "nodeType", "nodeName", "dataExchangeType")


def header(to: int, ids: Sequence[int], groups: Sequence[int], management: int, message: int) -> bytes:
    """The 39 bytes, with the sizes that somebody claims."""
    slots = [*ids, *[0] * 10][:10] + [*groups, *[0] * 10][:10]
    return HEADER.pack(to, *slots, management, message)


def message(metadata: bytes = b"", data: bytes = b"") -> bytes:
    """Metadata and data, each behind its size."""
    return struct.pack("<I", len(metadata)) + metadata + struct.pack("<I", len(data)) + data


def frame(
    management: bytes = b"",
    metadata: bytes = b"",
    data: bytes = b"",
    *,
    to: int = 0,
    ids: Sequence[int] = (),
    groups: Sequence[int] = (),
) -> bytes:
    """A frame whose sizes add up."""
    body = message(metadata, data)
    return header(to, ids, groups, len(management), len(body)) + management + body


def metadata(**fields: object) -> bytes:
    """Metadata with all seven keys; underscores become capitals, as in ``node_name="nd__x"``."""
    known = {key: "" if key[0] in "md" or key == "nodeName" else 0 for key in KNOWN} | {"senderAgentType": UNITY}
    return _json(known | _camel(fields))


def management(manager: str, **fields: object) -> bytes:
    """Management data of this kind."""
    return _json({"messageManager": manager} | _camel(fields))


def registration(
    name: str,
    topic: str,
    kind: str = "std_msgs/String",
    *,
    node_type: int = 1,
    agents: Iterable[int] = (1,),
    groups: Iterable[int] = (),
    me: int = 1,
    buffer: int = 10,
    add: bool = True,
    **extra: object,
) -> bytes:
    """A registration, or its end, of one interface node."""
    node = {"node_type": node_type, "node_name": name}
    inner = "InterfaceNodeAdder" if add else "InterfaceNodeRemover"
    request: dict[str, object] = {"registrant_agent_type": UNITY, "registrant_agent_id": me, **node}
    if add:
        request |= {"tos_name": topic, "data_exchange_type": kind}
        request |= {"buffer_size": buffer, "drop_new": False, "is_latched": False, **extra}
    outer = management(
        "RosAgentNodeRegistrationForwarder",
        registrant_agent_id=me,
        registrar_agent_ids=list(agents),
        registrar_group_ids=list(groups),
        tos_name=topic,
        data_exchange_type=kind,
        **node,
    )
    return frame(outer, metadata(sender_agent_id=me, message_manager=inner), _json(_camel(request)))


def request(manager: str, data: bytes = b"", *, robot: int = 1, number: int = 0) -> bytes:
    """A plain request to a robot, as ``RobotStatus``."""
    return frame(metadata=metadata(message_manager=manager, request_id=number), data=data, to=ROS, ids=[robot])


def node_data(name: str, data: bytes, *, node_type: int = 2, robot: int = 1, kind: str = "std_msgs/String") -> bytes:
    """Data of an interface node to a robot."""
    said = metadata(node_type=node_type, node_name=name, data_exchange_type=kind)
    return frame(metadata=said, data=data, to=ROS, ids=[robot])


class Agent:
    """A TCP agent of any type, configured unless asked not to be; what it is sent is read and dropped."""

    way: Way = "tcp"
    """How all of them come in."""

    def __init__(
        self,
        port: int,
        *,
        agent_type: int = UNITY,
        group: int = 0,
        configure: bool = True,
        read: bool = True,
        host: str = FROM,
    ) -> None:
        connected = socket.socket()
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if not read:  # what the kernel would hold for it is not the gateway's
            connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connected.bind((host, 0))
        connected.settimeout(5)
        connected.connect(("127.0.0.1", port))
        self.socket: Stream = opened(self.way, connected)
        self.socket.settimeout(5)
        self.id = 0
        self.agent_type = agent_type
        greeting = self._read_message()
        welcome = json.loads(greeting)
        self.id = int(welcome["agentId"])
        self.socket.settimeout(20)
        if configure:
            self.configure(group)
        if read:
            threading.Thread(target=self._drain, daemon=True).start()

    def configure(self, group: int = 0, **extra: object) -> None:
        """Say who it is."""
        said = {"agent_type": self.agent_type, "agent_id": self.id, "group_id": group, "request_id": 0, **extra}
        self.send(frame(management("AgentclientConfigurer", **said)))

    def send(self, data: bytes) -> bool:
        """Send; False once the other side has ended it, or takes nothing for 20 s."""
        try:
            self.socket.sendall(data)
        except OSError:
            return False
        return True

    def close(self, *, reset: bool = False) -> None:
        """End it; ``reset`` with RST."""
        with suppress(OSError):
            if reset:
                self.socket.shutdown(socket.SHUT_RD)  # who reads holds the socket open; the other side sees nothing
                self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.socket.close()

    def _read_message(self) -> bytes:
        self._exactly(struct.unpack("<I", self._exactly(4))[0])
        return self._exactly(struct.unpack("<I", self._exactly(4))[0])

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            more = self.socket.recv(count - len(data))
            if not more:
                raise ConnectionError("closed")
            data += more
        return data

    def _drain(self) -> None:
        with suppress(OSError):
            while self.socket.recv(1 << 20):
                pass


def _camel(fields: dict[str, object]) -> dict[str, object]:
    return {key[0] + key.title().replace("_", "")[1:]: value for key, value in fields.items()}


def _json(value: object) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()
