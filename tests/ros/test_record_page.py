"""docs/record.md: every command on the page is run as it stands there, and says what the page says."""

from __future__ import annotations

import re
import shlex
import shutil
import signal
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")
pytest.importorskip("foxglove", reason="needs the extra foxglove: pip install 'macs-zenoh[foxglove]'")

from std_msgs.msg import String

from bridge.cli import build_parser
from bridge.settings import parse
from tests.support.programs import ROOT, Program, ended
from tests.support.ros_peer import Peer
from tests.support.routers import Router
from tests.support.waiting import until

PAGE = (ROOT / "docs" / "record.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```console\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
COMMANDS = [line.removeprefix("$ ") for block in BLOCKS for line in block.splitlines() if line.startswith("$ ")]
ROUTER = "tcp/192.168.1.10:7447"
SERVE = {"record", "replay", "foxglove"}


def shape(line: str) -> str:
    """A line without numbers, paths and ids: what stays the same from one run to another."""
    line = re.sub(r"\S*/", "", line)
    line = re.sub(r"\d[\d_.:-]*", "N", line)
    return re.sub(r"N (k|M|G)?B", "N B", line)


async def test_every_command_on_the_page(peer: Peer, domain: int, tmp_path: Path) -> None:
    """Each ends with 0 and says what is shown; those that go on say that they are ready, and stop at Ctrl-C."""
    publisher = await peer.publisher(String, "/chatter")
    assert len(COMMANDS) > 8
    async with (
        Router() as router,
        Program("agent", "--id", "7", "-e", router.endpoint, env={"ROS_DOMAIN_ID": str(domain)}) as robot,
    ):
        for command in COMMANDS:
            words = shlex.split(command.replace(ROUTER, router.endpoint))[1:]
            words = [str(tmp_path / w) if w.endswith((".mcap", "_ros", "recordings")) else w for w in words]
            if words[0] in SERVE and "-e" not in words:
                words += ["-e", router.endpoint]
            if words[0] == "foxglove":
                words += ["--port", "0"]
            if words[0] == "replay":
                await robot.stop()  # its id is wanted for the recording
            if words[:2] == ["bag", "merge"]:
                for name in ("site.mcap", "robot.mcap"):
                    shutil.copy(tmp_path / "monday.mcap", tmp_path / name)
            shown = next(block for block in BLOCKS if f"$ {command}\n" in block).splitlines()
            shown = [shape(line) for line in shown if not line.startswith(("$ ", "^C"))]
            if words[0] in SERVE:
                async with Program(*words) as program:
                    assert shape(f"ready: {program.ready}") in [
                        line.replace("robots N, N", "robot N") for line in shown
                    ]
                    if words[0] == "record" and "--ring" not in words:
                        file = tmp_path / "monday.mcap"

                        def recorded(file: Path = file) -> bool:
                            publisher.publish(String(data="hello"))
                            return b"/7/chatter" in file.read_bytes()

                        await until(recorded, every_s=0.1)
                    assert await program.stop(signal.SIGINT) == 0, program.tail
            else:
                code, out, errors = await ended(*words)
                assert code == 0, (command, errors)
                if shown and "repair" in words:
                    assert shape(out.splitlines()[0]).startswith(shape("monday.repaired.mcap: 9 messages of 6 whole"))


def test_every_option_on_the_page_is_one() -> None:
    """Each command in the text is taken by the parser, with the names of files that the page uses."""
    for command in re.findall(r"`(macs (?:record|bag|replay|foxglove) [^`…]*)`", PAGE):
        words = shlex.split(command)[1:]
        if words == ["bag", "to-rosbag2"] or len(words) < 2:
            continue
        if words[:2] == ["bag", "to-rosbag2"] and len(words) == 2:
            continue
        build_parser().parse_args(words)


def test_the_settings_on_the_page_are_settings() -> None:
    """The example is accepted as it stands there."""
    (example,) = re.findall(r"^```toml\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert parse(example).record.on == ["stop", "deadman"]
