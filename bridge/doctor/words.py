"""How figures, programs and versions are called in findings. Pure."""

from __future__ import annotations

import re
import statistics

from .facts import NetworkPath, Program


def name_of(program: Program) -> str:
    """A gateway by its blocks, others by their agents."""
    if program.blocks:
        return f"gateway {program.zid[:8]} (block {', '.join(map(str, sorted(program.blocks)))})"
    return ", ".join(program.agents) or program.zid[:8]


def median_ms(path: NetworkPath) -> float:
    return statistics.median(path.round_trips_ms) if path.round_trips_ms else 0.0


def round_trip(path: NetworkPath) -> str:
    return f"{median_ms(path):.1f} ms" if path.round_trips_ms else "an unknown time"


def bytes_per_s(path: NetworkPath, *, crossings: int) -> float:
    """Throughput out of the largest echo: how much longer it took than the smallest. ``crossings``: how often the
    bytes went over a link, one after the other. 0: unknown."""
    if len(path.echoes) < 2:
        return 0.0
    small, large = path.echoes[0], path.echoes[-1]
    took_s = large.took_s - small.took_s
    return crossings * (large.size_bytes - small.size_bytes) / took_s if took_s > 0 else 0.0


def throughput(path: NetworkPath, *, crossings: int) -> str:
    rate = bytes_per_s(path, crossings=crossings)
    return f", about {bit_rate(rate)}" if rate else ""


def bit_rate(bytes_per_s: float) -> str:
    mbit = bytes_per_s * 8 / 1e6
    return f"{mbit:.3g} Mbit/s" if mbit < 999 else f"{mbit / 1000:.1f} Gbit/s"


def byte_size(size: float) -> str:
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"


def seconds(value_s: float) -> str:
    return f"{value_s:.3g} s" if value_s >= 1 else f"{value_s * 1000:.0f} ms"


def counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def some(who: list[str], most: int = 4) -> str:
    shown = ", ".join(who[:most])
    return shown if len(who) <= most else f"{shown} and {len(who) - most} more"


def sessions(zids: set[str]) -> str:
    return ", ".join(sorted(zid[:8] for zid in zids))


def tallied(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))


def short_version(version: str) -> str:
    """``1.10.2`` out of ``v1.10.2-release built with rustc …``."""
    match = re.match(r"v?(\d+\.\d+\.\d+)", version)
    return match[1] if match else version


def short_problem(problem: str) -> str:
    """Zenoh's ``Unable to connect to any of [Single(tcp/…)]. Timeout!`` in short."""
    return problem.rpartition("]. ")[2].rstrip("!.").lower() or "no reason given"
