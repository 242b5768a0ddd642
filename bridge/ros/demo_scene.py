"""What the demo robot sees: a tiled floor with pillars under a sky, drawn from where it stands. Pure; with numpy,
which rclpy needs as well."""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any, NamedTuple, Protocol

import numpy

FOG_M = 14.0
"""What is farther away than that is as pale as the sky."""
SHADES = 12
SKY_SHADES = 16
NO_DEPTH = 0
"""In a picture of depth: nothing was measured there."""


class Place(Protocol):
    """Where the eye is, in metres, and where it looks, in radians."""

    x: float
    y: float
    heading: float


class Pillar(NamedTuple):
    """A round pillar; metres."""

    x: float
    y: float
    radius: float
    height: float
    colour: tuple[int, int, int]


RED, GREEN, BLUE, YELLOW = (214, 84, 66), (72, 160, 110), (70, 126, 204), (226, 176, 66)
PILLARS = (
    Pillar(5.0, 1.6, 0.35, 1.6, RED),
    Pillar(7.5, -2.2, 0.45, 2.2, BLUE),
    Pillar(3.2, -1.4, 0.2, 0.7, YELLOW),
    Pillar(9.5, 3.4, 0.5, 2.6, GREEN),
    Pillar(1.5, 4.5, 0.35, 1.4, YELLOW),
    Pillar(-3.5, 5.5, 0.45, 2.0, BLUE),
    Pillar(-6.0, 1.0, 0.4, 1.8, RED),
    Pillar(-5.0, -4.0, 0.35, 1.5, GREEN),
    Pillar(0.5, -5.5, 0.45, 2.1, RED),
    Pillar(4.5, -6.5, 0.4, 1.7, GREEN),
    Pillar(12.0, -0.5, 0.6, 3.0, YELLOW),
)
MAP_M, CELL_M = 32.0, 0.1
"""How long a side of the map is, and of one of its cells. The robot begins in its middle."""
COLOURS = (RED, GREEN, BLUE, YELLOW)
_FLOOR = ((96, 104, 116), (66, 73, 84))
_SKY = ((206, 219, 232), (92, 132, 178))
_LIGHT = 1.45
"""So much brighter is what is near, when the robot's lights are on."""


def floor_map() -> Any:
    """The floor from above, as an occupancy grid: rows from the south, 0 for free, 100 for a pillar or a wall."""
    middles: Any = (numpy.arange(round(MAP_M / CELL_M)) + 0.5) * CELL_M - MAP_M / 2
    x, y = middles[None, :], middles[:, None]
    taken = numpy.maximum(numpy.abs(x), numpy.abs(y)) > MAP_M / 2 - 2 * CELL_M
    for pillar in PILLARS:
        taken |= (x - pillar.x) ** 2 + (y - pillar.y) ** 2 <= pillar.radius**2
    return numpy.where(taken, 100, 0).astype(numpy.int8)


