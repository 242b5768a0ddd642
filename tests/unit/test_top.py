"""A mesh as `macs top` and `macs watch` see it: what follows from what they are told, and how it is drawn."""

from __future__ import annotations

import io

import msgspec
import pytest
from msgspec import structs
from rich.console import Console

from bridge.top.events import KINDS, Event, of_robot
from bridge.top.picture import MOST_TOPICS, SILENT_AFTER, Picture
from bridge.top.screen import Screen, View
from macs_zenoh.errors import WireError
from macs_zenoh.protocol.directory import AgentInfo, Change
from macs_zenoh.protocol.ping import AGENTS, GatewayAgent, GatewayTold, Pong, decode_told, encode_told
from macs_zenoh.protocol.robot_state import (
    CarriedStatus,
    ControlStatus,
    DeadManStatus,
    NodeStatus,
    RobotStatus,
    StopStatus,
    TripsStatus,
)
from macs_zenoh.protocol.routers import Router, Trips

HOLDS = "the emergency stop holds (stopped)"


def robot(number: int = 7, group: int = 3, zid: str = "a" * 32) -> AgentInfo:
    return AgentInfo(1, number, group, zid)


def status(
    *nodes: NodeStatus, stopped: str = "", by: str = "", times: int = 0, drops: dict[str, int] | None = None
) -> RobotStatus:
    return RobotStatus("/rosagent", bool(stopped), StopStatus(by=stopped or by, times=times), list(nodes), drops or {})


def drive(holder: str | None = None, trips: int = 0, messages: int = 0, age_s: float | None = None) -> NodeStatus:
    return NodeStatus(
        "publisher",
        "/cmd_vel",
        "geometry_msgs/msg/Twist",
        ["unity/256"],
        control=ControlStatus(holder),
        deadman=DeadManStatus(1.0, None, trips, "silence" if trips else ""),
        carried=CarriedStatus(messages, 52 * messages, age_s),
    )


RELEASED = status(by="unity/5", times=1)


def kinds(events: list[Event]) -> list[str]:
    assert {event.what for event in events} <= set(KINDS)
    return [event.what for event in events]


@pytest.mark.parametrize(
    ("before", "after", "what", "text"),
    [
        (status(), status(stopped="unity/256", times=1), "stopped", "ros/7 was stopped by unity/256"),
        (
            status(stopped="unity/256", times=1),
            status(by="unity/5", times=1),
            "released",
            "ros/7 was released by unity/5",
        ),
        (status(), RELEASED, "stopped", "ros/7 was stopped, and released by unity/5"),
        (status(drive()), status(drive("unity/256")), "control", "unity/256 has control of /cmd_vel on ros/7"),
        (status(drive("unity/256")), status(drive()), "control", "nobody has control of /cmd_vel on ros/7"),
        (status(drive()), status(drive(trips=1)), "dead-man", "the dead-man of /cmd_vel on ros/7 has acted: silence"),
        (
            structs.replace(status(drive()), trips={"/arm": TripsStatus(1, "silence")}),
            structs.replace(
                status(), trips={"/arm": TripsStatus(1, "silence"), "/cmd_vel": TripsStatus(1, "it left")}
            ),
            "dead-man",
            "the dead-man of /cmd_vel on ros/7 has acted: it left",
        ),
        (
            status(),
            status(drops={"stopped": 3}),
            "refused",
            "ros/7 refused 3 messages: the emergency stop holds (stopped)",
        ),
        (status(), status(drops={"lost_in_ros": 1}), "lost", "ros/7 lost 1 message (lost_in_ros)"),
        (status(), status(drive()), "registered", "unity/256 has registered as publisher of /cmd_vel on ros/7"),
    ],
    ids=lambda value: value if isinstance(value, str) and " " not in value else "",
)
def test_each_thing_that_happens_on_a_robot_is_one_event(
    before: RobotStatus, after: RobotStatus, what: str, text: str
) -> None:
    """Found between two looks at its state; nothing twice, and nothing of what has not changed."""
    assert [(event.what, event.text) for event in of_robot(7, before, after, 1.0)] == [(what, text)]
    assert list(of_robot(7, after, after, 1.0)) == []


