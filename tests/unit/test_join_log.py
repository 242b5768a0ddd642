"""`bridge.gateway.join_log`: what a log says of those who come."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from bridge.gateway import join_log
from bridge.gateway.join_log import SINGLY, JoinLog


class Agent:
    """In a connection's place."""

    def __init__(self, kind: int, agent_id: int, host: str, group: int = 0, token: str = "") -> None:
        self.key = kind, agent_id
        self.host = host
        self.peer = SimpleNamespace(group=group, grant=SimpleNamespace(name=token))

    def __str__(self) -> str:
        return f"{self.key} at {self.host}"


async def test_who_comes_alone_has_a_line(caplog: pytest.LogCaptureFixture) -> None:
    """With its group and its token, and nothing is said behind it."""
    caplog.set_level("INFO")
    joins = JoinLog()
    one: Any = Agent(2, 7, "::1", group=3, token="hall")
    joins.joined(one)
    joins.close()
    assert [record.getMessage() for record in caplog.records] == ["(2, 7) at ::1 is online in group 3 with token hall"]


async def test_of_many_the_rest_has_one_line(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says how many, which ids and from where; afterwards each has a line again."""
    monkeypatch.setattr(join_log, "WITHIN_S", 60.0)
    caplog.set_level("INFO")
    joins = JoinLog()
    for number in range(1, 101):
        many: Any = Agent(2 if number != 50 else 1, number, f"10.0.0.{number % 5}")
        joins.joined(many)
    joins.close()
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == SINGLY + 1
    assert lines[-1] == (
        "80 more are online: ros/50, unity/21-49, unity/51-100 at 10.0.0.0, 10.0.0.1, 10.0.0.2 and 2 more"
    )
    again: Any = Agent(2, 500, "::1")
    joins.joined(again)
    joins.close()
    assert caplog.records[-1].getMessage() == "(2, 500) at ::1 is online"
