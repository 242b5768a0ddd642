"""Who is let in, by token, and whose token changes or ends while he is inside.

Each port has an `Entrance`, which knows who may come there without a token. What somebody shows is judged by the file
of tokens as it is at that moment; whoever came in by it is looked after as long as he stays.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bridge.settings.gateway import GatewaySettings, WithoutToken
from bridge.tokens import store
from bridge.tokens.watch import Watch
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.addresses import is_local
from macs_zenoh.protocol.attempts import Attempts
from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.rights import OPEN, Grant, Rights
from macs_zenoh.protocol.tcp_agent import Admit
from macs_zenoh.protocol.tokens import SECRET_BYTES, Token, Tokens, hash_of, new_secret

from .admission import is_in, networks

if TYPE_CHECKING:
    from .connection import Connection

log = logging.getLogger("macs.gateway")


class Entrance:
    """One port, as far as it matters who comes there."""

    def __init__(self, name: str, without_token: WithoutToken) -> None:
        self.name = name
        self.without_token = without_token
        self._networks = networks(without_token) if isinstance(without_token, list) else []

    def wants_token(self, host: str) -> bool:
        """Whether who comes from this address has to show a token."""
        if isinstance(self.without_token, str):
            return self.without_token == "nobody"  # noqa: S105 - no password
        return not is_in(host, self._networks)


OPEN_TO_ALL = Entrance("plain", "everybody")


class Entrances(NamedTuple):
    """Those of a gateway."""

    plain: Entrance
    tls: Entrance
    web: Entrance


def entrances(settings: GatewaySettings) -> Entrances:
    """As the settings say; without a word about it, what others can reach over TLS or the web wants a token."""

    def usual(host: str) -> WithoutToken:
        return "everybody" if is_local(host) else "nobody"

    web_host = settings.host if settings.web_host is None else settings.web_host
    tls = usual(settings.host) if settings.tls_without_token is None else settings.tls_without_token
    web = usual(web_host) if settings.web_without_token is None else settings.web_without_token
    return Entrances(Entrance("plain", settings.plain_without_token), Entrance("tls", tls), Entrance("web", web))


class _Holder(NamedTuple):
    """Who came in by a token."""

    name: str
    digest: str
    """Of the secret that was shown: another one may be the token's by now."""


