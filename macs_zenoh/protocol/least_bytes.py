"""How long ROS data must be at least, for the types that people drive robots with. Pure.

A gateway knows no definitions of types. But existing programs go deaf on data that is shorter than its type, and of
these types everybody knows how long that is; so what is cut off is seen at least here.
"""

from __future__ import annotations

import struct

_HEADER = 4
"""Bytes before the data of every message."""

_FIXED = {
    1: "std_msgs/Bool std_msgs/Byte std_msgs/Char std_msgs/Int8 std_msgs/UInt8",
    2: "std_msgs/Int16 std_msgs/UInt16",
    4: "std_msgs/Int32 std_msgs/UInt32 std_msgs/Float32",
    8: "std_msgs/Int64 std_msgs/UInt64 std_msgs/Float64",
    12: "geometry_msgs/Point32",
    16: "std_msgs/ColorRGBA",
    24: "geometry_msgs/Point geometry_msgs/Vector3 geometry_msgs/Pose2D",
    32: "geometry_msgs/Quaternion",
    48: "geometry_msgs/Twist geometry_msgs/Accel geometry_msgs/Wrench",
    56: "geometry_msgs/Pose geometry_msgs/Transform",
    80: "geometry_msgs/Inertia",
    336: "geometry_msgs/TwistWithCovariance geometry_msgs/AccelWithCovariance",
    344: "geometry_msgs/PoseWithCovariance",
}
"""Of types that are always as long."""

_TEXT = 5
"""A string is its length and its bytes, of which the last is 0."""

_STAMPED = {
    f"geometry_msgs/{name}Stamped": size
    for name, size in (("Twist", 64), ("Pose", 72), ("Point", 40), ("Vector3", 40), ("Accel", 64), ("Wrench", 64))
}
"""A header is 8 bytes and a string; what follows is aligned to 8."""

LEAST: dict[str, int] = {
    "std_msgs/String": _HEADER + _TEXT,
    **{name: _HEADER + size for size, names in _FIXED.items() for name in names.split()},
    **{name: _HEADER + size for name, size in _STAMPED.items()},
}
"""By type, with the bytes before it. Of other types nothing is known but that there is something."""

ANSWERS: dict[str, int] = {"std_srvs/SetBool": _HEADER + 4 + _TEXT, "std_srvs/Trigger": _HEADER + 4 + _TEXT}
"""Of the answers of services."""


TEXT_TYPE = "std_msgs/String"
"""The type whose messages are nothing but text."""


def is_whole(data: memoryview, type_name: str) -> bool:
    """Whether text that a message consists of is all there; of other types nothing is known here."""
    if type_name != TEXT_TYPE or len(data) < _HEADER + _TEXT:
        return True
    size: int = struct.unpack_from("<I", data, _HEADER)[0]
    return _HEADER + 4 + size <= len(data)
