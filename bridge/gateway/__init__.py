"""The TCP gateway: existing headsets and robots join the mesh unchanged."""

from .server import Gateway

__all__ = ["Gateway"]
