"""Tokens: how they look, what is kept of them, and which of them is shown. Pure.

A token is a secret of 256 bits that is shown once, when it is made. What is kept is its hash with its name, rights and
end; nobody makes a token of that. A token that is wrong, has ended, was taken back, or is another gateway's finds
nothing, and finding nothing always takes as long: every hash that there is is compared, whole.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
from collections import Counter
from collections.abc import Iterator
from typing import Annotated

import msgspec
from msgspec import Meta, Struct, structs

from ..errors import ConfigError, UsageError
from .rights import Rights

PREFIX = "macs_"
"""By which programs that look for secrets in texts can know one."""
SECRET_BYTES = 32

SHOWN_CHARACTERS = 256
"""So much is looked at of what somebody shows; a token has 48."""

SECRETS_EACH = 16
"""Under one name: one that was printed, and one for each headset that was paired."""

TOKENS = 1024
"""In one file: so many are compared each time that somebody shows one."""

PAIRING_S = 120.0
PAIRING_TRIES = 5
CODE_DIGITS = 6

FORMAT = 1

Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\Z", max_length=64)]
Hash = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


class Token(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is kept of one token. Times are seconds since 1970."""

    name: Name
    hashes: list[Hash] = []
    """Of its secrets: each of them is the token."""
    rights: Rights = Rights()
    created_at: float = 0.0
    expires_at: float | None = None
    """None: it does not end by itself."""

    def holds(self, now: float) -> bool:
        """Whether it has not ended."""
        return self.expires_at is None or now < self.expires_at


class Pairing(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A code that was shown and can be exchanged for a secret of the token ``name``, once."""

    name: Name
    salt: Hash
    hash: Hash
    expires_at: float
    tries: Annotated[int, Meta(ge=0, le=PAIRING_TRIES)] = PAIRING_TRIES
    """How many wrong codes are left before it is good for nothing."""

    def holds(self, now: float) -> bool:
        """Whether its code may still be exchanged."""
        return now < self.expires_at and self.tries > 0


class Tokens(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All tokens of a site, as its file has them."""

    format: Annotated[int, Meta(ge=FORMAT, le=FORMAT)] = FORMAT
    tokens: Annotated[list[Token], Meta(max_length=TOKENS)] = []
    pairings: Annotated[list[Pairing], Meta(max_length=TOKENS)] = []

    def __post_init__(self) -> None:
        for name, count in Counter(token.name for token in self.tokens).items():
            if count > 1:
                raise ValueError(f"two tokens are called {name}")

    def find(self, shown: str | None, now: float) -> Token | None:
        """The token that somebody shows, if it holds. Takes as long whatever is shown."""
        digest = hash_of(shown or "")
        found = None
        for token in self.tokens:
            for each in token.hashes:
                if hmac.compare_digest(each, digest):
                    found = token
        return found if found is not None and found.holds(now) else None

    def named(self, name: str) -> Token:
        """The token of this name. Raises UsageError."""
        for token in self.tokens:
            if token.name == name:
                return token
        raise UsageError(f"there is no token called {name[:64]!r}")

    # -- changes -------------------------------------------------------------------------------------------------

    def with_token(self, token: Token) -> Tokens:
        """The same with a token, in place of the one of its name if there is one. Raises UsageError."""
        others = [each for each in self.tokens if each.name != token.name]
        if len(others) >= TOKENS:
            raise UsageError(f"there are {TOKENS} tokens, and no more than that; `macs token revoke` ends some")
        return structs.replace(self, tokens=sorted([*others, token], key=lambda each: each.name))

    def without(self, name: str) -> Tokens:
        """The same without a token and its pairing. Raises UsageError: there is none."""
        gone = self.named(name)
        return structs.replace(
            self,
            tokens=[each for each in self.tokens if each is not gone],
            pairings=[each for each in self.pairings if each.name != name],
        )

    def with_secret(self, name: str, secret: str, *, only: bool = False) -> Tokens:
        """The same with one more secret of a token, the oldest giving way; ``only`` that one. Raises UsageError."""
        token = self.named(name)
        kept = [] if only else token.hashes[1 - SECRETS_EACH :]
        return self.with_token(structs.replace(token, hashes=[*kept, hash_of(secret)]))

    def with_pairing(self, pairing: Pairing, now: float) -> Tokens:
        """The same with a pairing, in place of one for the same token, and without those that have ended."""
        self.named(pairing.name)
        others = [each for each in self.pairings if each.name != pairing.name and each.holds(now)]
        return structs.replace(self, pairings=[*others, pairing])

    def exchange(self, code: str, secret: str, now: float) -> tuple[Tokens, str | None]:
        """What is kept after somebody has shown a pairing's code: with ``secret`` for its token, whose name is
        returned; or, for a wrong one, with a try less for every pairing, since nobody knows which was meant."""
        found = None
        for each in self.pairings:
            if hmac.compare_digest(each.hash, _code_hash(code, each.salt)) and each.holds(now):
                found = each
        if found is None:
            left = [structs.replace(each, tries=each.tries - 1) for each in self.pairings if each.holds(now)]
            return structs.replace(self, pairings=[each for each in left if each.tries]), None
        left = [each for each in self.pairings if each is not found]
        return structs.replace(self, pairings=left).with_secret(found.name, secret), found.name


def new_secret(randomness: bytes) -> str:
    """A token, of 32 random bytes."""
    assert len(randomness) == SECRET_BYTES
    return PREFIX + base64.urlsafe_b64encode(randomness).decode().rstrip("=")


def hash_of(shown: str) -> str:
    """What is kept of a token. It has 256 random bits: nothing slower is needed to keep it from being guessed."""
    return hashlib.sha256(shown[:SHOWN_CHARACTERS].encode("utf-8", "surrogatepass")).hexdigest()


def new_pairing(name: str, code: str, salt: bytes, now: float) -> Pairing:
    """A pairing for a token, by a code of six digits that the caller has thrown."""
    text = salt.hex()
    return Pairing(name=name, salt=text, hash=_code_hash(code, text), expires_at=now + PAIRING_S)


def code_of(number: int) -> str:
    """A number below a million as a code."""
    return f"{number:0{CODE_DIGITS}d}"


def _code_hash(code: str, salt: str) -> str:
    return hashlib.sha256(f"{salt} {code[:SHOWN_CHARACTERS]}".encode("utf-8", "surrogatepass")).hexdigest()


def parse(content: bytes, source: str) -> Tokens:
    """Read a file's content. Raises ConfigError with ``source``: it is none of ours."""
    try:
        return msgspec.json.decode(content, type=Tokens)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(source, f"is no file of tokens: {error}") from error


def encode(tokens: Tokens) -> bytes:
    """What a file has."""
    return msgspec.json.format(msgspec.json.encode(tokens), indent=1) + b"\n"


def changed(before: Tokens, now: Tokens) -> Iterator[str]:
    """Names of tokens that were there before and are not as they were: gone, or other rights, end or secrets."""
    current = {token.name: token for token in now.tokens}
    return (token.name for token in before.tokens if current.get(token.name) != token)
