"""Memory: what large frames took is given back, and what a program is built of is not gone through."""

from __future__ import annotations

import gc

LARGE_BYTES = 4 << 20
"""So much and more is mapped by itself. What is smaller comes from the heap, which is faster."""
SPARE_BYTES = 32 << 20
"""A heap keeps so much at its end, until `CALM_S` after the last large sample."""

SELDOM, YOUNG, OLD = 10_000, 0, 100
"""So many objects more than before have Python look for circles among the young ones, by itself 700; beyond so many
such looks among those that have stayed, by itself 10; and beyond so many of these among all, by itself 10. What has
stayed is what came since: with 10 one such look held up a gateway for 26 ms, measured while a thousand joined. Every
second look is one, so that nothing is looked at more than twice while it is young."""


def give_back() -> None:
    """Hold the C library to these numbers, where it has them (glibc).

    By itself it raises both with the largest piece that was ever freed, to 32 and 64 MiB: after a few frames of
    31 MiB a program kept 60 to 80 MiB that nobody used.
    """
    from macs_zenoh.mesh.copies import hold_heap

    hold_heap(LARGE_BYTES, SPARE_BYTES)


def settle() -> None:
    """What is there by now stays for as long as the program runs: the collector of circles need not go through it.

    It would each time that enough has been made since, while everything waits: 5 to 15 ms in a gateway and 25 ms in a
    robot agent, measured, where a message takes half of one.
    """
    gc.collect()
    gc.freeze()


def collect_seldom() -> None:
    """Look for circles of objects less often, for programs to which thousands connect.

    Connections end without circles, so there are few of these; but each that comes has hundreds of objects, and to
    look at those of all others again and again took a tenth of what a connection costs.
    """
    gc.set_threshold(SELDOM, YOUNG, OLD)
