"""What the mesh costs, as ratios taken in one run: ``python -m benchmarks``, see ``__main__``. Nothing here is a test.

A figure is always set against a baseline that runs in turn with it (A B A B …, medians), because the absolute
numbers of a shared machine say little: raw Zenoh-Python through the same router, raw TCP, or a relay in plain asyncio.

What is measured is everything between two sockets: gateway, mesh, router. The ends are made cheap. A sender repeats
one frame that is built once, at least 32 KiB per system call; a receiver takes up to 1 MiB per call and counts bytes;
both are processes of their own with blocking sockets. What they cost themselves is a figure too: the case ``ends``
joins them directly, and is what a gateway without any cost would reach. Before anything is counted each path carries
some messages whose every byte is compared. A run waits for every message; what did not arrive is a line below the
table, and the round in which that happened counts as nothing.

A sender that repeats one frame shows a gateway at its best. In the case ``differing`` each message has a number, a
request id and a length of its own, destinations take turns, and the receiver counts what is lost or out of order.

Times are taken from the first byte sent to the last one received by the last receiver, by one clock (CLOCK_MONOTONIC).
"""
