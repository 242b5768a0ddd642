"""A router under test: agents connect to it, and what each gets is judged."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from macs_zenoh.errors import MacsError

from ..checks import Check, Level, NotHeld, NotTried, Verdict, Verdicts
from . import bad_input, joining, leaving, robots, routing, sessions
from .scene import Scene, Trial

TRIALS: tuple[Trial, ...] = (
    *joining.TRIALS,
    *routing.TRIALS,
    *robots.TRIALS,
    *leaving.TRIALS,
    *sessions.TRIALS,
    *bad_input.TRIALS,
)

CHECKS: tuple[Check, ...] = tuple(trial.check for trial in TRIALS)


async def judge(
    host: str,
    port: int,
    *,
    level: Level = Level.STRICT,
    patience_s: float = 3.0,
    group: int = 200,
    most_s: float = 55.0,
    on_verdict: Callable[[Verdict], object] = lambda verdict: None,
) -> list[Verdict]:
    """Hold the router at this address to every check of a level.

    ``patience_s`` is how long anything is waited for; ``group`` and the one above it are for the kit's agents.
    Raises Unreachable when nobody is there.
    """
    verdicts = Verdicts(CHECKS, level)
    async with Scene(host, port, patience_s, group) as scene:
        await (await scene.connect(greeted=False)).close()
    until = time.monotonic() + most_s
    for check, run in TRIALS:
        if not verdicts.asked(check.name):
            continue
        if time.monotonic() > until:
            verdicts.skip(check.name, f"no time was left of {most_s:g} s, for so much was waited in vain")
            continue
        async with Scene(host, port, patience_s, group) as scene:
            try:
                await run(scene)
            except NotHeld as seen:
                verdicts.fail(check.name, str(seen))
            except NotTried as reason:
                verdicts.skip(check.name, str(reason))
            except MacsError as error:
                verdicts.fail(check.name, str(error))
            else:
                verdicts.hold(check.name)
        with contextlib.suppress(StopIteration):
            on_verdict(next(verdict for verdict in verdicts.all() if verdict.check is check))
    return verdicts.all()
