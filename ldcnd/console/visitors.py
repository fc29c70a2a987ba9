"""Who may use the console: links that let a browser in, and the browsers that were let in."""

import hashlib
import hmac
import secrets
from collections.abc import Callable
from dataclasses import dataclass

LINK_S = 600.0
IDLE_S = 12 * 3600.0
"""Time without an open page after which a browser needs another link, seconds."""
MOST_LINKS = 16
MOST_VISITORS = 100
TOKEN_BYTES = 32


@dataclass(slots=True, eq=False)
class Visitor:
    """One browser.

    Attributes:
        number: in the order in which they came; commands go under the name `console-<number>`.
        token: what its cookie must have.
        csrf: what its commands must carry.
        seen_at_s: time of its last request or open page.
    """

    number: int
    token: str
    csrf: str
    seen_at_s: float

    @property
    def client(self) -> str:
        """The name under which its commands go."""
        return f"console-{self.number}" if self.number else "console, a page of before"


@dataclass(frozen=True, slots=True)
class _Link:
    token: str
    until_s: float


class Visitors:
    """Keeps links and visitors in memory: of those of a process that has ended only the pages may bring to rest.

    Args:
        now_s: a clock.
        standing_token: lets in every browser that has it, any number of times; None is the rule on one's own machine.
        page_key: signs what pages send, so that one of an earlier process with this key is known.
    """

    def __init__(
        self, now_s: Callable[[], float], standing_token: str | None = None, page_key: bytes | None = None
    ) -> None:
        self._now_s = now_s
        self._standing_token = standing_token
        self._page_key = page_key or secrets.token_bytes(TOKEN_BYTES)
        self._links: list[_Link] = []
        self._visitors: list[Visitor] = []
        self._count = 0

    def new_link(self) -> str:
        """Return what a link must carry to let one browser in, once, within `LINK_S`; or the standing token."""
        if self._standing_token is not None:
            return self._standing_token
        link = _Link(secrets.token_urlsafe(TOKEN_BYTES), self._now_s() + LINK_S)
        self._links = [*self._links, link][-MOST_LINKS:]
        return link.token

    def enter(self, token: str, known: Visitor | None = None) -> Visitor | None:
        """Let a browser in that brings a link; None for one that is unknown, used or too old.

        Args:
            token: of the link.
            known: who the browser is if it was let in before; it stays that.
        """
        now_s = self._now_s()
        if not self._standing_token_is(token):
            # every link is compared, so that the time it takes tells nothing
            used = [link for link in self._links if _same(link.token, token)]
            self._links = [link for link in self._links if link not in used and link.until_s > now_s]
            if not used or used[0].until_s <= now_s:
                return None
        if known:
            return known
        self._count += 1
        visitor = Visitor(self._count, secrets.token_urlsafe(TOKEN_BYTES), self._signed(secrets.token_hex(8)), now_s)
        self._visitors = [*self._visitors, visitor]
        if len(self._visitors) > MOST_VISITORS:
            self._visitors.remove(min(self._visitors, key=lambda each: each.seen_at_s))
        return visitor

    def find(self, token: str) -> Visitor | None:
        """Return the visitor whose cookie has this token, and record the time."""
        return self._seen([each for each in self._present() if _same(each.token, token)])

    def of_page(self, csrf: str) -> Visitor | None:
        """Return the visitor whose page sends this, and record the time; without a number one who is not in any more.

        A page stays open over a restart of the console, and may have axes in sight that move.
        """
        known = self._seen([each for each in self._present() if is_csrf_of(each, csrf)])
        was_in = _same(self._signed(csrf.partition(".")[0]), csrf)
        return known or (Visitor(0, "", csrf, self._now_s()) if was_in else None)

    def see(self, visitor: Visitor) -> None:
        """Note that a visitor has a page open."""
        visitor.seen_at_s = self._now_s()

    def _present(self) -> list[Visitor]:
        now_s = self._now_s()
        self._visitors = [each for each in self._visitors if each.seen_at_s > now_s - IDLE_S]
        return self._visitors

    def _seen(self, known: list[Visitor]) -> Visitor | None:
        if not known:
            return None
        self.see(known[0])
        return known[0]

    def _signed(self, number: str) -> str:
        mac = hmac.new(self._page_key, number.encode(errors="replace"), hashlib.sha256)
        return f"{number}.{mac.hexdigest()}"

    def _standing_token_is(self, token: str) -> bool:
        return self._standing_token is not None and _same(self._standing_token, token)


def is_csrf_of(visitor: Visitor, token: str) -> bool:
    """Tell whether a command carries what only the visitor's own pages can read."""
    return _same(visitor.csrf, token)


def _same(left: str, right: str) -> bool:
    return hmac.compare_digest(left.encode(), right.encode(errors="replace"))
