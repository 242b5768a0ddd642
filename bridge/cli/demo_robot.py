"""The demo robot of `bridge.ros.demo` as a program of ``macs up`` (``python -m bridge.cli.demo_robot``)."""

from __future__ import annotations

import os
import signal
import sys
import threading

from bridge.cli.running import STOP_WITH_STDIN, say_ready


def robot() -> int:
    """Be the demo robot until SIGTERM, or until ``macs up`` is gone."""
    import bridge.ros.installed  # noqa: F401 - says what to do where there is no rclpy
    from bridge.ros import demo

    if os.environ.pop(STOP_WITH_STDIN, None):
        threading.Thread(target=_stop_at_end_of_stdin, daemon=True).start()
    return demo.main([], alone=True, on_ready=lambda: say_ready("demo robot"))


def _stop_at_end_of_stdin() -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(robot())
