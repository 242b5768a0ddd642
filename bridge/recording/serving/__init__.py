"""Recordings for who asks, as a gateway's page does: a process of its own, beside the gateway and no part of it.

`folder` is where the files are and what is known of them, `children` the programs that record and replay, `server`
what is asked by a socket in the folder, which only its owner can open: the gateway judged before who asks.
"""

from __future__ import annotations

from pathlib import Path

from macs_zenoh.errors import ConfigError

SOCKET = ".recorder.sock"
PATH_BYTES = 100
"""The longest path of a socket, of 108 that Linux has."""


def socket_of(folder: Path) -> Path:
    """Where the recorder of a folder is asked. Raises ConfigError: the path is too long for a socket."""
    path = folder.expanduser().absolute() / SOCKET
    if len(str(path).encode()) > PATH_BYTES:
        raise ConfigError(str(folder), f"is too long a path: with /{SOCKET} a socket's has at most {PATH_BYTES} bytes")
    return path
