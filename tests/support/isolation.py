"""Workers of a parallel test run, each in a network of its own: no port and no ROS domain of one meets another's.

Linux only, and only where the kernel lets us (root, as in CI and in containers). Elsewhere workers share the
machine's loopback: ports are free ones all the same, and each worker has ROS domains of its own.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys

_NEW_MOUNTS, _NEW_NETWORK = 0x00020000, 0x40000000


def isolate() -> bool:
    """Give this process, its threads and children a loopback network and shared memory (/dev/shm) of their own.

    Call it before any thread is started that uses either. Returns whether it could be done.
    """
    ip = shutil.which("ip", path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin")
    if not sys.platform.startswith("linux") or os.geteuid() != 0 or ip is None:
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_NEW_MOUNTS | _NEW_NETWORK):
        return False
    for command in (
        ["mount", "--make-rprivate", "/"],
        ["mount", "-t", "tmpfs", "none", "/dev/shm"],
        [ip, "link", "set", "lo", "up"],
    ):
        subprocess.run(command, check=True)
    return True


def worker_number() -> int:
    """Which worker of a parallel run this is; 0 in an ordinary run."""
    return int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
