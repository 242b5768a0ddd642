"""Whether `macs security check` notices what real routers let through or hold back."""

from __future__ import annotations

import asyncio
import signal
import socket
import sys
import time
from pathlib import Path

import pytest

import macs_zenoh
from bridge.security import router_path
from bridge.security.check import check
from macs_zenoh import awareness
from macs_zenoh.errors import Unreachable
from tests.support.programs import ROOT, Program, ended, macs
from tests.support.routers import Router
from tests.support.secured import CLIENTS, Site, answered, linked, made, online, until_answered
from tests.support.waiting import PATIENCE_S, until


async def test_a_generated_router_holds_everybody_to_the_plan(site: Site) -> None:
    """Tried with every certificate on the real router: everything is as expected, permitted and forbidden alike."""
    results = await check(site.policy, site.directory)
    assert [result for result in results if not result.as_expected] == []
    for word in ("heard by", "is online", "calls", "delivers to"):
        assert {result.permitted for result in results if word in result.what} == {True, False}, word


async def test_the_same_through_our_own_router(tmp_path: Path) -> None:
    """`macs router -c` with the generated file does the same as zenohd."""
    found = made(tmp_path / "pki")
    async with Program("router", "-c", str(found.file())):
        assert await found.wrong() == []


async def test_across_two_routers(tmp_path: Path) -> None:
    """What is permitted passes the link between two routers, both ways, and what is forbidden does not."""
    found = made(tmp_path / "pki", routers=2)
    async with Router(found.file("site")), Router(found.file("cloud")):
        await linked(found)
        results = await check(found.policy, found.directory)
    assert {result.router for result in results} == {"site", "cloud", "site to cloud", "cloud to site"}
    assert [result for result in results if not result.as_expected] == []


async def test_gateways_without_blocks_and_a_namespace(tmp_path: Path) -> None:
    """The shortest policy, within a namespace, is held to as well."""
    found = made(
        tmp_path / "pki",
        "\nrobots: [{name: r, id: 7, awareness_name: drone7}, {name: s, id: 300, awareness_name: drone8}]\n"
        "gateways: [{name: hall}, {name: lab}]\noperators: [{name: anna}, {name: berta, id: 5}]\n"
        "permissions: [{who: all, may: all, whom: all}]\nnamespace: site1\n",
    )
    async with Router(found.file()):
        assert await found.wrong() == []


async def test_an_answer_that_takes_longer_is_no_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is permitted and not answered in time is asked once more, with patience: a busy machine refuses nobody."""
    monkeypatch.setattr(router_path, "ANSWER_S", 0.001)
    found = made(
        tmp_path / "pki",
        "\nrobots: [{name: r, id: 7}]\ngateways: [{name: hall, blocks: [1]}]\n"
        "permissions: [{who: hall, may: all, whom: r}]\n",
    )
    async with Router(found.file()):
        assert await found.wrong() == []


LOOSENED = {
    "a gateway commands a robot": ("hall-2 speaks", "macs/to/ros/0/7/unity/767", "hall-2 puts to robot-7 by id"),
    "a gateway is another's headset": ("hall-2 speaks", "macs/**/unity/*", "hall-2 puts as hall-1"),
    "a robot calls": ("robot-7 asks", "macs/call/**", "robot-7 calls macs_check of robot-8"),
    "a robot is another": ("robot-9 is present", "macs/live/**", "robot-9 is online as robot-7"),
    "a robot sees all": ("robot-9 sees who is there", "macs/live/**", "robot-7 is online, heard by robot-9"),
    "a gateway leases all": ("hall-2 is present", "macs/block/*/*", "hall-2 leases block 1 as hall-1"),
    "an operator sees a stream": ("anna", "macs/from/**", "robot-7 puts on a stream, heard by anna"),
    "a robot reads another's mail": ("robot-9", "macs/ca/to/**", "robot-7 puts to robot-8 by name, heard by somebody"),
    "a gateway answers for a robot": ("hall-2 answers", "macs/call/**", "hall-2 answers hall-1 as robot-7"),
}
WIDEST = "a gateway is another's headset"


@pytest.mark.parametrize("by_itself", [False, True])
async def test_the_check_finds_rules_that_were_loosened(by_itself: bool, tmp_path: Path) -> None:
    """Whatever somebody added to a router's rules by hand is found, with what it lets through. The one that would hide
    others is tried by itself."""
    loosened = {how: row for how, row in LOOSENED.items() if (how == WIDEST) == by_itself}
    found = made(tmp_path / "pki")
    text = found.file().read_text()
    for rule, key, _ in loosened.values():
        names = [rule] if " " in rule else [f"{rule} subscribes", f"{rule} hears"]
        if rule.endswith(" answers"):
            names.append(rule.replace("answers", "is asked"))
        for name in names:
            text = with_key(text, name, key)
    found.file().write_text(text)
    async with Router(found.file()):
        wrong = [one.what for one in await found.wrong() if one.seen and not one.permitted]
    overlooked = [how for how, row in loosened.items() if not any(what.startswith(row[2]) for what in wrong)]
    assert overlooked == [], wrong


async def test_what_is_heard_late_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who was asked what he may not be has heard it, also when it took longer than an answer has: a busy machine hides
    no hole."""
    monkeypatch.setattr(router_path, "ANSWER_S", 0.001)
    found = made(tmp_path / "pki")
    text = found.file().read_text()
    for name in ("robot-7 asks", "hall-2 answers", "hall-2 is asked"):
        text = with_key(text, name, "macs/call/**")
    found.file().write_text(text)
    async with Router(found.file()):
        wrong = [one.what for one in await found.wrong() if one.seen and not one.permitted]
    for what in ("a robot calls", "a gateway answers for a robot"):
        assert any(one.startswith(LOOSENED[what][2]) for one in wrong), wrong


