"""What comes to a robot is judged before it can wait, by what each sender may cost and how long it was on its way."""

from __future__ import annotations

import itertools
import struct
from collections import Counter

import pytest

from macs_zenoh.protocol.guard import Ages, Allowances, Fresh, Guard, Limits
from macs_zenoh.protocol.keyexpr import GROUP, sender_of
from macs_zenoh.protocol.messages import Metadata, NodeType
from macs_zenoh.protocol.reading import Message, Reader
from macs_zenoh.protocol.routing import unicast_key
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message

ME = (1, 7)
KEY = unicast_key(1, 7, 2, 300)
STOP = "nd__emergency_stop"


def test_a_sender_is_what_its_keys_end_in() -> None:
    """By id, by group, by broadcast and as a caller it is one."""
    group = GROUP.of(group=3, type=1, from_type=2, from_id=300)
    keys = [KEY, group, "macs/all/unity/300", "macs/call/ros/7/stop/unity/300"]
    assert {sender_of(key) for key in keys} == {"unity/300"}
    assert sender_of("x") == "x"


def test_each_sender_has_an_allowance_of_its_own() -> None:
    """Who floods is served at the rate; another's first message passes all the same."""
    allowances = Allowances(100)
    passed = sum(allowances.take("flooder", 300, number / 10_000) for number in range(20_000))
    assert 290 <= passed <= 310
    assert allowances.take("other", 300, 2.0)


def test_all_together_have_an_allowance_too() -> None:
    """A hundred senders at their limit cost no more than a few, and who sends little passes whatever they do."""
    allowances, passed, little = Allowances(100), 0, 0
    for number in range(100_000):
        now = number / 20_000
        passed += allowances.take(f"s{number % 100}", 300, now)
        if number % 1000 == 0:
            little += allowances.take("other", 300, now)
    at_first = 2 * 100 * 100 * (1 - Allowances.LITTLE)  # until all have sent much
    assert passed <= 100 * Allowances.TOGETHER * 6 + at_first
    assert little == 100


def test_many_that_begin_at_once_have_no_second_of_it_at_once() -> None:
    """Or the answers to all of it would be on everybody's way in one go; at the rate it goes on."""
    allowances = Allowances(100)

    def passed(now: float) -> int:
        return sum(allowances.take(f"unity/{sender}", 10, now) for _ in range(100) for sender in range(20))

    at_first = 20 * 100 * (1 - Allowances.LITTLE)
    assert passed(0.0) == pytest.approx(at_first + 100, abs=20)
    assert sum(passed(tick / 100) for tick in range(1, 101)) == pytest.approx(100 * Allowances.TOGETHER, rel=0.05)


def test_a_large_message_costs_more_and_passes_nevertheless() -> None:
    """One that is larger than all that a sender may send in a second passes, a second one right after it does not."""
    allowances = Allowances(100)
    assert allowances.take("a", 100 << 20, 0.0)
    passed = sum(allowances.take("a", 100 << 20, 0.0) for _ in range(100))
    assert passed <= 3


@pytest.mark.parametrize("offset", [0.0, 1e9, -1e9])
def test_ages_need_no_common_clock(offset: float) -> None:
    """However far two clocks are apart, and drift: what has waited is older, by as long as it waited."""
    ages, drift = Ages(), 1.0001
    for number in range(2000):
        now = number / 10
        age = ages.age("unity/300", "router", offset + (now - 0.02) * drift, now)
        assert age < 0.02
    for waited in (1.5, 1.0, 0.5, 0.0):
        age = ages.age("unity/300", "router", offset + (200.0 - 0.02 - waited) * drift, 200.0)
        assert age == pytest.approx(waited, abs=0.02)


def test_a_queue_in_which_all_wait_for_minutes_is_not_taken_for_the_way() -> None:
    """Somebody floods, and whatever else comes has waited behind that: it is as old as that all the time."""
    ages, offset = Ages(), 5.0
    for number in range(1000):
        now = number / 5
        waited = 0.25 if now >= 50 else 0.0
        age = ages.age("unity/300", "router", offset + now - 0.02 - waited, now)
        assert age == pytest.approx(waited)


