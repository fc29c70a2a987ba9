"""Where one reply ends and the next begins in a stream that may hold noise, foreign and late bytes.

A piece is either a packet candidate, from W to CR, or a run of bytes that can belong to no packet. Whether a candidate
is the answer to a command is for commands.py to judge.
Source: manual 2.2, formats.
"""

from ldcnd.drivers.smartstep.packet import END, START


def piece_bytes(data: bytes, longest: int) -> int | None:
    """Return the length of the first piece of the stream, or None while its end has not come.

    A second W, or more than `longest` bytes without CR, ends what was no packet.

    Args:
        data: what has arrived, from the end of the last piece on.
        longest: no packet is longer than this.
    """
    if not data:
        return None
    if data[:1] != START:
        start = data.find(START)
        return len(data) if start < 0 else start
    end = data.find(END) + 1
    restart = data.find(START, 1)
    if restart > 0 and (end == 0 or restart < end):
        end = restart
    if end == 0:
        return longest if len(data) >= longest else None
    return min(end, longest)


class ReplyReader:
    """Cuts a stream into packet candidates; the cuts do not depend on how the stream arrives.

    Attributes:
        skipped: bytes so far that belonged to no candidate.
    """

    def __init__(self, longest: int) -> None:
        self.skipped = 0
        self._longest = longest
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Take further bytes and return the candidates, W to CR, that they complete."""
        self._buffer += data
        candidates = []
        while (length := piece_bytes(bytes(self._buffer), self._longest)) is not None:
            piece = bytes(self._buffer[:length])
            del self._buffer[:length]
            if piece[:1] == START and piece[-1:] == END:
                candidates.append(piece)
            else:
                self.skipped += length
        return candidates
