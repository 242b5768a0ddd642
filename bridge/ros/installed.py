"""Imported before what needs rclpy: raises RosMissing, with advice, where there is none."""

from __future__ import annotations

from bridge.ros import RosMissing

try:
    import rclpy  # noqa: F401 - fails here, once, instead of somewhere below
except ImportError as error:
    raise RosMissing(str(error).splitlines()[0]) from error