class Scene:
    """Draws it. ``WIDTH`` by ``HEIGHT`` pixels, seen from ``EYE_M`` above the floor."""

    WIDTH, HEIGHT = 320, 240
    EYE_M = 0.55
    FOCAL = 230.0
    """In pixels: how far in front of the eye the picture would stand."""
    HORIZON = 96

    def __init__(self) -> None:
        below: Any = numpy.arange(self.HORIZON + 1, self.HEIGHT) - self.HORIZON
        aside: Any = (self.WIDTH / 2 - 0.5 - numpy.arange(self.WIDTH)) / self.FOCAL
        self._ahead = (self.EYE_M * self.FOCAL / below)[:, None]
        self._left = self._ahead * aside[None, :]
        self._pale = numpy.minimum(self._ahead / FOG_M * SHADES, SHADES - 1).astype(numpy.uint8)
        sky = numpy.linspace(SKY_SHADES - 1, 0, self.HORIZON + 1).astype(numpy.uint8)
        self._sky = numpy.repeat(sky[:, None], self.WIDTH, axis=1)
        self._palettes = {lights: _palette(lights=lights) for lights in (False, True)}

    def palette(self, *, lights: bool) -> bytes:
        """Red, green and blue of each colour that a pixel can have."""
        return self._palettes[lights]

    def png(self, place: Place, *, lights: bool) -> bytes:
        """One picture as a PNG file (8 bit palette; PNG specification, sections 5 and 11)."""
        rows: Any = numpy.zeros((self.HEIGHT, self.WIDTH + 1), numpy.uint8)  # each row after a 0 that says "no filter"
        rows[:, 1:] = self.pixels(place)
        header = struct.pack(">IIBBBBB", self.WIDTH, self.HEIGHT, 8, 3, 0, 0, 0)
        return b"".join(
            (
                b"\x89PNG\r\n\x1a\n",
                _chunk(b"IHDR", header),
                _chunk(b"PLTE", self._palettes[lights]),
                _chunk(b"IDAT", zlib.compress(rows.tobytes(), 1)),
                _chunk(b"IEND", b""),
            )
        )

    def pixels(self, place: Place) -> Any:
        """Numbers of colours in the palette: rows of pixels, from above."""
        cosine, sine = math.cos(place.heading), math.sin(place.heading)
        x = place.x + self._ahead * cosine - self._left * sine
        y = place.y + self._ahead * sine + self._left * cosine
        dark = (numpy.floor(x) + numpy.floor(y)).astype(numpy.int32) & 1
        floor = (SKY_SHADES + dark * SHADES + self._pale).astype(numpy.uint8)
        picture = numpy.concatenate((self._sky, floor))
        for pillar, ahead, columns, (top, bottom) in self._pillars(place):
            shade = min(int(ahead / FOG_M * SHADES), SHADES - 1)
            first = SKY_SHADES + (2 + 3 * COLOURS.index(pillar.colour)) * SHADES
            middle, half = (columns[0] + columns[1]) / 2, max(1.0, (columns[1] - columns[0]) / 2)
            left, right = max(0, columns[0]), min(self.WIDTH, columns[1])
            side = (numpy.arange(left, right) - middle) / half
            lit = numpy.select([side < -0.55, side < 0.35], [1, 0], 2)
            picture[max(0, top) : min(self.HEIGHT, bottom), left:right] = first + lit * SHADES + shade
        return picture

    def depth_mm(self, place: Place, every: int) -> Any:
        """How far away each ``every``-th pixel is, in mm as unsigned 16 bits."""
        sky = numpy.full((self.HORIZON + 1, self.WIDTH), float(NO_DEPTH))
        picture = numpy.concatenate((sky, numpy.repeat(self._ahead, self.WIDTH, axis=1)))
        for _, ahead, (left, right), (top, bottom) in self._pillars(place):
            picture[max(0, top) : min(self.HEIGHT, bottom), max(0, left) : min(self.WIDTH, right)] = ahead
        return numpy.minimum(picture[::every, ::every] * 1000, 0xFFFF).astype(numpy.uint16)

    def _pillars(self, place: Place) -> list[tuple[Pillar, float, tuple[int, int], tuple[int, int]]]:
        """Those in front of the eye, the farthest first: how far, and its pixels across and down."""
        cosine, sine = math.cos(place.heading), math.sin(place.heading)
        seen = []
        for pillar in PILLARS:
            dx, dy = pillar.x - place.x, pillar.y - place.y
            ahead, left = dx * cosine + dy * sine, dy * cosine - dx * sine
            if ahead < 2 * pillar.radius:
                continue  # behind it, or inside
            scale = self.FOCAL / ahead
            middle = self.WIDTH / 2 - left * scale
            columns = int(middle - pillar.radius * scale), int(middle + pillar.radius * scale) + 1
            rows = int(self.HORIZON - (pillar.height - self.EYE_M) * scale), int(self.HORIZON + self.EYE_M * scale)
            if columns[1] > 0 and columns[0] < self.WIDTH:
                seen.append((pillar, ahead, columns, rows))
        return sorted(seen, key=lambda each: -each[1])


def _palette(*, lights: bool) -> bytes:
    """The sky, two colours of tiles, and three of each pillar, all but the sky the paler the farther away."""
    colours = [_mixed(_SKY[0], _SKY[1], shade / (SKY_SHADES - 1)) for shade in range(SKY_SHADES)]
    solid = [*_FLOOR, *(_scaled(colour, part) for colour in COLOURS for part in (1.0, 1.15, 0.72))]
    for colour in solid:
        for shade in range(SHADES):
            far = shade / (SHADES - 1)
            near = _scaled(colour, 1 + (_LIGHT - 1) * (1 - far) ** 2) if lights else colour
            colours.append(_mixed(near, _SKY[0], far**1.4))
    return bytes(part for colour in colours for part in colour)


def _mixed(one: tuple[int, int, int], other: tuple[int, int, int], part: float) -> tuple[int, int, int]:
    mixed = [round(a + (b - a) * part) for a, b in zip(one, other, strict=True)]
    return mixed[0], mixed[1], mixed[2]


def _scaled(colour: tuple[int, int, int], by: float) -> tuple[int, int, int]:
    scaled = [min(255, round(part * by)) for part in colour]
    return scaled[0], scaled[1], scaled[2]


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
