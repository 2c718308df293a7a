"""Cutting a byte stream into lines or JSON objects, and holding back who sends too much.

What comes out does not depend on how the stream was cut into chunks, and what is held is bounded.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Final

from ssm_graph.base.errors import ConfigError

MAX_LENGTH: Final = 64 * 1024
"""Bytes of a line or an object."""
MAX_DEPTH: Final = 32
_TOKEN = re.compile(rb'\\[^\n]|\n\{|["{}\n]')
_BETWEEN = b"[], \t\r\n"
_LINE_END = re.compile(rb"[\r\n]|(?<=\*[0-9A-Fa-f]{2})(?=\$)")
_TOO_LONG: Final = (
    "expected lines of at most {} bytes, got a longer one; is the port another instrument's?"
)


class LineFramer:
    """Lines of UTF-8 text; one that is too long or not UTF-8 is dropped and told to ``refuse``."""

    def __init__(self, refuse: Callable[[str], None], *, max_length: int = MAX_LENGTH) -> None:
        self._refuse, self._max_length = refuse, max_length
        self._rest, self._is_skipping = bytearray(), False

    @property
    def n_held(self) -> int:
        """Bytes of the unfinished line, at most ``max_length``."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[str]:
        """Return the lines that end in ``data``, without line ends and space around, not empty."""
        *ended, rest = data.split(b"\n")
        lines = []
        for part in ended:
            self._extend(part)
            lines.append("" if self._is_skipping else _text(bytes(self._rest), self._refuse))
            self._rest.clear()
            self._is_skipping = False
        self._extend(rest)
        return [line for line in lines if line]

    def _extend(self, part: bytes) -> None:
        if self._is_skipping:
            return
        if len(self._rest) + len(part) > self._max_length:
            self._refuse(_TOO_LONG.format(self._max_length))
            self._rest.clear()
            self._is_skipping = True
        else:
            self._rest += part


class SentenceFramer:
    """Lines that end in CR, LF or both, one character a byte, whatever the bytes are.

    A checksum ends a sentence, too, where the next begins: line ends may have been lost.

    What is longer than ``max_length`` is cut before its last ``$``: binary frames may stand before
    a sentence. Text that is longer is dropped, up to the next ``$``, and told to ``refuse``.
    """

    def __init__(self, refuse: Callable[[str], None], *, max_length: int) -> None:
        self._refuse, self._max_length = refuse, max_length
        self._rest, self._is_skipping = b"", False

    @property
    def n_held(self) -> int:
        """Bytes of the unfinished line, at most ``max_length``."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[str]:
        """Return the lines that end in ``data``, without space around, not empty."""
        *ended, rest = _LINE_END.split(self._rest + data)
        texts: list[bytes] = []
        for part in ended:
            texts.append(self._cut(part, texts))
            self._is_skipping = False
        self._rest = self._cut(rest, texts)
        return [text.decode("latin-1") for text in map(bytes.strip, texts) if text]

    def _cut(self, line: bytes, texts: list[bytes]) -> bytes:
        """Return what is left of a line, short enough; put what stands before among the texts."""
        while self._is_skipping or len(line) > self._max_length:
            head = line[: self._max_length]
            begin = head.rfind(b"$")
            if self._is_skipping or (begin <= 0 and head.isascii() and head.decode().isprintable()):
                if not self._is_skipping:
                    self._refuse(_TOO_LONG.format(self._max_length))
                begin = line.find(b"$", 0 if self._is_skipping else 1)
                self._is_skipping = begin < 0
                line = line[begin:] if begin >= 0 else b""
                if self._is_skipping:
                    return b""
            else:
                end = begin if begin > 0 else self._max_length
                texts.append(line[:end])
                line = line[end:]
        return line


class ObjectFramer:
    """JSON objects back to back, one a line, spread over lines, or as the items of a list.

    Brackets, commas and space between objects are skipped. An object that will never end does not
    swallow the next: a brace at the very begin of a line begins anew, and so does what follows a
    line break within quotes, which JSON does not allow.
    """

    def __init__(self, refuse: Callable[[str], None], *, max_length: int = MAX_LENGTH) -> None:
        self._refuse, self._max_length = refuse, max_length
        self._rest, self._start, self._scanned, self._depth = b"", 0, 0, 0
        self._is_quoted = self._is_skipping = False
        self._objects: list[str] = []

    @property
    def n_held(self) -> int:
        """Bytes of the unfinished object, at most ``max_length`` and the token at its end."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[str]:
        """Return the objects that end in ``data``."""
        text = self._rest + data
        limit = _complete_tokens(text, self._scanned)
        for token in _TOKEN.finditer(text, self._scanned, limit):
            self._step(text, token.group(), token.start(), token.end())
        if self._depth and limit - self._start > self._max_length:
            self._drop_long(limit)
        if not self._depth:
            self._leave_out(text[self._start : limit])
            self._start = limit
        self._rest = text[self._start :]
        self._scanned = limit - self._start
        self._start = 0
        objects, self._objects = self._objects, []
        return objects

    def _step(self, text: bytes, token: bytes, begin: int, end: int) -> None:
        """Take one token into account; an escaped character changes nothing."""
        if self._depth and begin - self._start >= self._max_length:
            self._drop_long(begin)
        if not self._depth or token == b"\n{":
            if token[-1:] == b"{" and token[:1] != b"\\":
                self._begin(text, end - 1)
        elif token == b'"':
            self._is_quoted = not self._is_quoted
        elif token == b"\n" and self._is_quoted:
            self._drop("expected a JSON object, got a line break within quotes", end)
        elif token == b"{" and not self._is_quoted:
            self._depth += 1
            if self._depth > MAX_DEPTH:
                self._drop(f"expected at most {MAX_DEPTH} levels of nesting, got more", end)
        elif token == b"}" and not self._is_quoted:
            self._depth -= 1
            if not self._depth:
                self._objects += filter(None, [_text(text[self._start : end], self._refuse)])
                self._start = end

    def _begin(self, text: bytes, start: int) -> None:
        if self._depth:
            self._refuse("expected the end of a JSON object, got the begin of the next")
        else:
            self._leave_out(text[self._start : start])
        self._start, self._depth = start, 1
        self._is_quoted = self._is_skipping = False

    def _drop(self, why: str, start: int) -> None:
        """Forget the object; what is left of it is skipped without a word."""
        self._refuse(why)
        self._start, self._depth, self._is_skipping = start, 0, True

    def _drop_long(self, start: int) -> None:
        text = f"expected JSON objects of at most {self._max_length} bytes, got a longer one"
        self._drop(text, start)

    def _leave_out(self, between: bytes) -> None:
        if not self._is_skipping and between.strip(_BETWEEN):
            self._refuse(
                "expected JSON objects, got other bytes; is the port another instrument's?"
            )
            self._is_skipping = True


