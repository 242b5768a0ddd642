"""The JavaScript client: its bytes are those of the vectors, and the conformance kit finds nothing wrong with it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bridge.conformance import headset, vectors
from bridge.conformance.checks import Outcome, Verdict
from bridge.conformance.program import Command
from macs_zenoh.protocol.decoders import FrameDecoder
from macs_zenoh.protocol.wire import Frame
from tests.support.browser import STATIC, needs_browser, needs_node, node
from tests.support.waiting import PATIENCE_S

HERE = Path(__file__).parent


def ran(script: str, given: object) -> Any:
    """What a script for node makes of this, as JSON."""
    command = [*(node() or []), HERE / script, STATIC]
    done = subprocess.run(command, input=json.dumps(given), capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def taken_apart(frame: bytes) -> dict[str, Any]:
    """A frame by its parts, JSON as values."""
    (whole,) = FrameDecoder().feed(frame)
    assert isinstance(whole, Frame)
    header = whole.header
    return {
        "type": header.agent_type,
        "ids": [each for each in header.ids if each],
        "groups": [each for each in header.groups if each],
        "management": json.loads(bytes(whole.management)) if whole.has_management else None,
        "metadata": json.loads(bytes(whole.metadata)) if bytes(whole.metadata) else None,
        "data": bytes(whole.body).hex() if bytes(whole.metadata) else None,
    }


@needs_node
def test_its_frames_are_those_of_the_vectors() -> None:
    """Each frame that a headset sends is written as the vectors have it, and each message read, however it is cut."""
    frames = [taken_apart(vector.example) for vector in vectors.read("headset_frames")]
    messages = [*vectors.read("router_messages"), *vectors.read("bad_messages")]
    made = ran("frames.mjs", {"frames": frames, "messages": [message.example.hex() for message in messages]})
    assert [taken_apart(bytes.fromhex(frame)) for frame in made["made"]] == frames
    for message, read in zip(messages, made["answers"], strict=True):
        if message.marks.get("costs") == "connection":
            assert read == ["lost"], message.name
        else:
            assert len(read) == 1, message.name
    assert made["keys"] == {"agentId": 1, "agentId2": 2, "agentID": 3, "x": {"a_b": 1}}


@needs_node
def test_a_command_goes_before_the_question_whether_its_connection_is_fresh() -> None:
    """One question at a time, behind all that is sent at that moment."""
    assert ran("fresh.mjs", None) == ["command", "command", "question"]


@needs_node
def test_a_goal_that_its_robot_does_not_know_is_not_asked_for_again() -> None:
    """Its result is why, and that was the last word."""
    assert ran("goals.mjs", None) == {"asked": 1, "askedAfter": 0, "why": "no such goal"}


def failed(verdicts: list[Verdict]) -> dict[str, str]:
    return {verdict.check.name: verdict.why for verdict in verdicts if verdict.outcome is Outcome.FAILED}


async def judged(command: str) -> list[Verdict]:
    program = Command(command)
    try:
        return await headset.judge("127.0.0.1", 0, patience_s=PATIENCE_S, most_s=250, program=program, web=True)
    finally:
        await program.stop()


def proven(verdicts: list[Verdict]) -> None:
    """Nothing failed, and all was tried that the kit can try."""
    assert failed(verdicts) == {}
    skipped = {verdict.check.name for verdict in verdicts if verdict.outcome is Outcome.SKIPPED}
    assert skipped == set()


@needs_node
async def test_it_conforms_in_node() -> None:
    """`macs conformance headset --web` against macs.js in node: every check, and none fails."""
    script = [*(node() or []), str(HERE / "headset.mjs"), str(STATIC), "ws://127.0.0.1:{port}/macs"]
    proven(await judged(" ".join(script)))


@needs_browser
@pytest.mark.parametrize("where", ["page", "worker"])
async def test_it_conforms_in_chromium(where: str) -> None:
    """The same in a browser, in a page and in a worker."""
    script = [sys.executable, str(HERE / "browser_headset.py"), "ws://127.0.0.1:{port}/macs", where]
    proven(await judged(" ".join(script)))
