"""Who is online is what the tokens say, and what was told about it adds up to the same."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from macs_zenoh.protocol.directory import AgentInfo, Change, Directory
from macs_zenoh.protocol.keyexpr import LEASE, UNICAST

GRACE_S = 2.0
ROBOT = AgentInfo(1, 7, 3, "a1")

agents = st.sampled_from(
    [
        *(AgentInfo(*fields) for fields in ((1, 1, 0, "a"), (1, 1, 1, "a"), (1, 1, 0, "b"), (1, 2, 0, "a"))),
        AgentInfo(2, 1, 1, "a"),
        AgentInfo(1, 1, 0, "a", asleep=1),
    ]
)
"""Few, so that much happens to each: two groups of one session, two sessions with one id, and one who sleeps."""

steps = st.lists(
    st.tuples(st.just("alive"), agents)
    | st.tuples(st.just("ended"), agents)
    | st.tuples(st.just("link"), st.booleans())
    | st.tuples(st.just("time"), st.floats(0, 3))
    | st.tuples(st.just("tick"), st.none()),
    max_size=40,
)


def key(agent: AgentInfo) -> str:
    """An agent's presence token."""
    return agent.presence


class Story:
    """A directory, what it was told, and what an observer of its changes believes."""

    def __init__(self) -> None:
        self.directory = Directory(GRACE_S)
        self.now = 100.0
        self.linked = True
        self.quiet_until = 0.0
        self.told: dict[tuple[int, int], AgentInfo] = {}
        self.tokens: dict[tuple[int, int], dict[str, AgentInfo]] = {}

    def happen(self, what: str, value: AgentInfo | bool | float | None) -> list[Change]:
        """One thing happens; returns the changes that the directory tells."""
        changes: list[Change] = []
        if isinstance(value, AgentInfo):
            self._note(what, value)
            changes = self.directory.token(key(value), what == "alive", self.now)
        elif what == "link":
            if not (value and self.linked):
                self.quiet_until = self.now + GRACE_S
            self.linked = bool(value)
            self.directory.link(self.linked, self.now)
        elif what == "time":
            self.now += float(value or 0)
        else:
            changes = self.directory.tick(self.now)
        for agent, online, _ in changes:
            if online:
                self.told[agent.key] = agent
            else:
                del self.told[agent.key]
        return changes

    def _note(self, what: str, agent: AgentInfo) -> None:
        """The tokens as Zenoh has them: per session the newest group."""
        claims = self.tokens.setdefault(agent.key, {})
        if what == "alive":
            claims[agent.zid] = agent
        elif claims.get(agent.zid) == agent:
            del claims[agent.zid]

    @property
    def quiet(self) -> bool:
        """Whether nobody may be said to have left."""
        return not self.linked or self.now < self.quiet_until

    def truth(self) -> list[AgentInfo]:
        """Who is online, by the tokens alone."""
        return [claims[min(claims)] for _, claims in sorted(self.tokens.items()) if claims]


@given(steps)
def test_what_is_told_adds_up(story_steps: list[tuple[str, AgentInfo | bool | float | None]]) -> None:
    """After any sequence of events, who follows the changes knows exactly who is in the directory, and nobody is
    told to have left who was not there."""
    story = Story()
    for what, value in story_steps:
        story.happen(what, value)
        directory = story.directory
        assert list(directory) == [agent for _, agent in sorted(story.told.items())]
        assert len(directory) == len(story.told)
        for kind in (1, 2, 3):
            of_type = [agent for agent in directory if agent.type == kind]
            assert directory.of_type(kind) == of_type
            assert directory.ids(kind) == [agent.id for agent in of_type]
        claims = directory.claims()
        for agent_id in range(1, 10):
            for zid in ("a", "b", "nobody"):
                others = [claim for claim in claims if claim.id == agent_id and claim.zid != zid]
                assert directory.is_elsewhere(agent_id, zid) == bool(others)
        for agent in directory:
            assert agent.key in directory
            assert directory.get(*agent.key) == agent
            assert agent in directory.claimants(*agent.key)
        assert {claim.key for claim in directory.claims()} == {agent.key for agent in directory}


