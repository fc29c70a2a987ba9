"""Links let one browser in each; visitors are known by their cookies."""

import pytest

from ldcnd.console.visitors import IDLE_S, LINK_S, MOST_LINKS, MOST_VISITORS, Visitors, is_csrf_of


class Clock:
    now_s = 1000.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def visitors(clock):
    return Visitors(clock)


def test_a_link_lets_one_browser_in(visitors):
    link = visitors.new_link()

    visitor = visitors.enter(link)

    assert visitor
    assert visitor.client == "console-1"
    assert visitors.find(visitor.token) is visitor
    assert visitors.enter(link) is None


@pytest.mark.parametrize("wrong", ["", "guess", "\xe9", "\udc80"])
def test_what_is_no_link_lets_nobody_in(visitors, wrong):
    visitors.new_link()

    assert visitors.enter(wrong) is None
    assert visitors.find(wrong) is None


def test_a_link_gets_too_old(visitors, clock):
    link = visitors.new_link()
    clock.now_s += LINK_S + 1

    assert visitors.enter(link) is None


def test_links_and_visitors_are_told_apart(visitors):
    links = [visitors.new_link() for _ in range(3)]

    entered = [visitors.enter(link) for link in links]

    assert [visitor.number for visitor in entered] == [1, 2, 3]
    assert len({visitor.token for visitor in entered} | {visitor.csrf for visitor in entered}) == 6
    assert all(len(visitor.token) > 40 for visitor in entered)
    assert is_csrf_of(entered[0], entered[0].csrf)
    assert not is_csrf_of(entered[0], entered[1].csrf)
    assert not is_csrf_of(entered[0], entered[0].token)


def test_many_links_push_out_the_oldest_only(visitors):
    links = [visitors.new_link() for _ in range(MOST_LINKS + 1)]

    assert visitors.enter(links[0]) is None
    assert visitors.enter(links[1])


def test_a_browser_without_any_page_for_long_is_forgotten_and_one_with_a_page_is_not(visitors, clock):
    away, watching = visitors.enter(visitors.new_link()), visitors.enter(visitors.new_link())
    for _ in range(14):
        clock.now_s += IDLE_S / 12
        visitors.see(watching)

    assert visitors.find(away.token) is None
    assert visitors.find(watching.token) is watching


def test_too_many_browsers_push_out_the_one_that_was_quiet_longest(visitors, clock):
    entered = []
    for _ in range(MOST_VISITORS):
        clock.now_s += 1
        entered.append(visitors.enter(visitors.new_link()))
    clock.now_s += 1
    visitors.find(entered[0].token)

    visitors.enter(visitors.new_link())

    assert visitors.find(entered[0].token)
    assert visitors.find(entered[1].token) is None


def test_a_standing_token_lets_in_any_number_and_nothing_else_does(clock):
    visitors = Visitors(clock, "t" * 40)
    clock.now_s += 10 * LINK_S

    assert visitors.new_link() == "t" * 40
    assert [visitors.enter("t" * 40).number for _ in range(3)] == [1, 2, 3]
    assert visitors.enter("t" * 39) is None
    assert visitors.enter("") is None