def with_key(text: str, rule: str, key: str) -> str:
    head, mark, tail = text.partition(f'id: "{rule}",')
    assert mark, rule
    before, keys, after = tail.partition("key_exprs: [")
    return f'{head}{mark}{before}{keys}"{key}", {after}'


MISSING = {
    "robot-7 hears": "hall-1 puts to robot-7 by id, heard by robot-7",
    "hall-1 asks": "hall-1 calls macs_check of robot-7",
    "robot-8 is present": "robot-8 is online, heard by hall-1",
    "anna is answered": "anna asks who the routers are",
}


async def test_the_check_finds_rules_that_are_missing(tmp_path: Path) -> None:
    """A rule that is not there any more is found by what does not work without it."""
    found = made(tmp_path / "pki")
    text = found.file().read_text()
    for rule in MISSING:
        assert text.count(f'"{rule}"') == 2
        policy = text.rindex(f'"{rule}"')
        text = text[:policy] + text[policy:].replace(f'"{rule}", ', "", 1).replace(f'"{rule}",', "", 1)
    found.file().write_text(text)
    async with Router(found.file()):
        wrong = [one.what for one in await found.wrong() if one.permitted and not one.seen]
    overlooked = [rule for rule, found_as in MISSING.items() if not any(what.startswith(found_as) for what in wrong)]
    assert overlooked == [], wrong


async def test_the_check_finds_a_router_that_lets_everybody_in(tmp_path: Path) -> None:
    """Without mutual TLS, or with rules that allow by default, almost everything is wrong, and it says so."""
    found = made(tmp_path / "pki")
    text = found.file().read_text()
    found.file().write_text(
        text.replace('default_permission: "deny"', 'default_permission: "allow"').replace(
            "enable_mtls: true", "enable_mtls: false"
        )
    )
    async with Router(found.file()):
        wrong = {one.what for one in await found.wrong()}
    assert "somebody without a certificate is let in" in wrong
    assert "robot-9 is online as robot-7, heard by hall-1" in wrong


async def test_a_check_does_not_disturb_who_is_there(site: Site) -> None:
    """While everything is tried, agents get no message and no call, see nobody come or go, and go on working."""
    async with (
        macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")) as robot,
        macs_zenoh.join("unity", id=511, group=3, settings=site.settings("hall-1")) as headset,
        awareness.join(robot, "drone7") as drone,
    ):
        await until(lambda: ("ros", 7) in online(headset))
        changes: list[object] = []
        called: list[str] = []

        async def answer(call: macs_zenoh.Call) -> bytes:
            called.append(call.verb)
            return b""

        for verb in ("status", "stop", "add_node"):
            robot.serve(verb, answer)
        for agent in (robot, headset):
            agent.on_presence(lambda who, here: changes.append((who, here)))
        known = len(changes)
        assert await site.wrong() == []
        headset.send(b"after", to="ros", ids=[7])
        robot.send(b"after", to="unity", ids=[511])
        for agent in (robot, headset):
            assert (await asyncio.wait_for(agent.receive(), PATIENCE_S)).data == b"after"
            assert not agent.drops
        assert len(changes) == known
        assert not called
        assert drone.others() == []


async def test_calls_of_others_pass_a_check(site: Site) -> None:
    """While everything is tried, a call of a robot that is online gets that robot's answer, and one of a robot that is
    not gets none."""
    async with (
        macs_zenoh.join("ros", id=7, group=3, settings=site.settings("robot-7")) as robot,
        macs_zenoh.join("unity", id=256, settings=site.settings("hall-1")) as headset,
    ):

        async def answer(call: macs_zenoh.Call) -> bytes:
            return call.data + b" by the robot"

        verbs = ("stop", "add_node", "status")
        for verb in verbs:
            robot.serve(verb, answer)
        await until(lambda: ("ros", 7) in online(headset))
        checking = asyncio.create_task(site.wrong())
        calls = 0
        while not checking.done():
            for verb in verbs:
                assert await headset.call("ros", 7, verb, b"%d" % calls) == b"%d by the robot" % calls
                with pytest.raises(Unreachable):
                    await headset.call("ros", 8, verb)
                calls += 1
        assert await checking == []
        assert calls > len(verbs)