def test_who_comes_leaves_and_fails_over() -> None:
    """By presence; a robot that starts again counts from nothing."""
    picture = Picture()
    assert kinds(picture.presence(Change(robot(), True), 1.0)) == ["came"]
    assert kinds(picture.presence(Change(AgentInfo(2, 256, 0, "g1"), True), 1.0)) == ["came"]
    (moved,) = picture.presence(Change(AgentInfo(2, 256, 0, "g2"), True), 2.0)
    assert (moved.what, moved.who) == ("moved", "unity/256")
    (grouped,) = picture.presence(Change(AgentInfo(2, 256, 5, "g2"), True), 2.0)
    assert grouped.text == "unity/256 is in group 5 now"
    assert kinds(picture.presence(Change(AgentInfo(2, 256, 5, "g2"), False), 3.0)) == ["left"]
    assert picture.told(7, status(drops={"stopped": 9}), 0.001, 1.0, 1.0) == []
    picture.presence(Change(robot(zid="b" * 32), True), 4.0)
    assert picture.told(7, status(), 0.001, 2.0, 2.0) == []
    assert picture.told(8, status(), 0.001, 2.0, 2.0) == []


@pytest.mark.parametrize("seen", [True, False], ids=["seen to leave", "not seen to leave"])
@pytest.mark.parametrize("times", [1, 3], ids=["once", "as often as before"])
def test_what_happens_on_a_robot_that_was_started_again_is_told(times: int, seen: bool) -> None:
    """It counts from none: what its dead-men, its stop and its counters say has happened since."""
    picture = Picture()
    picture.presence(Change(robot(), True), 1.0)
    before = structs.replace(
        status(drive("unity/256", trips=3), by="unity/5", times=3, drops={"stopped": 3}),
        trips={"/cmd_vel": TripsStatus(3, "before")},
    )
    assert picture.told(7, before, 0.001, 1.0, 1.0) == []
    if seen:
        picture.presence(Change(robot(), False), 2.0)
    picture.presence(Change(robot(zid="b" * 32), True), 3.0)
    after = structs.replace(
        status(drive("unity/256"), by="unity/9", times=times, drops={"stopped": times}),
        trips={"/cmd_vel": TripsStatus(times, "silence")},
    )
    events = picture.told(7, after, 0.001, 3.0, 3.0)
    assert sorted(kinds(events)) == ["dead-man", "refused", "stopped"]
    assert any(f"refused {times} message" in event.text for event in events)
    assert picture.told(7, after, 0.001, 4.0, 4.0) == []


def test_what_happens_while_a_robot_is_out_of_sight_is_told() -> None:
    """It has not been started again: its link was lost, and what it counts goes on."""
    picture = Picture()
    picture.presence(Change(robot(), True), 1.0)
    picture.told(7, structs.replace(status(), trips={"/cmd_vel": TripsStatus(1, "before")}), 0.001, 1.0, 1.0)
    picture.presence(Change(robot(), False), 2.0)
    picture.presence(Change(robot(), True), 3.0)
    acted = structs.replace(status(), trips={"/cmd_vel": TripsStatus(2, "its link")})
    assert kinds(picture.told(7, acted, 0.001, 3.0, 3.0)) == ["dead-man"]


def test_a_robot_that_does_not_answer_is_told_once() -> None:
    """And that it answers again."""
    picture = Picture()
    picture.presence(Change(robot(), True), 1.0)
    events = [event for _ in range(10) for event in picture.silent(7, "no answer within 2 s", 1.0)]
    assert kinds(events) == ["silent"]
    assert picture.robots[7].unanswered > SILENT_AFTER
    assert picture.state_of(picture.robots[7]) == "does not answer"
    assert kinds(picture.told(7, status(), 0.001, 2.0, 2.0)) == ["came"]


