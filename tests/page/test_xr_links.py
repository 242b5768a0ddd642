"""The two connections of a headset in a browser: cut on entering VR, one without the other, and who has control."""

from __future__ import annotations

import json
from functools import partial

import pytest

pytest.importorskip("rclpy")

from tests.page.conftest import ROBOT, Site, StartSite
from tests.page.driving import heard_at
from tests.page.headsets import PATIENT_ROBOT, Headset, headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import OFFLINE, needs_browser

pytestmark = [needs_browser, needs_headset]
RULES = PATIENT_ROBOT + ROBOT
"""The robot is patient."""

LINKS = """
macsXr.told = [];
macsXr.links.addEventListener('link', ({ detail: { which, up, id, resumed } }) => {
  macsXr.told.push({ which, up, id, resumed, at: performance.now() });
});
"""
HELD_LONG = f"""
{PATIENT_ROBOT}
[[robot.rules]]
match = "/cmd_vel"
exclusive = true
hold_s = 60.0
"""


async def told(headset: Headset, which: str) -> list[dict[str, object]]:
    """What became of a connection, in order."""
    found = json.loads(await headset.value("JSON.stringify(macsXr.told)"))
    return [each for each in found if each["which"] == which]


async def back(headset: Headset, which: str) -> bool:
    links = await told(headset, which)
    return bool(links) and bool(links[-1]["up"])


async def test_a_connection_that_is_cut_on_entering_comes_back_as_the_same(site: Site) -> None:
    """Both sockets end as VR begins, which costs others their session: each is back within a second, with its id and
    what it was subscribed to, and the robot is driven on. The one of pictures ends without the other noticing."""
    async with heard_at(site) as heard:
        headset = await headset_at(site)
        headset.watched.allowed.append(OFFLINE)
        await headset.ready()
        ids = await headset.state("id"), await headset.value("macsXr.links.sightUp.id")
        assert len(set(ids)) == 2
        await headset.value(LINKS)
        await headset.value(
            "macsXr.immersion.addEventListener('entered', () => {"
            "  for (const each of [macsXr.links.commands, macsXr.links.sight]) each.postMessage({ op: 'drop' });"
            "}, { once: true })"
        )
        await headset.enter()
        for which, own in zip(("commands", "pictures"), ids, strict=True):
            await until(partial(back, headset, which))
            down, up = await told(headset, which)
            assert (down["up"], up["up"], up["resumed"], up["id"]) == (False, True, True, own)
            took_ms = float(str(up["at"])) - float(str(down["at"]))
            print(f"{which}: the same again after {took_ms:.0f} ms")
            assert took_ms < 1000
        shown = await headset.value("[...macsXr.room.screens.values()][0].shown")
        await until(lambda: headset.value(f"[...macsXr.room.screens.values()][0].shown > {shown + 2}"))
        take, let_go = partial(hold, headset), partial(headset.squeeze, "right", held=False)
        await headset.drives(heard, take, let_go)
        await headset.value("macsXr.told.length = 0; macsXr.links.sight.postMessage({ op: 'drop' })")
        await until(partial(back, headset, "pictures"))
        assert await told(headset, "commands") == []
        await let_go()
        await until(lambda: heard.last == 0.0)


async def hold(headset: Headset) -> None:
    await headset.squeeze("right", held=True)
    await headset.stick("right", 0, -1)


async def test_a_second_headset_is_told_who_has_control_and_gets_it(start_site: StartSite) -> None:
    """It sees who has control and does not drive; handed over, it drives, and the first one does not."""
    site = await start_site(rules=HELD_LONG)
    async with heard_at(site) as heard:
        first = await headset_at(site, settings={"cameras": []})
        await first.ready(pictures=False)
        second = await headset_at(site, settings={"cameras": []})
        await second.ready(pictures=False)
        await first.page.click("#take")
        await until(lambda: first.state("holder === 'you'"))
        own = await first.state("id")
        await until(lambda: second.state(f"holder === 'headset {own}'"))
        assert await second.state("barred") == f"headset {own} has control"
        await second.enter()
        await hold(second)
        await second.frame(10)
        assert await second.state("held") is False
        assert not any(heard.speeds)
        await second.shot("refused")
        await second.squeeze("right", held=False)
        await first.page.click("#give")
        await until(lambda: second.state("holder === 'you'"))
        await until(lambda: second.state("barred === ''"))
        await second.drives(heard, partial(hold, second), partial(second.squeeze, "right", held=False))
        await until(lambda: first.state("barred.endsWith('has control')"))
        await second.squeeze("right", held=False)
        await until(lambda: heard.last == 0.0)