@given(steps)
def test_in_the_end_the_tokens_are_right(story_steps: list[tuple[str, AgentInfo | bool | float | None]]) -> None:
    """Once the link is up and the grace over, exactly those are online whose tokens are, whatever happened before."""
    story = Story()
    for what, value in [*story_steps, ("link", True), ("time", GRACE_S), ("tick", None)]:
        story.happen(what, value)
    assert list(story.directory) == story.truth()
    tokens = [agent for claims in story.tokens.values() for agent in claims.values()]
    assert story.directory.claims() == sorted(tokens)
    for zid in ("a", "b"):
        theirs = {key: [z for z in claims if z != zid] for key, claims in story.tokens.items() if zid in claims}
        assert story.directory.contested(zid) == {key: others for key, others in theirs.items() if others}
    assert story.directory.next_deadline() is None


@example([("alive", ROBOT), ("link", False), ("link", True), ("ended", ROBOT)])
@given(steps)
def test_nobody_leaves_while_we_cannot_know(story_steps: list[tuple[str, AgentInfo | bool | float | None]]) -> None:
    """While our own link is down, and for the grace after it came back, nobody is said to have left; later, nothing
    waits longer than the deadline says."""
    story = Story()
    for what, value in story_steps:
        changes = story.happen(what, value)
        deadline = story.directory.next_deadline()
        if story.quiet:
            assert all(change.online for change in changes)
            assert deadline is None or (story.linked and deadline == story.quiet_until)
        elif what == "tick":
            assert deadline is None


def test_a_deadline_is_when_a_tick_has_effect() -> None:
    """An agent in doubt leaves at the deadline: not at a tick before it, and once."""
    story = Story()
    story.happen("alive", ROBOT)
    story.happen("link", False)
    assert story.happen("ended", ROBOT) == []
    assert story.directory.next_deadline() is None, "the link is down: nothing to wait for"
    story.happen("link", True)
    assert story.directory.next_deadline() == story.now + GRACE_S
    story.happen("time", GRACE_S - 0.1)
    assert story.happen("tick", None) == []
    story.happen("time", 0.1)
    assert story.happen("tick", None) == [Change(ROBOT, online=False)]
    assert story.happen("tick", None) == []


def test_who_comes_back_within_the_grace_never_left() -> None:
    """When our router fails over and all tokens return, nothing is told."""
    story = Story()
    story.happen("alive", ROBOT)
    for what, value in [("link", False), ("ended", ROBOT), ("link", True), ("alive", ROBOT)]:
        assert story.happen(what, value) == []
    story.happen("time", GRACE_S)
    assert story.happen("tick", None) == []
    assert list(story.directory) == [ROBOT]


@pytest.mark.parametrize("old_token_first", [True, False])
def test_a_change_of_group_keeps_the_agent(old_token_first: bool) -> None:
    """An agent that declares itself in another group is there in the new one, whichever token's news comes first."""
    story = Story()
    before, after = AgentInfo(2, 7, 3, "a1"), AgentInfo(2, 7, 5, "a1")
    story.happen("alive", before)
    for what, agent in sorted([("ended", before), ("alive", after)], reverse=old_token_first):
        story.happen(what, agent)
    assert list(story.directory) == [after]
    assert story.told == {(2, 7): after}


@pytest.mark.parametrize("smallest_first", [True, False])
def test_two_sessions_with_one_id_are_seen(smallest_first: bool) -> None:
    """Of two that claim one id the smaller session counts, whichever came first, and both are claimants; when it
    goes, the other is there."""
    story = Story()
    smaller, greater = AgentInfo(1, 7, 0, "a1"), AgentInfo(1, 7, 3, "b2")
    first, second = (smaller, greater) if smallest_first else (greater, smaller)
    assert story.happen("alive", first) == [Change(first, online=True)]
    assert story.happen("alive", second) == ([] if smallest_first else [Change(smaller, online=True)])
    assert story.directory.get(1, 7) == smaller
    assert story.directory.claims() == [smaller, greater]
    assert story.directory.contested("a1") == {(1, 7): ["b2"]}
    assert story.directory.contested("c3") == {}
    assert len(story.directory) == 1
    assert story.happen("ended", smaller) == [Change(greater, online=True)]
    assert story.directory.contested("b2") == {}
    assert story.happen("ended", greater) == [Change(greater, online=False)]
    assert story.directory.claimants(1, 7) == []
    assert story.directory.get(1, 7) is None


