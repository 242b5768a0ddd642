"""What a gateway listens to on the mesh, by key expression: each once, whoever of its agents wants it."""

from __future__ import annotations

import asyncio

from macs_zenoh.mesh import AtOnce, Mesh, OnBatch, Subscription


class Subscriptions:
    """Those of one gateway, and whatever else ends with it."""

    LINGER_S = 2.0
    LINGERING = 256

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._by_key: dict[str, Subscription] = {}
        self._leaving: dict[str, asyncio.TimerHandle] = {}
        """Those that end soon, the one that does first at the beginning."""
        self._others: list[Subscription] = []

    def add(self, key: str, on_batch: OnBatch, *, at_once: AtOnce | None = None, reliable: bool = False) -> None:
        """Listen to a key, unless that is done already."""
        self._stay(key)
        if key not in self._by_key:
            self._by_key[key] = self._mesh.subscribe(key, on_batch, at_once=at_once, reliable=reliable)

    def leave(self, key: str) -> None:
        """Listen no more in a while, unless it is wanted again: to declare what a robot's topic needs costs routers,
        and whoever else is on the mesh, more than to hear it for so long."""
        if key in self._by_key and key not in self._leaving:
            self._leaving[key] = asyncio.get_running_loop().call_later(self.LINGER_S, self.remove, key)
            if len(self._leaving) > self.LINGERING:
                self.remove(next(iter(self._leaving)))

    def remove(self, key: str) -> None:
        """Listen no more, if that was done."""
        self._stay(key)
        subscription = self._by_key.pop(key, None)
        if subscription is not None:
            subscription.close()

    def keep(self, declared: Subscription) -> None:
        """Something else that is declared: it ends with the rest."""
        self._others.append(declared)

    def close(self) -> None:
        """End them all."""
        for leaving in self._leaving.values():
            leaving.cancel()
        for subscription in (*self._by_key.values(), *self._others):
            subscription.close()

    def _stay(self, key: str) -> None:
        leaving = self._leaving.pop(key, None)
        if leaving is not None:
            leaving.cancel()
