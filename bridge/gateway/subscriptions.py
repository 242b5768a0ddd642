"""What a gateway listens to on the mesh, by key expression: each once, whoever of its agents wants it."""

from __future__ import annotations

from macs_zenoh.mesh import AtOnce, Mesh, OnBatch, Subscription


class Subscriptions:
    """Those of one gateway, and whatever else ends with it."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._by_key: dict[str, Subscription] = {}
        self._others: list[Subscription] = []

    def add(self, key: str, on_batch: OnBatch, *, at_once: AtOnce | None = None, reliable: bool = False) -> None:
        """Listen to a key, unless that is done already."""
        if key not in self._by_key:
            self._by_key[key] = self._mesh.subscribe(key, on_batch, at_once=at_once, reliable=reliable)

    def remove(self, key: str) -> None:
        """Listen no more, if that was done."""
        subscription = self._by_key.pop(key, None)
        if subscription is not None:
            subscription.close()

    def keep(self, declared: Subscription) -> None:
        """Something else that is declared: it ends with the rest."""
        self._others.append(declared)

    def close(self) -> None:
        """End them all."""
        for subscription in (*self._by_key.values(), *self._others):
            subscription.close()
