"""Recordings of a mesh: MCAP files, written, read, mended and played without ROS.

``mcap_file`` writes one file, ``disk`` does so in a thread and keeps to limits, ``ring`` keeps the last minute in
memory. ``follower`` hears robots, ``traffic`` reads what headsets send, ``conditions`` what robots say of themselves;
``recorder`` puts them together. ``bag`` reads any MCAP file with bounded memory; ``scan``, ``repair``, ``copying`` and
``rosbag2`` are what ``macs bag`` does with it.
"""

from __future__ import annotations

import importlib.util

from macs_zenoh.errors import MissingExtra

PROFILE = "ros2"
LIBRARY = "macs-zenoh"


def need_mcap() -> None:
    """Raise MissingExtra where MCAP files cannot be read and written here."""
    for package in ("mcap", "lz4", "zstandard"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtra("recordings", package, "record")
