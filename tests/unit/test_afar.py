"""How long a sender is slowed down for receivers behind other gateways."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from bridge.gateway import afar
from bridge.gateway.afar import Afar, FarSender
from bridge.gateway.backpressure import HELD_S, HOLD_S, STOPPED_S, Patience
from macs_zenoh.mesh import Sample
from macs_zenoh.protocol.keyexpr import SLOW
from macs_zenoh.protocol.messages import UNITY
from macs_zenoh.protocol.slow import Note
from tests.unit.test_backpressure import Clock

SENDER = (UNITY, 7)
RECEIVERS = 5


class Slowed:
    """A connection, and for how long it was not read from; it sends as soon as it is."""

    def __init__(self, clock: Clock) -> None:
        self.patience, self.drives = Patience(), False
        self.pauses, self.paused_s = 0, 0.0
        self._clock, self._since = clock, 0.0

    def pause(self) -> None:
        self.pauses += 1
        self._since = self._clock.time()

    def resume(self) -> None:
        self.pauses -= 1
        self.paused_s += self._clock.time() - self._since


class Site:
    """A gateway with one sender, and others that note things to it."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.sender = clock, Slowed(clock)
        mesh: Any = SimpleNamespace(zid="here")
        agents: Any = SimpleNamespace(find=lambda *key: self.sender if key == SENDER else None)
        directory: Any = SimpleNamespace(get=lambda *key: SimpleNamespace(zid="there"))
        self.afar = Afar(mesh, agents, directory, lambda *_: True)

    def note(self, receiver: int, *, slow: bool) -> None:
        key = SLOW.of(zid="here", from_type=UNITY, from_id=receiver)

        def batch() -> Iterator[Sample]:
            yield key, Note(*SENDER, slow).encode()

        self.afar._heard(batch())

    def send_for(self, seconds: float) -> None:
        """It sends whenever it is read from."""
        for _ in range(round(seconds * 100)):
            if not self.sender.pauses and self.sender in self.afar.slowed:
                self.afar.has_read(self.sender)  # type: ignore[arg-type]
            self.clock.pass_time(0.01)


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Site:
    clock = Clock()
    monkeypatch.setattr(afar.asyncio, "get_running_loop", lambda: clock)  # type: ignore[attr-defined]
    assert isinstance(asyncio.get_running_loop(), Clock)
    return Site(clock)


def test_several_that_stand_still_one_after_the_other_slow_it_down_for_as_long_as_one(site: Site) -> None:
    """Of each notes come for as long as nobody knows that it has stopped."""
    for receiver in range(1, 1 + RECEIVERS):
        for _ in range(round(STOPPED_S / HOLD_S)):
            site.note(receiver, slow=True)
            site.send_for(HOLD_S)
    site.send_for(1.0)
    assert site.sender.paused_s <= HELD_S + HOLD_S
    assert not site.sender.pauses
    assert not site.afar.slowed


def test_one_that_moves_slows_it_down_for_as_long_as_it_takes(site: Site) -> None:
    """Its notes go on, or end with one that says that there is room."""
    for _ in range(40):
        site.note(1, slow=True)
        site.send_for(HOLD_S)
    assert site.sender.paused_s > 0.8 * 40 * HOLD_S
    site.note(1, slow=False)
    assert not site.afar.slowed
    before = site.sender.paused_s
    for _ in range(40):
        site.note(2, slow=True)
        site.send_for(HOLD_S)
        site.note(2, slow=False)
    assert site.sender.paused_s - before > 0.8 * 40 * HOLD_S


def test_of_a_receiver_that_has_stopped_no_room_is_told() -> None:
    """Its sender's gateway would take that for a sign that it moves."""
    put = list[bytes]()
    mesh: Any = SimpleNamespace(put=lambda key, payload, traffic: put.append(payload))
    receiver: Any = SimpleNamespace(
        key=(UNITY, 9), congested=True, moved=0, backpressure=SimpleNamespace(hold=lambda *_: False)
    )
    sender = FarSender(mesh, SENDER, "there", receiver)
    sender.resume()
    assert put == []
    receiver.congested = False
    sender.resume()
    assert put == [Note(*SENDER, False).encode()]
