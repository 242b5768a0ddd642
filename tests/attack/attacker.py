"""The process that makes one attack:
``python -m tests.attack.attacker NAME PORT ENDPOINT SECONDS [CERTIFICATES [WAY]]``.

It says ``begins`` on stdout when it has started and ``ended`` when it is over; whoever started it kills it if need be.
"""

from __future__ import annotations

import os
import resource
import sys
from pathlib import Path

from tests.attack import raw, table
from tests.attack.ways import Way


def main(name: str, port: str, endpoint: str, seconds: str, pki: str = "", way: Way = "tcp") -> int:
    """Attack for so long."""
    raw.Agent.way = way
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 8192), hard))
    row = table.every()[name]
    target = table.Target(int(port), endpoint, float(seconds), begins=lambda: print("begins", flush=True))
    target.pki = Path(pki) if pki else None
    row.run(target)
    print("ended", flush=True)
    os._exit(0)  # threads that read for agents, sessions with queries open: nothing here is worth waiting for


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