def test_an_earlier_life_in_doubt_does_not_hide_the_later() -> None:
    """A robot that was restarted while our link was down is seen at once, whatever its old session was called."""
    story = Story()
    old, new = AgentInfo(1, 7, 3, "a1"), AgentInfo(1, 7, 3, "b2")
    story.happen("alive", old)
    story.happen("link", False)
    story.happen("ended", old)
    story.happen("link", True)
    assert story.happen("alive", new) == [Change(new, online=True)]
    assert story.directory.get(1, 7) == new
    story.happen("time", GRACE_S)
    assert story.happen("tick", None) == []
    assert list(story.directory) == [new]


def test_a_token_told_twice_is_told_once() -> None:
    """The history of a late watcher and the live token of the same agent make one agent and one change."""
    story = Story()
    robot = AgentInfo(1, 7, 0, "a1")
    assert story.happen("alive", robot) == [Change(robot, online=True)]
    assert story.happen("alive", robot) == []
    assert story.happen("ended", robot) == [Change(robot, online=False)]
    assert story.happen("ended", robot) == []


def test_the_next_one_with_an_id_is_another_agent() -> None:
    """A gateway that gives an id again says so by the epoch, also to who never saw the first one leave: in one burst,
    or while its own link was down. What ends late is the first one's."""
    first, second = AgentInfo(2, 300, 3, "a1", 17), AgentInfo(2, 300, 3, "a1", 18)
    for happening in ([], [("ended", first)]):
        story = Story()
        story.happen("alive", first)
        story.happen("link", False)
        for what, agent in happening:
            assert story.happen(what, agent) == []
        story.happen("link", True)
        assert story.happen("alive", second) == [Change(first, online=False), Change(second, online=True)]
        assert story.happen("ended", first) == []
        assert list(story.directory) == [second]


@pytest.mark.parametrize("agent", [AgentInfo(2, 300, 3, "a1"), AgentInfo(1, 7, 0, "b2", 12345)])
def test_a_token_says_who_it_is(agent: AgentInfo) -> None:
    """A key with and without an epoch; one that is no number is none of ours."""
    assert AgentInfo.parse(agent.presence) == agent
    for wrong in ("x", "-1", "\u0661", "9" * 20, "1.2"):
        assert AgentInfo.parse(f"macs/live/ros/0/7/0/a1.{wrong}") is None


def test_ids_are_per_type() -> None:
    """A robot and a headset with the same id are two agents."""
    story = Story()
    robot, headset = AgentInfo(1, 7, 0, "a1"), AgentInfo(2, 7, 0, "a1")
    story.happen("alive", robot)
    story.happen("alive", headset)
    story.happen("ended", robot)
    assert list(story.directory) == [headset]
    assert headset.type_name == "unity"


def test_other_keys_are_not_presence() -> None:
    """Keys of other spaces and keys that are none change nothing."""
    directory = Directory()
    others = [
        LEASE.of(block=0, zid="a1"),
        UNICAST.of(type=1, block=0, id=7, from_type=2, from_id=8),
        "",
        "macs/live/**",
        "macs/live/ros/1/7/0/a1",
    ]
    assert [directory.token(other, True, 0.0) for other in others] == [[]] * len(others)
    assert len(directory) == 0


