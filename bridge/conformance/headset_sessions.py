"""Sessions of a headset under test: an extension, judged where its configuration asks for one.

The kit is its router still, and now one that knows sessions. It ends the connection four times: its headset's frames
have not come, then all have, then it is known no more.
"""

from __future__ import annotations

from . import vectors
from .checks import Verdicts
from .client_frames import ClientFrames, Kind, Said
from .router import Client, Router

SECRET, ANOTHER = "c2VjcmV0LW9mLXRoZS1raXQtMSE", "c2VjcmV0LW9mLXRoZS1raXQtMiE"
OWN_ID = 31
"""The id that it has in the session; welcomes of later connections give others."""
NAMES = (
    "sessions.asks",
    "sessions.shows",
    "sessions.received",
    "sessions.waits",
    "sessions.id",
    "sessions.says_again",
    "sessions.registers_nothing",
    "sessions.forgotten",
)
AGAIN_S = 10.0
"""By when it makes a new connection, at the least."""
_QUIET_S = 0.5


class Sessions:
    """One run of them."""

    def __init__(self, router: Router, frames: ClientFrames, verdicts: Verdicts, patience_s: float) -> None:
        self._router = router
        self._frames = frames
        self._verdicts = verdicts
        self._patience_s = patience_s
        self._request = 100_000
        self._received = self._heard = 0
        """Of the session, on connections that have ended: its messages that it has, and its frames that have come."""

    async def run(self, client: Client) -> Client:
        """All of it, beginning with a connection that is ended; the last one that it has made."""
        had = set(self._frames.nodes)
        client.abort()
        came = await self._comes(OWN_ID)
        if came is None:
            return self._skip(client, "it made no new connection")
        client, said = came
        if "session" not in said.management:
            return self._skip(client, "it asks for no session")
        session = said.management["session"]
        self._verdicts.hold("sessions.asks", session == "", f"it says {session!r}, and was told no secret")
        await self._begin(client, vectors.fill("router_messages", "session_opened", secret=SECRET))
        await client.until(lambda: registered(client) >= had, max(3.0, self._patience_s))
        for number in range(3):
            await client.send(vectors.fill("router_messages", "online_answer", number=4_000_000 + number))
        await self._end(client, 0)
        rounds = (self._lost, self._whole, self._forgotten)
        for agent_id, round_of in zip((41, 42, 43), rounds, strict=True):
            came = await self._comes(agent_id)
            if came is None:
                self._verdicts.fail("sessions.shows", "it made no new connection after a session was opened")
                return self._skip(client, "it did not come back")
            client, said = came
            if not await self._shows(client, said):
                return self._skip(client, "it does not come back as who it was")
            await round_of(client, had)
        client.sent = None
        return client

    # -- rounds --------------------------------------------------------------------------------------------------

    async def _lost(self, client: Client, had: set[tuple[int, str]]) -> None:
        """None of its frames have come."""
        await self._begin(client, self._resumed(0))
        came = await client.until(lambda: registered(client) >= had, max(3.0, self._patience_s))
        missing = sorted(name for _, name in had - registered(client))
        if had:
            self._verdicts.hold("sessions.says_again", came, f"it did not say again that it registers {missing}")
        else:
            self._verdicts.skip("sessions.says_again", "it had registered nothing")
        await self._end(client, 0)
        senders = {said.metadata.get("senderAgentId") for said in client.said if said.metadata}
        if senders:
            self._verdicts.hold("sessions.id", senders == {OWN_ID}, f"it says {senders}, and is {OWN_ID} as before")
        else:
            self._verdicts.skip("sessions.id", "it said nothing that names its sender")

    async def _whole(self, client: Client, had: set[tuple[int, str]]) -> None:
        """All of its frames have come."""
        heard = self._heard
        await self._begin(client, self._resumed(heard))
        await client.until(lambda: bool(registered(client)), _QUIET_S)
        found = sorted(name for _, name in registered(client))
        self._verdicts.hold("sessions.registers_nothing", not found, f"it registers {found}, which its router has")
        await self._end(client, heard)

    async def _forgotten(self, client: Client, had: set[tuple[int, str]]) -> None:
        """Its router does not know it any more."""
        await self._begin(client, vectors.fill("router_messages", "session_opened", secret=ANOTHER))
        came = await client.until(lambda: registered(client) >= had, max(3.0, self._patience_s))
        missing = sorted(name for _, name in had - registered(client))
        if had:
            self._verdicts.hold("sessions.forgotten", came, f"it did not register {missing}")
        else:
            self._verdicts.skip("sessions.forgotten", "it had registered nothing")

    # -- pieces --------------------------------------------------------------------------------------------------

    async def _comes(self, agent_id: int) -> tuple[Client, Said] | None:
        """Its next connection, with its configuration there."""
        client = await self._router.next(max(AGAIN_S, self._patience_s))
        if client is None:
            return None
        self._frames.given.add(agent_id)
        await client.send(self._welcome(agent_id))
        await client.until(lambda: bool(_configurations(client)), max(5.0, self._patience_s))
        said = _configurations(client)
        return (client, said[0]) if said else None

    def _welcome(self, agent_id: int) -> bytes:
        self._request += 1
        return vectors.fill("router_messages", "welcome", id=agent_id, request=self._request)

    async def _shows(self, client: Client, said: Said) -> bool:
        """Whether it says who it was; then it has to wait for what becomes of that."""
        hold, management = self._verdicts.hold, said.management
        if not hold("sessions.shows", management.get("session") == SECRET, f"it says {management.get('session')!r}"):
            return False
        received = management.get("received", 0)
        hold("sessions.received", received == self._received, f"it says {received!r}, and has {self._received}")
        behind = client.said.index(said) + 1
        await client.until(lambda: len(client.said) > behind, _QUIET_S)
        kinds = [each.kind.value for each in client.said[behind:]]
        hold("sessions.waits", not kinds, f"before it is told what became of its session it says {kinds}")
        return True

    def _resumed(self, received: int) -> bytes:
        self._frames.id = OWN_ID
        return vectors.fill("router_messages", "session_resumed", id=OWN_ID, heard=received)

    async def _begin(self, client: Client, told: bytes) -> None:
        """From here on messages count."""
        await client.send(told)
        client.sent = 0

    async def _end(self, client: Client, heard: int) -> None:
        """See that it has all that was sent, and reset its connection, before which so many frames had come."""
        before = len(_configurations(client))
        await client.send(self._welcome(OWN_ID))
        await client.until(lambda: len(_configurations(client)) > before, self._patience_s)
        client.abort()
        self._received += client.sent or 0
        self._heard = heard + len(client.said) - 1

    def _skip(self, client: Client, why: str) -> Client:
        for name in NAMES:
            self._verdicts.skip(name, why)
        client.sent = None
        return client


def registered(client: Client) -> set[tuple[int, str]]:
    """What was registered on this connection."""
    found = (said.management for said in client.said if said.kind is Kind.REGISTRATION)
    return {(int(each.get("node_type", 0)), str(each.get("node_name"))) for each in found}


def _configurations(client: Client) -> list[Said]:
    return [said for said in client.said if said.kind is Kind.CONFIGURATION]
