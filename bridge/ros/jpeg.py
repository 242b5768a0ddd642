"""Raw images as JPEG, with simplejpeg (libjpeg-turbo), which lets go of Python's lock meanwhile. Pure.

Only what uses it needs it: `pip install 'macs-zenoh[jpeg]'`.
"""

from __future__ import annotations

import importlib.util
from typing import Any

from bridge.ros.raw_image import NotAnImage, RawImage

EXTRA = "jpeg"

_COLOURS = {"rgb8": ("RGB", 3), "bgr8": ("BGR", 3), "8UC3": ("BGR", 3), "rgba8": ("RGBA", 4), "bgra8": ("BGRA", 4)}
_GREY = {"mono8": 1, "8UC1": 1, "mono16": 2}
_YUV = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
"""Two pixels in four bytes, and which of these is the first pixel's brightness."""

ENCODINGS = (*_COLOURS, *_GREY, *_YUV)
"""What can be made a JPEG. Depth (16UC1, 32FC1) cannot: its values are no brightness."""


def is_installed() -> bool:
    """Whether the library is there."""
    return all(importlib.util.find_spec(name) is not None for name in ("simplejpeg", "numpy"))


def encode(image: RawImage, quality: int, max_width: int) -> bytes:
    """An image as JPEG, at most so wide: with more, groups of n x n pixels become one each, their mean; 0 is no limit.
    Raises NotAnImage: its encoding is not known, or its rows are too short for it."""
    import simplejpeg

    divisor = -(-image.width // max_width) if max_width else 1
    if image.encoding in _YUV:
        planes = _yuv_planes(image, divisor)
        return bytes(simplejpeg.encode_jpeg_yuv_planes(*planes, quality))
    pixels, colours = _pixels(image, divisor)
    subsampling = "Gray" if colours == "GRAY" else "420"
    return bytes(simplejpeg.encode_jpeg(pixels, quality, colours, subsampling))


def _pixels(image: RawImage, divisor: int) -> tuple[Any, str]:
    import numpy

    if image.encoding in _COLOURS:
        colours, channels = _COLOURS[image.encoding]
        pixels = _rows(image, channels).reshape(image.height, image.width, channels)
    elif image.encoding in _GREY:
        colours, channels = "GRAY", _GREY[image.encoding]
        values = _rows(image, channels).reshape(image.height, image.width, channels)
        pixels = values[:, :, :1] if image.big_endian or channels == 1 else values[:, :, 1:]  # the upper 8 bits
    else:
        raise NotAnImage(f"{image.encoding[:40] or 'no encoding'!r} is none of {', '.join(ENCODINGS)}")
    return numpy.ascontiguousarray(_smaller(pixels, divisor)), colours


def _yuv_planes(image: RawImage, divisor: int) -> tuple[Any, Any, Any]:
    import numpy

    if image.width % 2:
        raise NotAnImage("a row of yuv422 has pixels in pairs")
    first = _YUV[image.encoding]
    bytes_ = _rows(image, 2).reshape(image.height, image.width * 2, 1)
    planes = bytes_[:, first::2], bytes_[:, 1 - first :: 4], bytes_[:, 3 - first :: 4]
    if divisor > 1:  # the colours have half as many columns: both must come out even
        width = image.width // (2 * divisor) * 2 * divisor
        planes = planes[0][:, :width], planes[1][:, : width // 2], planes[2][:, : width // 2]
    return tuple(numpy.ascontiguousarray(_smaller(plane, divisor)[:, :, 0]) for plane in planes)


def _rows(image: RawImage, pixel_bytes: int) -> Any:
    """The bytes of each row that are pixels, without a copy."""
    import numpy

    if image.step < image.width * pixel_bytes:
        raise NotAnImage(f"rows of {image.step} bytes are too short for {image.width} pixels of {image.encoding}")
    every = numpy.frombuffer(image.data, numpy.uint8, image.step * image.height).reshape(image.height, image.step)
    return every[:, : image.width * pixel_bytes]


def _smaller(pixels: Any, divisor: int) -> Any:
    """The mean of each n x n pixels; those at the edge that make no group are left out."""
    import numpy

    height, width = pixels.shape[0] // divisor * divisor, pixels.shape[1] // divisor * divisor
    if divisor == 1 or not height or not width:
        return pixels
    pixels = pixels[:height, :width]
    rows: Any = pixels[0::divisor].astype(numpy.uint16 if divisor <= 16 else numpy.uint32)
    for row in range(1, divisor):
        rows += pixels[row::divisor]
    total: Any = rows[:, 0::divisor].copy()
    for column in range(1, divisor):
        total += rows[:, column::divisor]
    return (total // (divisor * divisor)).astype(numpy.uint8)
