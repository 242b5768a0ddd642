"""Hosts of our own where the machine allows it; otherwise the tests that need them say why they are skipped."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.network import hosts


@pytest.fixture
def network() -> Iterator[hosts.Network]:
    """A network without hosts yet."""
    if (problem := hosts.missing()) is not None:
        pytest.skip(problem)
    with hosts.Network() as network:
        yield network
