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

MANAGEMENT_KEYS = 4096
"""Keys in management data, at all depths, as far as colons tell."""

MANAGEMENT_FIELDS = 64
"""Keys at the top of a JSON object; ours have at most ten."""

METADATA_BYTES = 4 << 10
"""The JSON in front of a message's data; with three of the longest names it has 1 KiB."""

NAME_BYTES = 255
"""UTF-8 of one name: interface node, topic, service, type, manager. ROS 2 allows 247 to 255."""

REQUEST_BYTES = 64 << 10
"""JSON in the data part of a message to a gateway, a manager or a robot that reads it there."""

REASON_CHARACTERS = 500
"""Of a reason that is passed on to a person."""

NODE_AGENTS = 1024
"""Robots that one registration may name by id; groups are for more."""

CHUNK_BYTES = 2400
"""One part of a key between two slashes, escaped: 200 characters of any script."""

KEY_BYTES = 8 << 10
"""A whole key. Zenoh writes its length in 16 bits, and panics above them."""

NESTING = 32
"""How deep objects and lists may lie in each other in settings, and in YAML that a person writes."""

PARTIAL_BYTES_PER_S = 1024
"""Slower than this, a frame that has begun is not going to end: its connection is closed."""

PARTIAL_PATIENCE_S = 10.0
"""What every frame has at least, however slow its network is."""