def test_a_clock_that_was_put_forward_makes_nothing_old() -> None:
    """A hybrid clock stands still until time has come up to it; then it goes on."""
    ages = Ages()
    for number in range(100):
        assert ages.age("unity/300", "router", number / 10, number / 10) == 0.0
    for number in range(100):
        now = 10 + number / 10
        assert ages.age("unity/300", "router", max(now, 15.0 + number * 1e-8), now) < 0.11


def heard(ages: Ages, sender: str, *, delay: float, until: float = 10.0, clock: str = "router") -> None:
    """Somebody has sent for a while; the clock differs from ours, and the way is long, by `delay`."""
    for number in range(20):
        now = until - 2 + number / 10
        ages.age(sender, clock, now - delay, now)


def test_two_stamps_in_one_moment_make_a_backlog_no_younger() -> None:
    """What was put twice in one moment and came much later is as old as it is: only a clock that stands still for
    longer was put forward."""
    for step in (0.0, 1e-7, 5e-6):
        ages = Ages()
        for number in range(100):
            assert ages.age("unity/300", "router", number / 10, number / 10) == 0.0
        assert ages.age("unity/300", "router", 10.0, 10.0) == 0.0
        waited = [ages.age("unity/300", "router", 10.0 + step, 11.5), ages.age("unity/300", "router", 10.05, 11.5)]
        assert waited == pytest.approx([1.5, 1.45], abs=0.001)


@pytest.mark.parametrize("forged", [-3600.0, -0.4, 3600.0])
def test_who_forges_stamps_changes_nobody_elses_age(forged: float) -> None:
    """With stamps in the future or the past, on the clock that others use: their commands are as old as before."""
    ages = Ages()
    heard(ages, "unity/300", delay=5.0)
    heard(ages, "unity/666", delay=5.0 + forged)
    heard(ages, "unity/666", delay=5.0, until=10.5)
    assert ages.age("unity/300", "router", 11.0 - 5.0, 11.0) == pytest.approx(0, abs=1e-6)
    assert ages.age("unity/300", "router", 12.0 - 7.0, 12.0) == pytest.approx(2)


def test_clocks_that_somebody_makes_up_displace_his_own_only() -> None:
    """After a thousand forged clocks of one sender an old command of another is as old as it is, known or new."""
    ages = Ages()
    heard(ages, "unity/300", delay=5.0)
    for number in range(1000):
        ages.age("unity/666", f"forged{number}", 0.0, 10.0)
    assert ages.age("unity/300", "router", 11.0 - 7.0, 11.0) == pytest.approx(2)
    assert ages.age("unity/301", "router", 11.0 - 7.0, 11.0) == pytest.approx(2)


def test_names_that_somebody_makes_up_displace_those_heard_longest_ago() -> None:
    """Who sends all the time is not forgotten, however many names pass by."""
    ages = Ages()
    for number in range(10 * Ages.SENDERS):
        ages.age(f"unity/{1000 + number}", "forged", 0.0, 10.0 + number / 1000)
        if number % 100 == 0:
            now = 10.0 + number / 1000
            assert ages.age("unity/300", "router", now - 5.0, now) == pytest.approx(0, abs=1e-6)
    assert ages.age("unity/300", "router", 21.0 - 7.0, 21.0) == pytest.approx(2)


def test_a_new_sender_is_compared_with_others_on_its_clock() -> None:
    """What waited for its sender to connect is old, all that comes at first; with nobody to compare, nothing is."""
    ages = Ages()
    heard(ages, "unity/300", delay=5.0)
    for number in range(10):
        now = 11.0 + number / 1000
        assert ages.age("unity/301", "router", 10.0 - 7.0 + number / 10, now) == pytest.approx(
            now - 5.0 - (3.0 + number / 10)
        )
    assert ages.age("unity/301", "router", 11.5 - 5.0, 11.5) == pytest.approx(0, abs=1e-6)
    assert ages.age("unity/302", "another router", 3.0, 11.5) == 0.0


def test_one_forger_among_three_does_not_shift_what_newcomers_are_compared_with() -> None:
    """Stamps of an hour ahead make no newcomer's command old, those of an hour ago none young."""
    for forged in (-3600.0, 3600.0):
        ages = Ages()
        for sender, delay in (("unity/300", 5.0), ("unity/301", 5.001), ("unity/666", 5.0 + forged)):
            heard(ages, sender, delay=delay)
        assert ages.age("unity/302", "router", 11.0 - 5.0, 11.0) == pytest.approx(0, abs=0.01)
        assert ages.age("unity/303", "router", 11.0 - 7.0, 11.0) == pytest.approx(2, abs=0.01)


