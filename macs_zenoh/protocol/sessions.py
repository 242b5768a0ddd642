"""Sessions: by which an agent that comes back over another socket is known to be the same. Pure.

A gateway tells an agent a secret of 192 random bits. Here is only its hash, and whose it is. A secret
that is nobody's finds nothing, and takes as long as one that is somebody's; the caller asks for the token besides.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
from collections.abc import Hashable
from typing import Generic, TypeVar

SECRET_BYTES = 24
SHOWN_CHARACTERS = 64
"""So much is looked at of what somebody shows; a secret has 32."""

Holder = TypeVar("Holder", bound=Hashable)


def new_secret(randomness: bytes) -> str:
    """A session's, of 24 random bytes."""
    assert len(randomness) == SECRET_BYTES
    return base64.urlsafe_b64encode(randomness).decode()


class Sessions(Generic[Holder]):
    """Those of one gateway."""

    def __init__(self) -> None:
        self._by_hash: dict[bytes, tuple[bytes, Holder]] = {}
        self._of: dict[Holder, bytes] = {}

    def __len__(self) -> int:
        return len(self._of)

    def __contains__(self, holder: object) -> bool:
        return holder in self._of

    def open(self, secret: str, holder: Holder) -> None:
        """This is somebody's secret, from now on and in place of the one before."""
        self.close(holder)
        digest = _hash(secret)
        self._by_hash[digest] = digest, holder
        self._of[holder] = digest

    def close(self, holder: Holder) -> None:
        """Somebody has none any more."""
        digest = self._of.pop(holder, None)
        if digest is not None:
            del self._by_hash[digest]

    def find(self, secret: str) -> Holder | None:
        """Whose secret this is."""
        digest = _hash(secret)
        known, holder = self._by_hash.get(digest, (bytes(len(digest)), None))
        return holder if hmac.compare_digest(known, digest) else None


def _hash(secret: str) -> bytes:
    """Where something is found by its hash, how long that takes tells nothing about the secret."""
    return hashlib.sha256(secret[:SHOWN_CHARACTERS].encode("utf-8", "surrogatepass")).digest()