def test_one_session_cannot_fill_the_directory() -> None:
    """Of one session only so many agents count; those of others do, and who came before there was room does when he is
    told of again."""
    directory = Directory()
    for number in range(Directory.PER_SESSION + 10):
        directory.token(key(AgentInfo(3 + number // 60_000, number % 60_000 + 1, 0, "a")), True, 0.0)
    assert (len(directory), directory.room.left_out) == (Directory.PER_SESSION, 10)
    assert directory.token(key(AgentInfo(2, 1, 0, "b")), True, 0.0)
    early = key(AgentInfo(2, 2, 0, "a"))
    assert not directory.token(early, True, 0.0)
    assert not directory.room.is_made()
    assert directory.token(key(AgentInfo(3, 1, 0, "a")), False, 0.0)
    assert directory.room.is_made()
    assert not directory.knows(early)
    assert directory.token(early, True, 0.0)
    assert not directory.token(key(AgentInfo(2, 3, 0, "a")), True, 0.0)


@given(st.permutations([f"{number:02x}" for number in range(30)]), st.permutations(list(range(30))))
def test_of_many_claims_the_smallest_count(zids: list[str], order: list[int]) -> None:
    """Who sees the tokens for one agent in another order sees the same claims and the same holder; what is told adds
    up, and who holds it himself always sees that."""
    directory, other = Directory(), Directory(mine="1d")
    told = [change for zid in zids for change in directory.token(key(ROBOT._replace(zid=zid)), True, 0.0)]
    for number in order:
        other.token(key(ROBOT._replace(zid=zids[number])), True, 0.0)
    smallest = sorted(zids)[: Directory.PER_AGENT]
    assert sorted(agent.zid for agent in directory.claimants(1, 7)) == smallest
    assert {agent.zid for agent in other.claimants(1, 7)} <= {*zids}
    assert other.get(1, 7) == directory.get(1, 7) == told[-1].agent
    assert "1d" in {agent.zid for agent in other.claimants(1, 7)}
    assert len(other.contested("1d")[1, 7]) >= Directory.PER_AGENT - 1


def test_who_was_left_out_comes_back() -> None:
    """A robot that came after sixteen made up sessions that claim to be it is there when they are gone and it is told
    of again; until then there is a robot with this id."""
    directory = Directory()
    made_up = [ROBOT._replace(zid=f"00{number:04x}") for number in range(Directory.PER_AGENT)]
    for each in made_up:
        directory.token(key(each), True, 0.0)
    assert not directory.token(key(ROBOT), True, 0.0)
    assert ROBOT.key in directory
    for each in made_up:
        directory.token(key(each), False, 0.0)
    assert directory.room.is_made()
    assert not directory.room.is_made()
    assert not directory.knows(key(ROBOT))
    assert directory.token(key(ROBOT), True, 0.0) == [Change(ROBOT, online=True)]
    assert directory.knows(key(ROBOT._replace(group=4)))
    directory.token(key(ROBOT), False, 0.0)
    assert not directory.room.is_made()


def test_all_claims_have_an_end_and_a_robot_is_always_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever others claim, a robot that nobody else claims to be counts, as does what is our own; a headset does
    when there is room."""
    monkeypatch.setattr(Directory, "IN_ALL", 50)
    directory = Directory(mine="99")
    for number in range(60):
        directory.token(key(AgentInfo(2, number + 1, 0, f"{number:04x}")), True, 0.0)
    assert len(directory) == 50
    assert directory.token(key(AgentInfo(2, 1, 3, "0000")), True, 0.0)  # another group, the same claim
    assert directory.token(key(ROBOT), True, 0.0)
    assert directory.token(key(AgentInfo(2, 99, 0, "99")), True, 0.0)
    late = key(AgentInfo(2, 60, 0, "ff"))
    assert not directory.token(late, True, 0.0)
    for number in range(1, 4):
        directory.token(key(AgentInfo(2, number + 1, 0, f"{number:04x}")), False, 0.0)
    assert directory.room.is_made()
    assert directory.token(late, True, 0.0)


def test_who_sleeps_is_online_and_does_not_leave() -> None:
    """Asleep and awake again is told as that and as nothing else, in whatever order the token before it ends; who does
    not wake up leaves once."""
    story = Story()
    awake = AgentInfo(2, 7, 3, "a", 5)
    asleep = awake._replace(asleep=1)
    assert AgentInfo.parse(asleep.presence) == asleep
    assert AgentInfo.parse(awake.presence) == awake
    assert story.happen("alive", awake) == [Change(awake, online=True)]
    assert story.happen("alive", asleep) == [Change(asleep, online=True, same=True)]
    assert story.happen("ended", awake) == []
    assert story.happen("alive", awake) == [Change(awake, online=True, same=True)]
    assert story.happen("ended", asleep) == []
    assert story.happen("alive", asleep) == [Change(asleep, online=True, same=True)]
    assert story.happen("ended", awake) == []
    once_more = asleep._replace(asleep=2)
    assert story.happen("alive", once_more) == [Change(once_more, online=True, same=True)]
    assert story.happen("ended", asleep) == []
    asleep = once_more
    regrouped = asleep._replace(group=4)
    assert story.happen("alive", regrouped) == [Change(regrouped, online=True)]
    assert story.happen("ended", asleep) == []
    assert story.happen("ended", regrouped) == [Change(regrouped, online=False)]