def test_what_a_single_forger_costs_newcomers_is_a_moment() -> None:
    """Held back by stamps from the future, a new sender passes after a second."""
    ages = Ages()
    heard(ages, "unity/666", delay=5.0 - 3600)
    at_first = [ages.age("unity/300", "router", 11.0 + n / 20 - 5.0, 11.0 + n / 20) for n in range(20)]
    assert min(at_first) > 3000
    assert ages.age("unity/300", "router", 12.1 - 5.0, 12.1) == pytest.approx(0, abs=1e-6)


def test_of_commands_that_waited_none_is_carried_out() -> None:
    """Ten commands that waited up to 1.6 s come at once: none passes, and the next one that comes in time does."""
    fresh = Fresh(0.5)
    assert fresh.take("a", 0.0, 0.0)
    passed = [fresh.take("a", 1.6 - number / 10, 10.0 + number / 10_000) for number in range(16)]
    assert not any(passed)
    assert fresh.take("b", 0.3, 10.0), "others did not wait with it"
    assert fresh.take("a", 0.02, 10.1)
    assert fresh.take("a", 0.3, 10.2), "and a little late is not late"


def test_a_way_that_has_become_longer_does_not_silence_for_ever() -> None:
    """What comes regularly and is never too old passes after a moment."""
    fresh = Fresh(0.5)
    assert not fresh.take("a", 0.9, 0.0)
    taken = [fresh.take("a", 0.3, number / 20) for number in range(1, 40)]
    assert not any(taken[:15])
    assert all(taken[25:])


def test_who_has_waited_is_not_forgotten_because_of_others() -> None:
    """The late commands of a thousand others do not let those of one pass that waited, as long as they come."""
    fresh = Fresh(0.5)
    assert not fresh.take("a", 0.9, 0.0)
    for number in range(10 * Fresh.LATE):
        now = number / 20_000
        fresh.take(f"s{number}", 9.0, now)
        if number % 500 == 0:
            assert not fresh.take("a", 0.3, now)


def test_new_names_bring_no_new_credit() -> None:
    """Who sends under more names than are remembered has what those have together, not a full one with each name."""
    allowances, passed = Allowances(100), 0
    allowances.SENDERS = 16
    for number in range(100_000):
        passed += allowances.take(f"s{number % 32}", 300, 0.0)
    assert passed <= 16 * 100


def test_no_limit_is_none() -> None:
    """0 is no limit, for ages and for rates."""
    assert Fresh(0).take("a", 1e9, 0.0)
    assert all(Allowances(0).take("a", 1 << 30, 0.0) for _ in range(10_000))


# -- the guard of a robot --------------------------------------------------------------------------------------------


def frame(node: str = "nd__cmd_vel", data: bytes = b"\x00\x01\x00\x00\x01", kind: int = NodeType.PUBLISHER) -> bytes:
    said = Metadata(node_type=kind, node_name=node, data_exchange_type="x")
    return encode_frame(1, (7,), message=encode_message(said.encode(), data))


@pytest.fixture
def taken() -> list[Message]:
    return []


@pytest.fixture
def guard(taken: list[Message]) -> Guard:
    guard = Guard(Limits(100, 10, 0.5), MACS)
    guard.me, guard.stop_name, guard.on_command = ME, STOP, taken.append
    return guard


def test_commands_are_taken_and_all_else_is_left(guard: Guard, taken: list[Message]) -> None:
    """One command or several in one sample, in order; a request, and what cannot be read, is for the loop."""
    assert guard.first(KEY, frame(data=b"a") + frame(data=b"b"), 0.0, 0.0)
    assert guard.first(KEY, frame(data=b"c"), 0.0, 0.0)
    assert [message.data for message in taken] == [b"a", b"b", b"c"]
    for other in (
        frame(kind=NodeType.CLIENT),
        frame(node=""),
        frame() + frame(kind=NodeType.CLIENT),
        frame()[:-1],
        b"",
    ):
        assert not guard.first(KEY, other, 0.0, 0.0)
    assert len(taken) == 3