class Door:
    """For all entrances of a gateway."""

    def __init__(
        self,
        path: Path,
        *,
        on_changed: Callable[[Connection, Grant], None],
        on_ended: Callable[[Connection], None],
        on_look: Callable[[], None] = lambda: None,
        on_file: Callable[[str, str], None] = lambda event, name: None,
        on_refused: Callable[[str, int], None] = lambda host, count: None,
    ) -> None:
        """``on_changed`` hears of connections whose token has other rights now, ``on_ended`` of those whose token
        holds no longer, ``on_look`` is called several times a second, ``on_file`` with what became of a token
        in the file, ``on_refused`` of web requests with no valid token: from which address, and how often by now
        when that is to be told, else 0. Raises ConfigError: the file of tokens cannot be used."""
        self._on_changed = on_changed
        self._on_ended = on_ended
        self._on_refused = on_refused
        self._on_look = on_look
        self._on_file = on_file
        self._watch = Watch(path, self._look)
        self._watch.on_read = self._tell_of_file
        self._holders: dict[Connection, _Holder] = {}
        self._grants: dict[str, Grant] = {}
        """Of tokens that somebody has come in by: all who have one share what it may send, also who comes again."""
        self._attempts = Attempts()
        self._exchanging = asyncio.Lock()

    def start(self) -> None:
        """Follow the file."""
        self._watch.start()

    def close(self) -> None:
        """Follow it no more."""
        self._watch.close()

    @property
    def count(self) -> int:
        """How many tokens there are."""
        return len(self._watch.tokens.tokens)

    def admit(self, connection: Connection) -> Admit:
        """How the token that this connection's agent shows is judged."""

        def judge(shown: str | None) -> Grant | None:
            shown = connection.shown_token if shown is None else shown
            if shown is None and not connection.entrance.wants_token(connection.host):
                return OPEN
            token = self.find(shown)
            if token is None:
                return None
            self._holders[connection] = _Holder(token.name, hash_of(shown or ""))
            return self._grant(token)

        return judge

    def find(self, shown: str | None) -> Token | None:
        """The token that somebody shows, if it holds."""
        self._watch.read_again()  # it may have been made a moment ago
        return self._watch.tokens.find(shown, time.time())

    def failed(self, entrance: Entrance, host: str, what: str = "valid token", counted_as: str = "NotAdmitted") -> int:
        """Somebody was not let in, or not as who he said. How often by now from there, when that is to be told;
        else 0."""
        count = self._attempts.note(host, time.monotonic())
        if count:
            so_far = "" if count == 1 else f", {count} times by now"
            problem = "%s shows no %s at the %s port%s (counted as %s)"
            log.warning(problem, host, what, entrance.name, so_far, counted_as)
        return count

    def refuse_request(self, entrance: Entrance, host: str) -> None:
        """A web request showed no valid token, or no code of a pairing."""
        self._on_refused(host, self.failed(entrance, host))

    def leave(self, connection: Connection) -> None:
        """A connection has ended."""
        self._holders.pop(connection, None)

    def is_now(self, newcomer: Connection, connection: Connection) -> None:
        """Who came by one connection is who was here before by the other."""
        held = self._holders.pop(newcomer, None)
        self.leave(connection)
        if held is not None:
            self._holders[connection] = held

    async def exchange(self, code: str) -> str | None:
        """A new secret for who shows the code of a pairing; None: there is no such pairing."""
        self._watch.read_again()
        async with self._exchanging:  # nobody tries two at once
            now = time.time()
            if not any(pairing.holds(now) for pairing in self._watch.tokens.pairings):
                return None
            secret = new_secret(secrets.token_bytes(SECRET_BYTES))
            try:
                name = await asyncio.to_thread(
                    store.change, self._watch.path, lambda tokens: tokens.exchange(code, secret, now)
                )
            except MacsError as error:
                log.error("no pairing: %s", error)
                return None
            self._watch.read_again()
            if name is None:
                log.warning("a wrong pairing code was shown")
                return None
            log.info("token %s was paired", name)
            self._on_file("token_paired", name)
            return secret

    def _tell_of_file(self, before: Tokens, now: Tokens) -> None:
        had, has = ({token.name: token for token in tokens.tokens} for tokens in (before, now))
        for name in sorted(had.keys() | has.keys()):
            if name not in had:
                self._on_file("token_created", name)
            elif name not in has:
                self._on_file("token_removed", name)
            elif had[name] != has[name]:
                self._on_file("token_changed", name)

    # -- pieces --------------------------------------------------------------------------------------------------

    def _grant(self, token: Token) -> Grant:
        before = self._grants.get(token.name)
        if before is None or before.rights != token.rights:
            credit = _credit(token.rights)
            if before is not None and before.credit is not None and credit is not None:
                credit = Credit(credit.frames_per_s, time.monotonic(), 0.0)  # a change is no gift
            before = self._grants[token.name] = Grant(token.name, token.rights, credit)
        return before

    def _look(self) -> None:
        """Compare what all who are inside came in by with what holds now."""
        self._on_look()
        now = time.time()
        tokens = {token.name: token for token in self._watch.tokens.tokens}
        for name in self._grants.keys() - tokens.keys():
            del self._grants[name]
        for connection, held in list(self._holders.items()):
            token = tokens.get(held.name)
            if token is None or not token.holds(now) or held.digest not in token.hashes:
                self.leave(connection)
                self._on_ended(connection)
            elif connection.peer.grant.rights != token.rights:
                self._on_changed(connection, self._grant(token))


def _credit(rights: Rights) -> Credit | None:
    return Credit(rights.frames_per_s, time.monotonic()) if rights.frames_per_s else None
