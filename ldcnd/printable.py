"""Untrusted text, made fit for an operator's terminal and for a log.

A control character can move the cursor, change the title or fill the clipboard of a reader; a formatting character
can make a text read otherwise than it is written. So commands that have any are refused, and what is printed shows them
as escapes.
"""

import re

_UNFIT = re.compile(
    # C0, DEL, C1
    "[\x00-\x1f\x7f-\x9f"
    # soft hyphen, Arabic letter mark, Mongolian vowel separator
    "\xad\u061c\u180e"
    # zero-width characters, marks, line and paragraph separators, embeddings, overrides, isolates
    "\u200b-\u200f\u2028-\u202e\u2060-\u206f"
    # byte order mark, interlinear annotation, lone surrogates, tags
    "\ufeff\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e007f]"
)


def is_printable(text: str) -> bool:
    """Tell whether a text has neither control nor formatting characters."""
    return _UNFIT.search(text) is None


def printable(text: str, *, keep: str = "") -> str:
    r"""Return a text with an escape such as `\x1b` or `\u202e` for each control or formatting character.

    Args:
        text: any text.
        keep: characters that stay, such as line feeds in a message of several lines.
    """
    if is_printable(text):
        return text
    return _UNFIT.sub(
        lambda found: found[0] if found[0] in keep else found[0].encode("unicode_escape").decode("ascii"), text
    )