def test_commands_among_others_are_held_to_their_age(guard: Guard, taken: list[Message]) -> None:
    """What goes to the loop with other messages is judged there: what has waited too long, on the way or for the loop,
    is not delivered; what is no command is, and a stop has been carried out before."""
    dropped = []
    guard.on_dropped = lambda name, sender, why, count=1: dropped.append(name)
    mixed = frame(data=b"old") + frame(kind=NodeType.CLIENT) + frame(STOP)
    assert not guard.first(KEY, mixed, 0.7, 0.0)
    assert [message.metadata.node_name for message in taken] == [STOP]
    messages = Reader(MACS, lambda key, error: None).read(KEY, mixed, ME, by_group=False)
    assert [guard.judge(message, KEY, 0.7, 0.0) is not None for message in messages] == [False, True, True]
    assert dropped == ["too_old"]
    assert [guard.judge(message, KEY, 0.001, 1.0) is not None for message in messages] == [True, True, True]


def test_a_group_copy_is_dropped_where_the_id_is_named(guard: Guard, taken: list[Message]) -> None:
    """One command by id and by group is carried out once."""
    group = GROUP.of(group=3, type=1, from_type=2, from_id=300)
    both = encode_frame(
        1, (7,), (3,), message=encode_message(Metadata(node_type=2, node_name="nd__x").encode(), b"\x00\x01\x00\x00")
    )
    for _ in range(3):
        guard.first(KEY, both, 0.0, 0.0)
        guard.first(group, both, 0.0, 0.0)
    assert len(taken) == 3


def test_a_stop_passes_however_old_and_however_many(guard: Guard, taken: list[Message]) -> None:
    """Who floods may stop the robot, in the middle of it, and a stop that has waited stops; a release does neither."""
    dropped = []
    guard.on_dropped = lambda name, sender, why, count=1: dropped.append(name)
    stop, release = frame(STOP), frame(STOP, b"\x00\x01\x00\x00\x00")
    assert guard.first(KEY, stop, 9.0, 0.0)
    assert guard.first(KEY, release, 9.0, 0.0)
    assert [message.data[4] for message in taken] == [1]
    while guard.admits(KEY, len(stop), True, 0.0):
        pass
    guard.rescue(KEY, frame() + stop + release + frame(), 0.0)
    guard.rescue(KEY, release, 0.0)
    guard.rescue(KEY, frame(), 0.0)
    assert [message.data[4] for message in taken] == [1, 1]
    assert dropped == ["too_old", "flooded"]


def test_a_release_that_a_stop_has_overtaken_releases_nothing(guard: Guard, taken: list[Message]) -> None:
    """Who asks for a stop is faster than what he puts: his release from before it comes later, and is none any more;
    one that was sent after it is, and so is another's."""
    release = frame(STOP, b"\x00\x01\x00\x00\x00")
    guard.pressed((2, 300), 10.0)
    assert guard.first(KEY, release, 0.3, 10.2)
    assert not taken
    assert guard.first(unicast_key(1, 7, 2, 301), release, 0.3, 10.2)
    assert guard.first(KEY, frame(), 0.3, 10.2)
    assert guard.first(KEY, release, 0.001, 10.3)
    assert len(taken) == 3
    for number in range(2 * Guard.PRESSED):
        guard.pressed((2, 1000 + number), 11.0)
    assert len(guard._pressed) == Guard.PRESSED


def test_a_sample_of_many_messages_costs_what_they_cost(guard: Guard, taken: list[Message]) -> None:
    """However small they are: of a thousand in one sample as many pass as their sender may send, and each stop."""
    dropped: Counter[str] = Counter()

    def note(name: str, sender: str, why: str, count: int = 1) -> None:
        dropped[name] += count

    guard.on_dropped = note
    small = encode_frame(1, (7,), message=encode_message(b'{"nodeType":2,"nodeName":"x"}', b"c"))
    sample = small * 1000 + frame(STOP)
    assert guard.admits(KEY, len(sample), True, 0.0)
    assert guard.first(KEY, sample, 0.0, 0.0)
    assert [message.metadata.node_name for message in taken[-1:]] == [STOP]
    assert 1 < len(taken) <= 101
    assert dropped == {"flooded": 1001 - len(taken)}
    asked = Reader(MACS, lambda key, error: None).read(KEY, frame("", kind=0) * 300, ME, by_group=False)
    assert guard.admits(KEY, 300 * 200, False, 0.0)
    assert 1 < len(guard.covered(KEY, 300 * 200, asked, 0.0)) <= 10
    assert len(guard.covered(unicast_key(1, 7, 2, 301), 200 * 5, asked[:5], 0.0)) == 5