def test_rates_are_those_between_two_looks() -> None:
    """Of messages and bytes; none after the first look, and none after a robot has begun anew."""
    picture = Picture()
    picture.presence(Change(robot(), True), 1.0)
    picture.told(7, status(drive(messages=10)), 0.001, 10.0, 1.0)
    (row,) = picture.topics.values()
    assert row.rate_hz is None
    picture.told(7, status(drive("unity/256", messages=30)), 0.001, 12.0, 1.0)
    (row,) = picture.topics.values()
    assert (row.rate_hz, row.rate_bytes, row.holder) == (10.0, 520.0, "unity/256")
    picture.told(7, status(drive(messages=3)), 0.001, 13.0, 1.0)
    (row,) = picture.topics.values()
    assert row.rate_hz is None
    picture.told(7, status(), 0.001, 14.0, 1.0)
    assert not picture.topics


def test_what_is_lost_is_told_by_name() -> None:
    """How many in all, and a second since the last look."""
    picture = Picture()
    picture.presence(Change(robot(), True), 1.0)
    picture.told(7, status(drops={"stopped": 4}), 0.001, 10.0, 1.0)
    picture.told(7, status(drops={"stopped": 10, "bad_cdr": 1}), 0.001, 12.0, 1.0)
    assert [(row.counter, row.count, row.per_s) for row in picture.losses()] == [
        ("bad_cdr", 1, 0.5),
        ("stopped", 10, 3.0),
    ]
    assert picture.robots[7].lost_per_s == 3.5
    lines = drawn(Screen(picture, View("lost")))
    assert lines[2].split() == ["7", "bad_cdr", "1", "0.5"]


def test_gateways_and_routers_come_and_go() -> None:
    """With their addresses, once each."""
    picture = Picture()
    pong = Pong(time_s=1.0, macs="1", zenoh="1.10.2", address="10.0.0.5:7000", away=[(2, 256)], drops={"no_route": 2})
    (came,) = picture.gateways({"g1": (pong, 0.002)}, 1.0)
    assert came.text == "gateway 10.0.0.5:7000 is there"
    assert picture.gateways({"g1": None}, 2.0) == []
    assert not picture.programs["g1"].answers
    (gone,) = picture.gateways({}, 3.0)
    assert gone.text == "gateway 10.0.0.5:7000 has gone"
    assert kinds(picture.routers([Router("r1", "v1.10.2-x", ["tcp/10.0.0.1:7447"])], ["r1"], Trips(), 1.0)) == ["came"]
    assert kinds(picture.routers([], [], Trips(), 1.0)) == ["left"]


def test_links_are_read_from_what_routers_tell() -> None:
    """Each router's own sessions with routers, once each; a robot's or a gateway's is no link."""
    said = b'{"zid": "aa", "version": "v1.10.2-x", "locators": ["tcp/10.0.0.1:7447"], "plugins": {}, "sessions": ['
    said += b'{"peer": "bb", "whatami": "router", "links": []}, {"peer": "cc", "whatami": "client"}]}'
    router = msgspec.json.decode(said, type=Router)
    assert (router.linked, router.release) == (["bb"], "1.10.2")


def test_a_gateway_tells_of_its_agents() -> None:
    """As many as an answer may have; one that does not know the question sends it back."""
    agents = [GatewayAgent(2, number, f"10.0.0.1:{number}", "anna", 1.5) for number in range(3000)]
    told = decode_told(encode_told(agents, {"NotAdmitted": 3}))
    assert (told.agents, told.lost) == (agents[:2000], {"NotAdmitted": 3})
    assert decode_told(AGENTS) == GatewayTold()
    for wrong in (b"[", b"[]", b'{"agents": [3]}', b"x" * (600 << 10)):
        with pytest.raises(WireError):
            decode_told(wrong)


