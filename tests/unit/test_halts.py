"""Which commands say to stand still."""

from __future__ import annotations

import struct

import pytest

from macs_zenoh.protocol.halts import TWIST, TWIST_STAMPED, halts, may_halt

NONE = (0.0, -0.0, 0.0, 0.0, 0.0, -0.0)
NAN = float("nan")


def twist(*velocity: float, order: str = "<") -> bytes:
    return bytes((0, order == "<", 0, 0)) + struct.pack(f"{order}6d", *velocity)


def stamped(frame_id: bytes, *velocity: float, order: str = "<") -> bytes:
    header = struct.pack(f"{order}iII", 12, 34, len(frame_id) + 1) + frame_id + b"\0"
    header += b"\xee" * (-len(header) % 8)
    return bytes((0, order == "<", 0, 0)) + header + struct.pack(f"{order}6d", *velocity)


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_velocity_of_zero_says_it(order: str) -> None:
    """Of either sign, in either order of bytes, by whichever name of the type; no other velocity does."""
    for name in (TWIST, "geometry_msgs/msg/Twist"):
        assert may_halt(name)
        assert halts(name, twist(*NONE, order=order))
        for axis in range(6):
            for speed in (1e-300, -1.0, NAN):
                assert not halts(name, twist(*NONE[:axis], speed, *NONE[axis + 1 :], order=order))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("frame_id", [b"", b"odom", b"base_link", b"a/name/of/some/length"])
def test_the_stamp_and_the_frame_are_no_velocity(frame_id: bytes, order: str) -> None:
    """The velocity is behind a name of any length, and what fills up to it says nothing."""
    assert may_halt(TWIST_STAMPED)
    assert halts(TWIST_STAMPED, memoryview(stamped(frame_id, *NONE, order=order)))
    for axis in range(6):
        assert not halts(TWIST_STAMPED, stamped(frame_id, *NONE[:axis], 0.1, *NONE[axis + 1 :], order=order))


def test_what_is_no_whole_velocity_says_nothing() -> None:
    """Cut short, of another type, or written in another way."""
    for kind, whole in ((TWIST, twist(*NONE)), (TWIST_STAMPED, stamped(b"odom", *NONE))):
        for size in range(len(whole)):
            assert not halts(kind, whole[:size])
        assert not halts(kind, b"\0\x07" + whole[2:])
        assert not halts(kind, b"\1" + whole[1:])
        assert halts(kind, whole + bytes(16))
        assert not halts(kind, whole + bytes(1 << 20)), "large"
    assert not halts(TWIST_STAMPED, b"\0\1\0\0" + bytes(8) + b"\xff" * 4 + bytes(64)), "a name beyond the end"
    for name in ("std_msgs/Float64", "geometry_msgs/Point", "geometry_msgs/Accel", "Twist", ""):
        assert not may_halt(name)
        assert not halts(name, twist(*NONE))
