"""The loop of a worker process: JSON lines in, one JSON line out for each. It ends with its stdin."""

from __future__ import annotations

import json
import select
import sys
from collections.abc import Callable
from typing import Any

Work = Callable[..., dict[str, Any]]


def say(answer: dict[str, Any]) -> None:
    """Give the run one answer."""
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def serve(ready: dict[str, Any], works: dict[str, Work], idle: Callable[[], None] = lambda: None) -> None:
    """Say that the worker is ready, then do what the run asks for; ``idle`` is called at least once a second."""
    say(ready)
    while True:
        if not select.select([sys.stdin], [], [], 1.0)[0]:
            idle()
            continue
        line = sys.stdin.readline()  # one line per question, and no question before the answer: nothing stays buffered
        if not line:
            return
        command = json.loads(line)
        say(works[command.pop("do")](**command))
