"""A site as processes: a router, a gateway and a robot agent; and what they take of the machine."""

from __future__ import annotations

import signal
from contextlib import AsyncExitStack, suppress
from pathlib import Path

from macs_zenoh.config import MeshSettings
from macs_zenoh.protocol.limits import UNFINISHED_IN_ALL_BYTES, WAITING_IN_ALL_BYTES
from tests.attack import secured
from tests.attack.ways import Way
from tests.support.certificates import Authority
from tests.support.programs import Program, free_port
from tests.support.routers import Router, as_macs_router

MIB = 1 << 20
ROBOT = 1
DEADMAN_S = 0.3

SLACK_BYTES = 64 * MIB
"""A frame of 32 MiB is there twice in the moment in which it is whole."""
MEMORY_LIMITS = {
    "gateway": max(WAITING_IN_ALL_BYTES, UNFINISHED_IN_ALL_BYTES) + SLACK_BYTES,
    "robot": 2 * SLACK_BYTES,
}
"""What an attack may cost our programs at most. The router is Zenoh's, and its queues are per link."""

SETTINGS = f"""
[gateway]
resume_s = 5

[[robot.rules]]
match = "/cmd_vel"
exclusive = true
deadman_s = {DEADMAN_S}
deadman_message = {{ linear = {{ z = -1 }} }}
"""


class Site:
    """A router, a gateway and a robot agent; with certificates where there is a directory for them."""

    def __init__(self, settings: Path, domain: int, pki: Path | None = None, way: Way = "tcp") -> None:
        self.pki = pki
        self.attacked_by = way
        self._attacked_port = free_port()
        env = {"ROS_DOMAIN_ID": str(domain)}
        if pki is not None:
            self.endpoint = secured.made(pki)
            self.mesh = secured.mesh_of(pki, secured.OPERATED)
            mine = {name: pki / name / "macs.toml" for name in (secured.GATEWAY, secured.ROBOT)}
            with mine[secured.ROBOT].open("a") as robots:
                robots.write(settings.read_text())
            self.router = Router(pki / "site" / "router.json5")
            self.gateway = Program("gateway", "--port", "0", "--settings", str(mine[secured.GATEWAY]))
            self.robot = Program("agent", "--settings", str(mine[secured.ROBOT]), env=env)
            return
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.mesh = MeshSettings(connect=[self.endpoint])
        common = ("-e", self.endpoint, "--settings", str(settings))
        self.router = Router(listen=[self.endpoint], overrides=as_macs_router(MeshSettings()))
        self.gateway = Program("gateway", *self._ports(settings.parent), "--robots", "any", *common)
        self.robot = Program("agent", "--id", str(ROBOT), *common, env=env)

    def _ports(self, directory: Path) -> list[str]:
        """What the gateway listens on. Everybody who behaves comes over TCP as it is."""
        if self.attacked_by == "tcp":
            return ["--port", "0"]
        ports = ["--port", str(free_port()), f"--{self.attacked_by}-port", str(self._attacked_port)]
        if self.attacked_by == "tls":
            ports += certified(directory)
        return ports

    @property
    def attacked_port(self) -> int:
        """Where attackers come in."""
        return self.gateway.port if self.attacked_by == "tcp" else self._attacked_port

    @property
    def programs(self) -> dict[str, Router | Program]:
        """Each by what it is."""
        return {"router": self.router, "gateway": self.gateway, "robot": self.robot}

    async def start(self, stack: AsyncExitStack) -> None:
        """Start all three; they are killed in the end, as an attack may have left them in any state."""
        for program in self.programs.values():
            await program.start()
            stack.push_async_callback(_kill, program)


def certified(directory: Path) -> list[str]:
    """Options of a gateway that shows a certificate to headsets."""
    certificate, key = Authority(directory / "ca").issue("gateway")
    return ["--certificate", str(certificate), "--key", str(key)]


async def _kill(program: Router | Program) -> None:
    with suppress(AssertionError, ProcessLookupError):
        await program.stop(signal.SIGKILL)


def status_bytes(pid: int, field: str) -> int:
    """A size from /proc/PID/status: VmRSS, or VmHWM for the highest since `forget_peak`."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024
    return 0


def forget_peak(pid: int) -> None:
    """Let VmHWM begin anew."""
    with suppress(OSError):
        Path(f"/proc/{pid}/clear_refs").write_text("5")


def threads(pid: int) -> int:
    """How many threads a process has."""
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


def descriptors(pid: int) -> int:
    """How many descriptors a process has open."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))
