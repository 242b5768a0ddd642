"""The types of what the fixtures of tests/integration give."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from bridge.gateway import Gateway
from bridge.headset.client import Headset

StartGateway = Callable[..., Awaitable[Gateway]]
Connect = Callable[..., Awaitable[Headset]]
