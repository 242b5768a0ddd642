"""How much what others say may be. Pure: numbers, and where each comes from.

All of it is judged before anything is parsed, and apart from ``max_frame_bytes``, which is for the data of topics: a
camera's frame may have 20 MiB, what says where it goes may not. The recorded programs (docs/protocol.md) stay below
a tenth of each number. Parsing what is legal takes about a millisecond at most.
"""

from __future__ import annotations

MANAGEMENT_BYTES = 64 << 10
"""Management data of a frame. A robot's list of registrants (StreamData) has no other limit: 9 000 ids fit, more than
gateways have sockets."""

CONFIGURATION_BYTES = 256 << 10
"""The same while an agent is not configured: a robot's first message lists its topics and services, 2 000 and more of
them. It costs a few milliseconds, once per connection."""

JSON_PARTS = 4096
"""Keys, and objects and lists, in JSON of more than ``METADATA_BYTES``, at all depths, as far as colons and brackets
tell: what a part costs in time and memory is many times what it takes in bytes."""

JSON_FIELDS = 64
"""Keys at the top of a JSON object; ours have at most ten."""

METADATA_BYTES = 4 << 10
"""The JSON in front of a message's data; with three of the longest names it has 1 KiB."""

SAMPLE_BYTES = 256 << 10
"""Several frames in one sample, together."""

RUN_BYTES = 128 << 10
"""Frames of a TCP agent that begin alike and are handled as one, together: less than what a sample may have, and no
more than what is sent without a thread of its own."""

NAME_BYTES = 255
"""Characters of one name: interface node, topic, service, type, manager. ROS 2, where each is a byte, allows 247."""

REQUEST_BYTES = 64 << 10
"""JSON in the data part of a message to a gateway, a manager or a robot that reads it there."""

CALL_BYTES = REQUEST_BYTES + METADATA_BYTES + (1 << 10)
"""A whole call of a verb that reads such JSON."""

ASKED_BYTES = 64 << 20
"""What calls of more than ``CALL_BYTES`` have brought that wait or are being answered, of one program together. One of
any size may when no other such waits."""

ANSWER_BYTES = 1 << 20
"""JSON in an answer that one asked for oneself: 65 535 ids, or all that a robot offers."""

ANSWER_PARTS = 128 << 10
"""Keys and items in it, as far as colons, commas and brackets tell."""

ROUTER_BYTES = 4 << 20
"""What a router tells of itself: of each session about 300 bytes."""

REASON_CHARACTERS = 500
"""Of a reason that is passed on to a person."""

WAITING_IN_ALL_BYTES = 256 << 20
"""What waits for all agents of a gateway that read too slowly. Of each it is ``outbox_bytes``, or one larger message,
behind what is being written to it: two messages of 32 MiB for one that does not read."""

UNFINISHED_IN_ALL_BYTES = 256 << 20
"""Frames of all agents of a gateway that have begun and not ended."""

UNFINISHED_FREE_BYTES = 128 << 10
"""So much of a frame that has begun is not counted, so that usual frames cost nothing more."""

REQUESTS_PER_S = 1000
"""Management messages of one TCP agent, which may come at once; one that sends more is read from more slowly."""

REGISTRATION_REQUESTS = 5
"""So many of these a registration counts as: it is asked of robots, which make something of it in ROS, and declared on
the mesh."""

NODES_EACH = 1024
"""Interface nodes that one TCP agent may have registered; recorded programs have tens."""

NODES_PER_ADDRESS = 16 << 10
"""The same for all that come from one address."""

NODES_IN_ALL = 64 << 10
"""The same for all of one gateway. Each costs about a KiB; see `budget` for who may have the last of them."""

NODE_AGENTS = 1024
"""Robots that one registration may name by id; groups are for more."""

NAMED_EACH = 64 << 10
"""Robots and groups that all registrations of one TCP agent name together: 64 nodes on 1 024 robots each."""

NAMED_PER_ADDRESS = 512 << 10
"""The same for all that come from one address."""

NAMED_IN_ALL = 2 << 20
"""The same for all of one gateway. Each costs about 130 bytes."""

CHUNK_BYTES = 12 * NAME_BYTES
"""One part of a key between two slashes: a name of any script, escaped."""

KEY_BYTES = 16 << 10
"""A whole key. Zenoh writes its length in 16 bits, and panics above them."""

NESTING = 32
"""How deep objects and lists may lie in each other, in JSON from others, settings and YAML."""

PARTIAL_BYTES_PER_S = 16 << 10
"""A frame that has begun and comes more slowly than this is not going to end: its connection is closed."""

PARTIAL_WINDOW_S = 60.0
"""Over how long that is judged: a headset that is taken off in the middle of a frame has so long to come back."""

ASLEEP_IN_ALL, ASLEEP_PER_ADDRESS = 1024, 256
"""Agents of a gateway whose connection has ended and who may come back, in all and of one address."""

KEPT_BYTES, KEPT_MESSAGES = 1 << 20, 4096
"""What was said to one agent that may come back and is kept until it has arrived, without topics."""

KEPT_IN_ALL_BYTES = 64 << 20
"""The same for all of a gateway together; beyond it those give way that have most."""
