"""`tests.support.sharing`: who gets which tests, and when."""

from __future__ import annotations

from tests.support.sharing import BROWSERS, IN_NODE, ONE_WORKER, TOGETHER, order, page_groups, path_of, scope_of

PAGES = [f"tests/page/test_{letter}.py::test_{number}" for letter in "abcde" for number in range(5)]
QUICK = [f"tests/unit/test_{letter}.py::test_{number}" for letter in "abcd" for number in range(3)]
OTHERS = [f"tests/ros/test_{letter}.py::test_{number}" for letter in "abcdefgh" for number in range(4)]
LONG = ["tests/conformance/test_conformance.py::test_right", "tests/ros/test_graph_verbs.py::test_all"]


def test_each_page_has_one_group_and_groups_are_alike() -> None:
    """Tests of one file share a site, so they are never parted; no more groups than there may be browsers."""
    groups = page_groups([*OTHERS, *PAGES])
    assert set(groups) == {path_of(name) for name in PAGES}
    sizes = [sum(groups[path_of(name)] == group for name in PAGES) for group in set(groups.values())]
    assert len(sizes) == BROWSERS
    assert max(sizes) - min(sizes) <= 5


def test_what_waits_for_the_same_is_handed_out_together() -> None:
    """A page's group, a quick file, and a file whose tests wait for one thing that is made; others go one by one."""
    groups = page_groups(PAGES)
    assert {scope_of(name, groups) for name in PAGES} == set(groups.values())
    assert scope_of(QUICK[0], groups) == path_of(QUICK[0])
    assert {scope_of(f"{ONE_WORKER[0]}::test_{letter}", groups) for letter in "ab"} == {ONE_WORKER[0]}
    for group in TOGETHER:
        assert len({scope_of(f"{path}::test_a", groups) for path in group}) == 1
    for name in (OTHERS[0], f"{IN_NODE[0]}::test_frames"):
        assert scope_of(name, page_groups([*PAGES, name])) == name


def test_what_is_long_comes_first() -> None:
    """Pages, then what takes long; the rest as it was, with the quick files spread among what waits."""
    names = [*OTHERS, *PAGES, *LONG, *QUICK]
    ordered = [names[index] for index in order(names)]
    assert sorted(ordered) == sorted(names)
    assert ordered[: len(PAGES)] == PAGES
    assert ordered[len(PAGES) : len(PAGES) + len(LONG)] == LONG
    rest = ordered[len(PAGES) + len(LONG) :]
    assert [name for name in rest if name in OTHERS] == OTHERS
    assert [name for name in rest if name in QUICK] == QUICK
    begins = [rest.index(f"tests/unit/test_{letter}.py::test_0") for letter in "abcd"]
    assert begins[0] < 3
    assert len(rest) / 2 < begins[-1]


def test_any_choice_of_tests_has_an_order() -> None:
    """Also where there are none of a kind."""
    for names in ([], QUICK, PAGES, LONG, OTHERS):
        assert sorted(order(names)) == list(range(len(names)))
