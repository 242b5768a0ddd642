"""Subscriptions that need not hear at once: several samples at a time, each with the time at which it came."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from macs_zenoh.mesh import Mesh, Sample
from macs_zenoh.mesh.arrivals import Arrivals
from tests.support.local import patient
from tests.support.waiting import until

PATIENT, OTHER = "test/patient", "test/other"


async def test_what_waits_is_handled_together_with_its_times(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing overtakes it: a sample of another subscription has all be handled that came before, at once, in its
    order, and of each it is known when it came."""
    batches: list[list[tuple[bytes, float]]] = []
    async with await Mesh.open(patient(router)) as sender, await Mesh.open(patient(router)) as mesh:

        def take(batch: Iterator[Sample]) -> None:
            batches.append([(bytes(payload), mesh.came_s) for _, payload in batch])

        def heard() -> list[bytes]:
            return [payload for batch in batches for payload, _ in batch]

        async def reaches(key: str) -> None:
            """Once it does, nothing that was put before is on its way any more."""

            def put() -> bool:
                sender.put(key, b"first")
                return b"first" in heard()

            await until(put, every_s=0.1)
            sender.put(key, b"last")
            await until(lambda: b"last" in heard())
            batches.clear()

        subscriptions = [mesh.subscribe(PATIENT, take, patient=True), mesh.subscribe(OTHER, take)]
        for key in (PATIENT, OTHER):
            await reaches(key)
        monkeypatch.setattr(Arrivals, "PATIENT_S", 600.0)
        times = [time.monotonic()]
        for number in range(2):
            sender.put(PATIENT, str(number).encode())
            await until(lambda number=number: mesh._arrivals.waiting == number + 1)
            times.append(time.monotonic())
        sender.put(OTHER, b"other")
        await until(lambda: len(heard()) == 3)
        assert [payload for payload, _ in batches[0]] == [b"0", b"1"]
        assert [payload for payload, _ in batches[1]] == [b"other"]
        came = [came_s for batch in batches for _, came_s in batch]
        assert times[0] <= came[0] <= times[1] <= came[1] <= times[2] <= came[2]
        for subscription in subscriptions:
            subscription.close()