def test_a_command_tells_how_long_it_has_waited(guard: Guard, taken: list[Message]) -> None:
    """So that a dead-man counts from when it was sent."""
    assert guard.first(KEY, frame(), 0.4, 10.0)
    assert guard.first(KEY, frame(), 0.001, 11.0)
    assert [message.age_s for message in taken] == [0.4, 0.0]


def test_who_names_the_stop_without_end_does_not_take_a_robots_time(guard: Guard, taken: list[Message]) -> None:
    """What is looked at for a stop, of all that is not admitted, is as much as may be admitted; another's is apart."""
    for number in range(1000):
        guard.rescue(KEY, frame(STOP) * 10, number / 1000)
    assert 10 <= len(taken) <= 2500
    taken.clear()
    guard.rescue(unicast_key(1, 7, 2, 301), frame(STOP), 1.0)
    assert len(taken) == 1


def test_requests_do_not_use_up_what_commands_may(guard: Guard) -> None:
    """Urgent samples have an allowance of their own."""
    admitted = list(itertools.takewhile(bool, (guard.admits(KEY, 300, False, 0.0) for _ in range(100))))
    assert len(admitted) == 10
    assert guard.admits(KEY, 300, True, 0.0)


def test_nothing_is_taken_before_the_robot_is_there(guard: Guard) -> None:
    """Until somebody judges commands, all goes to the loop."""
    guard.on_command = None
    assert not guard.first(KEY, frame(), 0.0, 0.0)
    guard.rescue(KEY, frame(STOP), 0.0)


@pytest.mark.parametrize("stood_s", [Ages.FORGET_S / 2, Ages.FORGET_S + 100, 86_400.0])
@pytest.mark.parametrize("senders", [1, 3])
def test_what_waited_while_the_robot_stood_still_is_old(stood_s: float, senders: int) -> None:
    """A suspended program reads at once what has come since, however long that was; what is sent then is new."""
    ages, fresh = Ages(), Fresh(1.0)
    names = [f"unity/{number}" for number in range(senders)]

    def taken(sent: float, now: float) -> int:
        return sum(fresh.take(name, ages.age(name, "router", sent - 1e6, now), now) for name in names)

    for tick in range(1200):
        assert taken(tick / 20, tick / 20 + 0.01) == senders
    now = 60.0 + stood_s
    assert sum(taken(60.0 + tick / 20, now + tick / 1e4) for tick in range(40)) == 0
    assert taken(now + 1.0, now + 1.01) == senders


@pytest.mark.parametrize("age_s", [0.7, 90.0])
def test_a_velocity_of_zero_passes_however_old(guard: Guard, taken: list[Message], age_s: float) -> None:
    """Who lets go of the stick while the network stands still says so once; what he said before is not carried out,
    nor behind it what waited with it."""
    dropped = []
    guard.on_dropped = lambda name, sender, why, count=1: dropped.append(name)

    def moving(speed: float) -> bytes:
        metadata = Metadata(node_type=2, node_name="nd__cmd_vel", data_exchange_type="geometry_msgs/Twist")
        data = b"\0\1\0\0" + struct.pack("<6d", speed, 0, 0, 0, 0, 0)
        return encode_frame(1, (7,), message=encode_message(metadata.encode(), data))

    assert guard.first(KEY, moving(1.0) + moving(0.0) + moving(2.0), age_s, 10.0)
    assert guard.first(KEY, moving(3.0), age_s, 10.0)
    assert [struct.unpack_from("<d", message.data, 4)[0] for message in taken] == [0.0]
    assert taken[0].age_s == age_s
    assert dropped == ["too_old"] * 3
    messages = Reader(MACS, lambda key, error: None).read(KEY, moving(1.0) + moving(0.0), ME, by_group=False)
    assert [guard.judge(message, KEY, age_s, 10.0) is not None for message in messages] == [False, True]