async def test_a_stand_in_gives_way(site: Site) -> None:
    """Who stands in for a robot is asked while the robot is not there, and not any more when it is; its silence is no
    answer."""
    asked: list[bytes] = []

    async def silence(key: str, payload: bytes) -> bytes | None:
        asked.append(payload)
        return None

    async def answer(key: str, payload: bytes) -> bytes:
        return b"yes"

    key = "macs/call/ros/7/stop/unity/256"
    async with site.session("robot-7") as first, site.session("robot-7") as robot, site.session("hall-1") as hall:
        first.serve("macs/call/ros/7/stop/**", silence, stand_in=True)
        while not asked:
            assert not await answered(hall, key)
        robot.serve("macs/call/ros/7/**", answer)
        await until_answered(hall, key)
        asked.clear()
        assert [await answered(hall, key, PATIENCE_S) for _ in range(10)] == [True] * 10
        assert not asked


# -- the command -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
async def test_a_check_that_was_stopped_is_none_that_went_well(how: signal.Signals, tmp_path: Path) -> None:
    """Ctrl-C or SIGTERM in the middle of a check ends it with 130."""
    found = made(tmp_path / "pki")
    listen = found.router("site")[0]
    (tmp_path / "policy.yaml").write_text(
        f"routers: [{{name: site, addresses: [127.0.0.1], listen: ['{listen}']}}]" + CLIENTS
    )
    with socket.create_server(("127.0.0.1", int(listen.rpartition(":")[2]))) as says_nothing:
        says_nothing.setblocking(False)
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "bridge", "security", "check", str(tmp_path / "policy.yaml")),
            *("--dir", str(found.directory)),
            cwd=ROOT,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
        )
        begun, _ = await asyncio.wait_for(asyncio.get_running_loop().sock_accept(says_nothing), PATIENCE_S)
        process.send_signal(how)
        assert await asyncio.wait_for(process.wait(), PATIENCE_S) == 130
        begun.close()


async def test_a_check_without_a_router_gives_up(tmp_path: Path) -> None:
    """Where nobody listens, a check ends after its time with one line, however many sessions it would have made."""
    found = made(tmp_path / "pki")
    nowhere = found.router("site")[0]
    plan_file = tmp_path / "policy.yaml"
    plan_file.write_text(f"routers: [{{name: site, addresses: [127.0.0.1], listen: ['{nowhere}']}}]" + CLIENTS)
    began = time.monotonic()
    code, out, errors = await ended(
        "security", "check", str(plan_file), "--dir", str(found.directory), "-e", nowhere, "--timeout", "1"
    )
    assert time.monotonic() - began < PATIENCE_S
    assert (code, out) == (1, "")
    assert errors == f"macs security: {nowhere} cannot be reached: nobody listens there, tried for 1 s\n"


async def test_the_command_generates_and_checks(tmp_path: Path) -> None:
    """`macs security generate` says what it made, `check` whether it holds; the exit code says it to programs."""
    found = made(tmp_path / "unused")
    routers = f"routers: [{{name: site, addresses: [127.0.0.1], listen: ['{found.router('site')[0]}']}}]"
    (tmp_path / "policy.yaml").write_text(routers + CLIENTS)
    pki = str(tmp_path / "pki")
    code, out, _ = await ended("security", "generate", str(tmp_path / "policy.yaml"), "--into", pki)
    assert code == 0
    assert "7 certificates made, 0 kept, 7 files written" in out
    told = await macs(
        "security", "generate", str(tmp_path / "policy.yaml"), "--into", pki, "--renew", "anna", "--json"
    )
    assert [one["name"] for one in told["certificates"] if one["made"]] == ["anna"]
    assert (told["written"], told["restart"]) == ([], [])

    code, out, errors = await ended("security", "check", str(tmp_path / "policy.yaml"), "--dir", pki)
    assert (code, out) == (1, "")
    assert "nobody listens there" in errors
    async with Router(tmp_path / "pki" / "site" / "router.json5"):
        code, out, _ = await ended("security", "check", str(tmp_path / "policy.yaml"), "--dir", pki)
        assert code == 0, out
        assert out.endswith(" 0 not\n")
        results = await macs("security", "check", str(tmp_path / "policy.yaml"), "--dir", pki, "--json")
        assert all(result["as_expected"] for result in results)
    (tmp_path / "policy.yaml").write_text(routers + CLIENTS.replace("robot-7, id", "robot-7, idd"))
    code, _, errors = await ended("security", "generate", str(tmp_path / "policy.yaml"), "--into", pki)
    assert code == 2
    assert "did you mean `id`?" in errors
