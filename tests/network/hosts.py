"""Hosts that are network namespaces, with cables between them (veth) and emulated links with delay, loss and a rate.

::

    with Network() as network:
        site, cloud = network.host("site"), network.host("cloud")
        wan = network.link(site, cloud, delay_ms=50, loss=0.01, mbit=20)
        async with Router(listen=["tcp/0.0.0.0:7447"], within=cloud.within): ...
        wan.down()

Nothing leaves the namespaces: their addresses (10.213.x.y) exist only inside them, and no link leads out. All is
removed when the block is left; what a killed run left behind is removed by the next one.
"""

from __future__ import annotations

import functools
import itertools
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from tests.support.processes import ROOT

PREFIX = "macs-test"


def run(*command: str) -> str:
    """Run a command and return what it printed. Raises OSError with its complaint when it fails."""
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=20)
    if done.returncode:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip()}")
    return done.stdout


@functools.cache
def missing() -> str | None:
    """Why no hosts can be made here, or None."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    for tool, package in (("ip", "iproute2"), ("nft", "nftables")):
        if shutil.which(tool) is None:
            return f"there is no {tool} (apt-get install {package})"
    try:
        with Network() as network:
            left, right = network.host("left"), network.host("right")
            network.link(left, right, delay_ms=1)
            network.nat(left, towards=right)
    except OSError as error:
        return f"no network namespaces here: {error}"
    return None


class Host:
    """A host: a network namespace with its loopback up. Made by `Network.host`."""

    def __init__(self, name: str, namespace: str) -> None:
        self.name = name
        self.namespace = namespace
        self.within = ("ip", "netns", "exec", namespace)
        """Comes before a command that is to run on this host."""
        self._addresses: dict[str, tuple[str, str]] = {}

    def __repr__(self) -> str:
        return f"<Host {self.name}>"

    def ip(self, *words: str) -> str:
        """``ip ...`` on this host."""
        return run("ip", "-n", self.namespace, *words)

    def sysctl(self, name: str, value: str) -> None:
        """Set a kernel parameter of this host's network, as net/ipv4/ip_forward."""
        run(*self.within, "sh", "-c", f"echo {value} > /proc/sys/{name}")

    def congestion_control(self, name: str) -> None:
        """How TCP here finds out what a link carries. By route: a namespace may not choose every kind as its default.

        Routes made later are not concerned. OSError when the kernel has none of that name.
        """
        for route in self.ip("route", "show").splitlines():
            self.ip("route", "replace", *route.split(), "congctl", name)

    def address_towards(self, other: Host) -> str:
        """This host's address on its link to the other one."""
        return self._addresses[other.name][0]

    def device_towards(self, other: Host) -> str:
        """This host's device of its link to the other one."""
        return self._addresses[other.name][1]

    def set_link(self, other: Host, address: str, device: str) -> None:
        """Give the host its end of a link to another one."""
        self._addresses[other.name] = (address, device)
        self.ip("addr", "add", f"{address}/30", "dev", device)
        self.ip("link", "set", device, "up")

    def default_route(self, via: Host) -> None:
        """Send there what is for no neighbour."""
        self.ip("route", "replace", "default", "via", via.address_towards(self))


class Link:
    """A link with delay, loss and a rate: a process of `tests.network.emulator`. Made by `Network.link`."""

    def __init__(self, names: Sequence[str], **options: float) -> None:
        words = [f"--{name.replace('_', '-')}={value}" for name, value in options.items()]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.network.emulator", *names, *words],
            cwd=ROOT,
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        if self._process.stdout.readline() != "ready\n":
            raise OSError(self._process.stderr.read().strip().splitlines()[-1])

    def down(self) -> None:
        """Cut it, in silence: what is sent is lost, and nobody is told."""
        self._order("down")

    def up(self) -> None:
        """Mend it."""
        self._order("up")

    def close(self) -> None:
        """Remove it."""
        assert self._process.stdin is not None
        self._process.stdin.close()  # it ends with its input
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for stream in (self._process.stdout, self._process.stderr):
            assert stream is not None
            stream.close()

    def _order(self, what: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{what}\n")
        self._process.stdin.flush()


class Network:
    """Hosts and links, from the beginning of the block to its end."""

    _numbers = itertools.count()

    def __init__(self) -> None:
        self._hosts: list[Host] = []
        self._links: list[Link] = []
        self._link_numbers = itertools.count()
        self._prefix = f"{PREFIX}-{os.getpid()}-{next(self._numbers)}"

    def __enter__(self) -> Network:
        _remove_leftovers()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for link in self._links:
            link.close()
        for host in self._hosts:
            with suppress(OSError):
                run("ip", "netns", "delete", host.namespace)

    def host(self, name: str) -> Host:
        """A new host, connected to nothing."""
        host = Host(name, f"{self._prefix}-{name}")
        run("ip", "netns", "add", host.namespace)
        self._hosts.append(host)
        host.ip("link", "set", "lo", "up")
        return host

    def cable(self, left: Host, right: Host) -> None:
        """Connect two hosts as fast as it goes (veth)."""
        number, names = self._next()
        left.ip("link", "add", names[0], "type", "veth", "peer", "name", names[1], "netns", right.namespace)
        self._connect(left, right, number, names)

    def link(
        self,
        left: Host,
        right: Host,
        *,
        delay_ms: float,
        loss: float = 0.0,
        mbit: float = 0.0,
        queue_ms: float = 100.0,
        seed: int = 1,
    ) -> Link:
        """Connect two hosts: ``delay_ms`` one way, ``loss`` of all packets (0 to 1), ``mbit`` per second (0: no limit)
        with a queue of ``queue_ms`` in front."""
        number, names = self._next()
        link = Link(names, delay_ms=delay_ms, loss=loss, mbit=mbit, queue_ms=queue_ms, seed=seed)
        self._links.append(link)
        for name, host in zip(names, (left, right), strict=True):
            run("ip", "link", "set", name, "netns", host.namespace)
        self._connect(left, right, number, names)
        return link

    def nat(self, gate: Host, *, towards: Host) -> None:
        """Make a host a NAT: what it passes on to ``towards`` looks as if it came from itself, and nothing that comes
        from there gets in unasked."""
        gate.sysctl("net/ipv4/ip_forward", "1")
        device = gate.device_towards(towards)
        rules = f"""
            table ip nat {{
                chain out {{ type nat hook postrouting priority 100; oifname "{device}" masquerade; }}
            }}
            table ip filter {{
                chain through {{
                    type filter hook forward priority 0;
                    iifname "{device}" ct state established,related accept
                    iifname "{device}" drop
                }}
            }}"""
        run(*gate.within, "nft", rules)

    def _next(self) -> tuple[int, list[str]]:
        """The number of the next link, and names for its devices (at most 15 characters)."""
        number = next(self._link_numbers)
        return number, [f"m{os.getpid()}.{number}{end}" for end in "lr"]

    def _connect(self, left: Host, right: Host, number: int, names: Sequence[str]) -> None:
        base = f"10.213.{number // 64}."
        left.set_link(right, f"{base}{number % 64 * 4 + 1}", names[0])
        right.set_link(left, f"{base}{number % 64 * 4 + 2}", names[1])


def _remove_leftovers() -> None:
    """Remove the namespaces of test runs that were killed."""
    for line in run("ip", "netns", "list").splitlines():
        namespace = line.split()[0]
        if namespace.startswith(f"{PREFIX}-") and not Path(f"/proc/{namespace.split('-')[2]}").exists():
            with suppress(OSError):
                run("ip", "netns", "delete", namespace)
