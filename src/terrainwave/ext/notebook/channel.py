"""Protocol between the map in a notebook and the kernel: messages, their limits, and answers.

A request is ``{"id": text, "what": text, ...}``. The kernel acknowledges it at once with ``{"id",
"taken": true}``, so that the page can distinguish a busy kernel from a slow file. The answer
follows, ``{"id", ...}`` with binary buffers, or ``{"id", "error": {"name", "message"}}``. Bytes are
read in threads, so a slow server does not block the cells of the notebook. (Some notebooks receive
requests in threads of their own, while a cell runs.)

Requests are not trusted: any script of the notebook's page can send messages.
"""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from terrainwave.arguments import in_one_line, shown
from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.errors import InvalidArgumentError, LimitExceededError

# js/notebook/widget.js keeps to the same limits.
MOST_BYTES = 8 << 20
MOST_RANGES = 64
# Pending requests: several views send four at a time each.
MOST_WAITING = 64
_LONGEST_ID = 80
_LONGEST_MESSAGE = 400
_N_THREADS = 4


class Answer(NamedTuple):
    """Answer to the page: the content of a message, and binary buffers."""

    content: dict[str, Any]
    buffers: list[bytes]


Question = dict[str, Any]
Send = Callable[[dict[str, Any], list[bytes]], None]
Answering = Callable[[Question], Answer]


class Channel:
    """Answers the requests of one widget's views.

    `send`: takes a message and its buffers; called from several threads.
    `in_threads`, `at_once`: handlers by kind of request, run in threads or before `take` returns.
    """

    def __init__(
        self, send: Send, in_threads: dict[str, Answering], at_once: dict[str, Answering]
    ) -> None:
        self._send = send
        self._in_threads, self._at_once = in_threads, at_once
        self._pool = ThreadPoolExecutor(_N_THREADS, thread_name_prefix="terrainwave-notebook")
        self._lock = threading.Lock()
        self._n_waiting = 0

    def take(self, content: object) -> None:
        """Answer one message of the page, now or from a thread; its content may be anything."""
        question = content if isinstance(content, dict) else {}
        asked, what = question.get("id"), question.get("what")
        if not isinstance(asked, str) or not 0 < len(asked) <= _LONGEST_ID:
            self._refuse(None, InvalidArgumentError("found a message without an id, expected one"))
            return
        known = [*self._in_threads, *self._at_once]
        if not isinstance(what, str) or what not in known:
            expected = ", ".join(known)
            self._refuse(
                asked, InvalidArgumentError(f"found `what` {shown(what)}, expected {expected}")
            )
            return
        if not self._begin():
            self._refuse(
                asked,
                LimitExceededError(f"more than {MOST_WAITING} questions wait: ask fewer at a time"),
            )
            return
        self._send({"id": asked, "taken": True}, [])
        if what in self._at_once:
            self._answer(asked, self._at_once[what], question)
        else:
            self._pool.submit(self._answer, asked, self._in_threads[what], question)

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _begin(self) -> bool:
        with self._lock:
            if self._n_waiting >= MOST_WAITING:
                return False
            self._n_waiting += 1
            return True

    def _answer(self, asked: str, answering: Answering, question: Question) -> None:
        try:
            content, buffers = answering(question)
            self._send({"id": asked, **content}, buffers)
        except Exception as error:  # noqa: BLE001  the page would wait for ever
            self._refuse(asked, error)
        finally:
            with self._lock:
                self._n_waiting -= 1

    def _refuse(self, asked: str | None, error: Exception) -> None:
        message = in_one_line(error)[:_LONGEST_MESSAGE] or type(error).__name__
        self._send({"id": asked, "error": {"name": type(error).__name__, "message": message}}, [])


def read_ranges(source: ByteSource, question: Question) -> Answer:
    """Return the bytes of ``ranges``, pairs of start and end, each as a buffer, within limits."""
    ranges = question.get("ranges")
    if not isinstance(ranges, list) or not ranges:
        raise InvalidArgumentError(f"found `ranges` {shown(ranges)}, expected a list of them")
    if len(ranges) > MOST_RANGES:
        raise LimitExceededError(f"{len(ranges)} ranges are more than {MOST_RANGES}")
    spans = [_checked_range(given, source.size) for given in ranges]
    n_bytes = sum(span.length for span in spans)
    if n_bytes > MOST_BYTES:
        raise LimitExceededError(f"{n_bytes} bytes are more than {MOST_BYTES} in one message")
    return Answer({}, source.read_many(spans))


def _checked_range(given: object, size: int) -> ByteRange:
    if isinstance(given, list) and [type(end) for end in given] == [int, int]:
        start, end = given
        if 0 <= start < end <= size:
            return ByteRange(start, end - start)
    raise InvalidArgumentError(
        f"found range {shown(given)}, expected [start, end], 0 <= start < end <= {size}"
    )
