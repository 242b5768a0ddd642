"""What our clients wait for unless they are told otherwise, with the patience that a busy machine needs.

Their own limits, a few seconds, are right for people who drive robots. A test that is about such a limit names it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.support.waiting import PATIENCE_S


def be_patient() -> None:
    """Let headsets and agents of this process wait that long for answers."""
    from bridge.headset.actions import ActionClient, Goal
    from bridge.headset.client import Headset
    from macs_zenoh.agent import Agent

    for call in (
        *(Headset.online, Headset.ask_gateway, Headset.ask, Headset.call),
        *(Goal.cancel, ActionClient.send_goal, ActionClient.goals),
        *(Agent.call, Agent.subscribe, Agent.advertise, Agent.publish, Agent.call_service),
    ):
        _wait(call, "timeout_s")
    _wait(Headset.connect.__func__, "handshake_timeout_s")  # type: ignore[attr-defined]


def _wait(call: Callable[..., Any], limit: str) -> None:
    """Set the default of a parameter, by keyword or by place."""
    if call.__kwdefaults__ and limit in call.__kwdefaults__:
        call.__kwdefaults__[limit] = PATIENCE_S
        return
    code = call.__code__
    names = code.co_varnames[: code.co_argcount]
    defaults = list(call.__defaults__ or ())
    defaults[names.index(limit) - len(names)] = PATIENCE_S
    call.__defaults__ = tuple(defaults)
