"""ROS interface packages (``.msg``, ``.srv``, ``.action``) as Python wheels, where ROS comes from PyPI.

``package`` reads the folder, ``generate`` runs ROS's own generators, ``compile`` makes one extension module of what
they wrote, ``wheel`` packs it. With a ROS installation the same folder is built by colcon, and none of this is needed.
"""

from bridge.interfaces.build import build
from bridge.interfaces.package import Package

__all__ = ["Package", "build"]
