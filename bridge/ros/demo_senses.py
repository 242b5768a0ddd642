"""What the demo robot measures of its `Scene` besides pictures: laser scan, points, its joints. Pure, numpy."""

from __future__ import annotations

import math
from typing import Any

import numpy

from bridge.ros.demo_scene import PILLARS, Place

RAYS = 180
RANGE_M = 12.0
FIRST_RAD, STEP_RAD = -math.pi, 2 * math.pi / RAYS
LAYER_M = 0.3
"""So far apart are the layers of points on a pillar."""
TRACK_M, WHEEL_M = 0.5, 0.1
"""Between the wheels, and their radius."""

_X, _Y, _RADIUS, _HEIGHT = (
    numpy.array([getattr(pillar, name) for pillar in PILLARS], numpy.float32)
    for name in ("x", "y", "radius", "height")
)
_COLOURS: Any = numpy.array([pillar.colour for pillar in PILLARS], numpy.uint32)
_ANGLES = FIRST_RAD + STEP_RAD * numpy.arange(RAYS)


def scan(place: Place) -> tuple[Any, Any]:
    """How far each ray goes until a pillar, in metres as float32, endless where there is none; and which it meets."""
    dx, dy = _X - place.x, _Y - place.y
    cosine, sine = numpy.cos(_ANGLES + place.heading)[:, None], numpy.sin(_ANGLES + place.heading)[:, None]
    ahead = cosine * dx + sine * dy
    beside = cosine * dy - sine * dx
    half: Any = _RADIUS**2 - beside**2
    distance = numpy.where((half > 0) & (ahead > 0), ahead - numpy.sqrt(numpy.maximum(half, 0)), numpy.inf)
    distance = numpy.where((distance > 0) & (distance <= RANGE_M), distance, numpy.inf)
    which = distance.argmin(1)
    return distance[numpy.arange(RAYS), which].astype(numpy.float32), which


def points(place: Place) -> Any:
    """Where on pillars rays end, at each layer up to the pillar's height: rows of x, y, z as float32 in the robot's
    frame, and the colour as 0x00RRGGBB in the bits of a fourth (as PointCloud2 has ``rgb``)."""
    distance, which = scan(place)
    meets = numpy.isfinite(distance)
    distance, which, angles = distance[meets], which[meets], _ANGLES[meets]
    rows = []
    for z in numpy.arange(0.1, float(_HEIGHT.max()), LAYER_M):
        high = _HEIGHT[which] >= z
        red, green, blue = (_COLOURS[which[high], each] for each in range(3))
        colour = (red << 16 | green << 8 | blue).astype(numpy.uint32).view(numpy.float32)
        x, y = distance[high] * numpy.cos(angles[high]), distance[high] * numpy.sin(angles[high])
        rows.append(numpy.stack((x, y, numpy.full(len(x), z), colour), 1).astype(numpy.float32))
    return numpy.concatenate(rows) if rows else numpy.zeros((0, 4), numpy.float32)


class Wheels:
    """How far the two wheels have turned, in radians."""

    def __init__(self) -> None:
        self.left = self.right = 0.0

    def roll(self, forward: float, turn: float, dt: float) -> None:
        """At m/s and rad/s for as long."""
        self.left += (forward - turn * TRACK_M / 2) / WHEEL_M * dt
        self.right += (forward + turn * TRACK_M / 2) / WHEEL_M * dt