class TokenBucket:
    """Admits ``rate_per_s`` messages a second in the mean and ``burst`` at once."""

    def __init__(self, *, rate_per_s: float, burst: int) -> None:
        if not (math.isfinite(rate_per_s) and rate_per_s > 0.0 and burst >= 1):
            raise ConfigError(
                f"rate limit: expected a rate above 0 per second and a burst of 1 or more, "
                f"got {rate_per_s} and {burst}"
            )
        self.n_refused = 0
        """How many were refused so far."""
        self._rate_per_s, self._burst, self._tokens = rate_per_s, float(burst), float(burst)
        self._last_s: float | None = None

    def grant(self, span_s: float) -> None:
        """Admit at once, besides, what may come in such a time, s, in which nobody asked."""
        self._tokens += self._rate_per_s * span_s

    def catch_up(self) -> None:
        """Admit no more at once than ever: what came in that time has passed."""
        self._tokens = min(self._tokens, self._burst)

    def admit(self, now_s: float) -> bool:
        """Return whether one more message may pass at ``now_s``; a clock set back fills nothing."""
        if math.isfinite(now_s):
            elapsed_s = max(0.0, now_s - (now_s if self._last_s is None else self._last_s))
            filled = min(self._burst, self._tokens + elapsed_s * self._rate_per_s)
            self._tokens = max(self._tokens, filled)
            self._last_s = now_s
        if self._tokens < 1.0:
            self.n_refused += 1
            return False
        self._tokens -= 1.0
        return True


def _text(data: bytes, refuse: Callable[[str], None]) -> str:
    """Return the text of a line or object; empty where it is not UTF-8."""
    try:
        return data.decode("utf-8").strip()
    except UnicodeDecodeError as error:
        refuse(f"expected UTF-8 text, got byte 0x{data[error.start]:02x}; check the baud rate")
        return ""


def _complete_tokens(text: bytes, scanned: int) -> int:
    """Return where tokens may still change with the next bytes: an escape or a line break."""
    end = len(text)
    if text.endswith(b"\n"):
        return max(scanned, end - 1)
    run = end
    while run > scanned and text[run - 1] == 0x5C:
        run -= 1
    return end - (end - run) % 2
