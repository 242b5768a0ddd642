"""Which ids robots may have over TCP."""

from __future__ import annotations

from bridge.gateway.robot_ids import ANY, RobotIds


def test_without_a_list_there_are_no_robots() -> None:
    """Nobody is let in, and the reason names the setting."""
    ids = RobotIds([])
    assert ids.choose(1, lambda _: False) is None
    assert "gateway.robots" in ids.problem


def test_an_id_of_the_list_is_given_once() -> None:
    """The first of the list that is free, or the connection's own; none when all are taken."""
    ids = RobotIds([7, 8])
    assert [each in ids for each in (7, 8, 9)] == [True, True, False]
    assert ids.choose(1, lambda _: False) == 7
    assert ids.choose(1, lambda each: each == 7) == 8
    assert ids.choose(7, lambda _: True) == 7
    assert ids.choose(1, lambda _: True) is None
    assert "taken" in ids.problem


def test_any_is_what_the_old_router_did() -> None:
    """A robot keeps the id of its connection, and no id is kept from headsets."""
    ids = RobotIds(ANY)
    assert ids.choose(300, lambda _: True) == 300
    assert 300 not in ids