def test_a_gateway_turns_away() -> None:
    """What it counts between two looks is an event by name; the first look is none, nor what is harmless."""
    picture = Picture()
    picture.gateways({"g1": (Pong(time_s=1.0, address="10.0.0.5:7000"), 0.002)}, 1.0)
    agent = GatewayAgent(2, 256, "10.0.0.9:4000", "anna", 1.0)
    assert picture.told_by_gateway("g1", GatewayTold([agent], {"NotAdmitted": 3}), 1.0) == []
    lost = {"NotAdmitted": 5, "outbox_full": 1, "wrong_sender": 9}
    assert [event.text for event in picture.told_by_gateway("g1", GatewayTold([agent], lost), 2.0)] == [
        "gateway 10.0.0.5:7000 refused 2: no valid token was shown (NotAdmitted)",
        "gateway 10.0.0.5:7000 lost 1 message (outbox_full)",
    ]
    assert picture.known[2, 256] == agent
    assert picture.told_by_gateway("g2", GatewayTold(), 2.0) == []


def drawn(screen: Screen, width: int = 80, height: int = 24) -> list[str]:
    page = io.StringIO()
    console = Console(file=page, width=width, height=height, force_terminal=False)
    console.print(screen.draw(width, height, 20.0), end="")
    return page.getvalue().rstrip("\n").split("\n")


def full_picture() -> Picture:
    picture = Picture()
    for number in range(1, 201):
        picture.presence(Change(robot(number, number % 5), True), 1.0)
        nodes = [
            NodeStatus(
                "subscriber", f"/topic{at}", "std_msgs/msg/String", ["unity/300"], carried=CarriedStatus(10 * at, 0)
            )
            for at in range(3)
        ]
        picture.told(number, status(*nodes, stopped="unity/300" if number == 9 else ""), 0.001 * number, 10.0, 1.0)
    for number in range(300, 1300):
        picture.presence(Change(AgentInfo(2, number, 0, "g1"), True), 1.0)
        picture.known[2, number] = GatewayAgent(2, number, "10.0.0.1:40000", "anna", 75.0)
    return picture


@pytest.mark.parametrize("view", ["robots", "topics", "headsets", "links", "lost", "events"])
@pytest.mark.parametrize("size", [(80, 24), (40, 10), (200, 60)])
def test_a_screen_is_never_larger_than_the_terminal(view: str, size: tuple[int, int]) -> None:
    """With two hundred robots and a thousand headsets, and names that nobody would choose."""
    picture = full_picture()
    picture.topics[1, "subscriber", "/topic0"].name = "/" + "n" * 300 + "\x1b[2J\n"
    screen = Screen(picture, View(view))
    screen.events.extend(Event(1.0, "came", "ros/7", "ros/7 is online" + "." * 200) for _ in range(300))
    lines = drawn(screen, *size)
    assert len(lines) <= size[1]
    assert max(map(len, lines)) <= size[0]
    assert not any("\x1b" in line for line in lines)


def test_rows_are_sorted_filtered_and_scrolled() -> None:
    """By keys, as the help line says."""
    screen = Screen(full_picture())
    view = screen.view
    lines = drawn(screen)
    assert "200 robots  1000 others" in lines[0]
    assert "1 STOPPED" in lines[0]
    assert lines[2].split()[0] == "1"
    for key in ("s", "s", "r"):
        assert view.press(key)
    lines = drawn(screen)
    assert lines[1].split()[2] == "RTT▼"
    assert lines[2].split()[:3] == ["200", "-", "200.0ms"]
    for key in ("2", "/", *"topic2", "\r"):
        view.press(key)
    lines = drawn(screen)
    assert all("/topic2" in line for line in lines[2:20])
    assert "of 200" in lines[-1]
    for key in ("3", "/", "\x1b", "page down", "down"):
        view.press(key)
    lines = drawn(screen)
    assert lines[2].split()[:5] == ["311", "unity", "-", "10.0.0.1:40000", "anna"]
    view.press("\t")
    assert view.name == "links"
    assert not view.press("q")


def test_topics_are_bounded() -> None:
    """Whatever robots tell."""
    picture = Picture()
    picture.presence(Change(robot(), True), 1.0)
    nodes = [
        NodeStatus("subscriber", f"/t{number}", "x/Y", [], carried=CarriedStatus(1, 1))
        for number in range(MOST_TOPICS + 50)
    ]
    picture.told(7, status(*nodes), 0.001, 1.0, 1.0)
    assert len(picture.topics) == MOST_TOPICS
