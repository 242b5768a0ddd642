"""Attacks with sessions that survive their socket: coming back, sleeping, being somebody else. Sections 2, 3 and 5."""

from __future__ import annotations

import json
import secrets
import struct
import threading
from contextlib import suppress

from tests.attack.floods import vanish
from tests.attack.raw import UNITY, Agent, frame, management, metadata, node_data, registration
from tests.attack.table import Target, attack

TWIST = b"\x00\x01\x00\x00" + struct.pack("<6d", 9.0, 0, 0, 0, 0, 0)
MANY = 20


class Returning(Agent):
    """A headset that is expected back: ``secret`` opens its session."""

    def __init__(self, port: int, secret: str = "", *, received: int = 0) -> None:
        super().__init__(port, configure=False, read=False)
        self.configure(extensions=1, session=secret, received=received)
        self.secret = secret
        self.socket.settimeout(5)
        while not self.secret:
            told = self._read_message()
            with suppress(ValueError, TypeError, KeyError):
                self.secret = str(json.loads(told)["session"])

    def drives(self) -> None:
        """Register for the driven topic, and command."""
        self.send(registration("nd__cmd_vel", "/cmd_vel", "geometry_msgs/Twist", node_type=2, me=self.id))
        self.send(node_data("nd__cmd_vel", TWIST, kind="geometry_msgs/Twist"))


def _in_turn(target: Target, count: int, *, close: bool) -> None:
    """So many headsets come back again and again; the sockets before are closed, or taken from."""

    def again() -> None:
        secret = ""
        while target.running():
            with suppress(OSError, ValueError, struct.error):
                agent = Returning(target.port, secret)
                secret = agent.secret
                agent.drives()
                if close:
                    agent.close(reset=True)

    for _ in range(count):
        threading.Thread(target=again, daemon=True).start()
    while target.rest(0.2):
        pass


@attack(3, "headset")
def coming_back_again_and_again(target: Target) -> None:
    """Twenty headsets that register at the robot, command, vanish and come back as the same, at full rate."""
    _in_turn(target, MANY, close=True)


@attack(3, "headset")
def taking_the_socket_from_oneself(target: Target) -> None:
    """The same while the socket before still lives: it is another one's from then on."""
    _in_turn(target, MANY, close=False)


@attack(2, "headset")
def sleepers(target: Target) -> None:
    """Headsets that may come back, register at the robot, and vanish: as many as there can be."""

    def make() -> Agent:
        agent = Returning(target.port)
        agent.drives()
        return agent

    vanish(target, 200, make)


@attack(2, "headset")
def sleepers_that_are_talked_to(target: Target) -> None:
    """Twenty headsets that sleep, while another one sends them messages of 64 KiB without end."""
    asleep = [Returning(target.port) for _ in range(MANY)]
    for agent in asleep:
        agent.close(reset=True)
    speaker = Agent(target.port)
    said = metadata(message_manager="Hello")
    ids = [agent.id for agent in asleep]
    large = b"".join(
        frame(metadata=said, data=bytes(64 << 10), to=UNITY, ids=ids[at : at + 10]) for at in range(0, MANY, 10)
    )
    while target.running() and speaker.send(large):
        pass
    while target.rest(0.2):
        pass


@attack(5, "headset")
def guessing_secrets(target: Target) -> None:
    """Secrets of sessions that nobody has, at full rate, cut off and of a million characters among them."""

    def guess() -> None:
        while target.running():
            with suppress(OSError, ValueError, struct.error):
                for made_up in (secrets.token_urlsafe(24), "x", "\udcff" * 3, "y" * 60_000):
                    agent = Agent(target.port, configure=False, read=False)
                    agent.configure(extensions=1, session=made_up)
                    agent.close(reset=True)

    for _ in range(4):
        threading.Thread(target=guess, daemon=True).start()
    while target.rest(0.2):
        pass


@attack(4, "headset", single=True)
def counts_that_lie(target: Target) -> None:
    """Sessions whose counts of what has arrived are below zero, without end, ahead of all that was said, and no
    numbers."""
    odd = (-1, -(2**63), 2**31, 2**63, 2**70, 10**400, 1.5, "7", None, [], True)
    while target.running():
        for count in odd:
            with suppress(OSError, ValueError, struct.error):
                first = Returning(target.port)
                first.send(frame(management("HeartbeatHandler", received=count)))
                first.close(reset=True)
                back = Agent(target.port, configure=False)
                back.configure(extensions=1, session=first.secret, received=count)
                back.send(frame(management("HeartbeatHandler", received=count)))
                back.close(reset=True)
        target.rest(0.2)
