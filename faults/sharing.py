"""Two writers of one target, forks of readers, many threads on one Terrain, and 10,000 opens."""

import gc
import os
import random
import signal
import threading
import time
import warnings
from collections import Counter, namedtuple
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

import terrainwave
from faults.commands import Command, Run
from faults.faulty_server import FaultyServer
from faults.kills import fresh, left_over, measured

# Pairs of runs, and runs that were refused. What lies at the target: what the first writes, or the
# second; of commands that change what is there, what one makes of the other's; or else.
Writers = namedtuple(
    "Writers", "command pairs failed first second both broken leftovers hangs crashes seconds"
)
# Windows read in forks, or by threads, and how many of them were not what the file has.
Readers = namedtuple("Readers", "what source trials windows wrong errors hangs seconds")
# What a process held before and after: files, threads, MB of memory.
Opens = namedtuple(
    "Opens",
    "source end opens wrong files_before files_after threads_before threads_after mb_before "
    "mb_after seconds",
)
N_THREADS = 64
_PATIENCE = 60  # seconds, after which a fork hangs
_SIDE = 100  # samples of a window, at most
_SMALL_SIDE = 40  # the same, where opening is what counts; more than a unit


def writers(commands: list[Command], work: Path, n: int, seed: int) -> Iterator[Writers]:
    """Let two runs of a command write one target, the second begun while the first writes.

    The second command is the same with another bound or source: its result is another.
    """
    generator = random.Random(seed)
    for plain in commands:
        one, _ = measured(plain, work)
        two, _ = measured(_another(plain), work)
        kinds = {one.expected: "first", two.expected: "second"}
        if plain.before:
            kinds |= {_one_after(pair, work): "both" for pair in ((one, two), (two, one))}
        found: Counter[str] = Counter()
        start = time.monotonic()
        for number in range(n):
            folder = fresh(work, one, one.starts[number % len(one.starts)])
            first = Run(one.arguments, folder)
            # Most begin at once, where the races are.
            time.sleep(generator.random() ** 3 * one.seconds)
            second = Run(two.arguments, folder, log="second log")
            both = first.wait(), second.wait()
            content = (folder / one.target).read_bytes()
            found[kinds.get(content, "broken")] += 1
            found["leftovers"] += bool(left_over(folder, work, one, {}))
            for ended in both:
                found["hangs"] += ended.status is None
                found["crashes"] += ended.is_crash
                found["failed"] += ended.status == 1
        numbers = [found[field] for field in Writers._fields[2:-1]]
        yield Writers(one.name, n, *numbers, round(time.monotonic() - start, 1))


def _one_after(pair: tuple[Command, Command], work: Path) -> bytes:
    """Return what lies at the target after one run and then the other."""
    folder = fresh(work, pair[0], pair[0].before)
    for command in pair:
        Run(command.arguments, folder).wait()
    return (folder / command.target).read_bytes()


def _another(command: Command) -> Command:
    """Return the command with a result of its own."""
    words = list(command.arguments)
    if "--max-error" in words:
        place = words.index("--max-error") + 1
        words[place] = str(2 * float(words[place]))
    elif command.name == "patch":
        words[2] = words[2].replace("part.tif", "other_part.tif")
    elif "--store" in words:
        words += ["--mesh-error", "7"]
    else:
        words += ["--level", "-2"]
    return replace(command, arguments=tuple(words))


# --- readers ---


class _Expected:
    """Random windows of a file and what it has there, by all of its levels read before."""

    def __init__(self, path: Path) -> None:
        with terrainwave.open(path) as terrain:
            n_levels = terrain.info().n_levels
            self.levels = [terrain.read(level=level) for level in range(n_levels)]

    def n_wrong(self, terrain: terrainwave.Terrain, n: int, seed: int, side: int = _SIDE) -> int:
        """Read `n` random windows at random levels; return how many are wrong."""
        generator = random.Random(seed)
        n_wrong = 0
        for _ in range(n):
            level = generator.choices(range(len(self.levels)), range(1, len(self.levels) + 1))[0]
            heights = self.levels[level]
            row, col = (generator.randrange(size) for size in heights.shape)
            window = row, col, generator.randrange(1, side), generator.randrange(1, side)
            found = terrain.read(window=window, level=level)
            n_wrong += not np.array_equal(
                found, heights[row : row + window[2], col : col + window[3]]
            )
        return n_wrong


def forks(path: Path, n: int, n_windows: int) -> Iterator[Readers]:
    """Fork after reading, and while threads read; parent and child read on."""
    expected = _Expected(path)
    content = path.read_bytes()
    with FaultyServer(content, content) as server:
        for source in (path, server.url):
            for what, n_threads in (("after reading", 0), ("while 8 threads read", 8)):
                yield _forked(what, source, expected, n, n_windows, n_threads)


def _forked(
    what: str, source: Path | str, expected: _Expected, n: int, n_windows: int, n_threads: int
) -> Readers:
    start, found = time.monotonic(), Counter[str]()
    warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads
    ends = threading.Event()
    # A small cache: windows are decoded, and fetched, again and again.
    with terrainwave.open(source, cache_bytes=1 << 20, threads=2) as terrain:

        def read_on(seed: int) -> None:
            while not ends.is_set():
                seed += n_threads
                _count(found, _seeded(expected, terrain, 1, seed), 1)

        _count(found, _seeded(expected, terrain, n_windows, 0), n_windows)
        threads = [threading.Thread(target=read_on, args=(k,)) for k in range(n_threads)]
        for thread in threads:
            thread.start()
        for number in range(n):
            status = _in_fork(_seeded(expected, terrain, n_windows, number))
            found["windows"] += n_windows
            found["hangs"] += status == -signal.SIGALRM
            found["errors"] += status == 255 or (status < 0 and status != -signal.SIGALRM)
            found["wrong"] += status if 0 < status < 255 else 0
            _count(found, _seeded(expected, terrain, 1, number), 1)
        ends.set()
        for thread in threads:
            thread.join(_PATIENCE)
            found["hangs"] += thread.is_alive()
    return _readers(f"fork {what}", source, n, found, start)


def _in_fork(work: Callable[[], int]) -> int:
    """Return what `work` returns in a fork; 255 for an error, below 0 for a signal."""
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_PATIENCE)
        status = 255
        try:
            status = min(work(), 254)
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _count(found: Counter, work: Callable[[], int], n_windows: int) -> None:
    try:
        found["wrong"] += work()
    except Exception:  # noqa: BLE001  any error is one
        found["errors"] += 1
    found["windows"] += n_windows


def _readers(what: str, source: Path | str, n: int, found: Counter, start: float) -> Readers:
    numbers = [found[field] for field in ("windows", "wrong", "errors", "hangs")]
    return Readers(what, _kind(source), n, *numbers, round(time.monotonic() - start, 1))


def _kind(source: Path | str | bytes) -> str:
    if isinstance(source, bytes):
        return "bytes"
    return "http" if isinstance(source, str) else "file"


def threads(path: Path, n_windows: int) -> Iterator[Readers]:
    """Let 64 threads read windows through one Terrain."""
    expected = _Expected(path)
    content = path.read_bytes()
    with FaultyServer(content, content) as server:
        for source in (path, content, server.url):
            start, found = time.monotonic(), Counter[str]()
            with (
                terrainwave.open(source, cache_bytes=1 << 20) as terrain,
                ThreadPoolExecutor(N_THREADS) as pool,
            ):
                for seed in range(N_THREADS):
                    work = _seeded(expected, terrain, n_windows, seed)
                    pool.submit(_count, found, work, n_windows)
            yield _readers(f"{N_THREADS} threads", source, N_THREADS, found, start)


def _seeded(
    expected: _Expected, terrain: terrainwave.Terrain, n: int, seed: int
) -> Callable[[], int]:
    return lambda: expected.n_wrong(terrain, n, seed)


# --- opens ---


def opens(path: Path, n: int, n_remote: int) -> Iterator[Opens]:
    """Open, read a window and close, or forget without closing; count what is held."""
    expected = _Expected(path)
    content = path.read_bytes()
    warnings.simplefilter("ignore", ResourceWarning)  # of what is forgotten
    with FaultyServer(content, content) as server:
        for source, times in ((path, n), (server.url, n_remote)):
            for end in ("closed", "forgotten"):
                yield _opened(source, end, expected, times)


def _opened(source: Path | str, end: str, expected: _Expected, n: int) -> Opens:
    n_wrong = _open_often(source, end, expected, range(max(n // 20, 1)))  # memory settles
    before, start = _held(), time.monotonic()
    n_wrong += _open_often(source, end, expected, range(n))
    seconds = round(time.monotonic() - start, 1)
    pairs = [number for pair in zip(before, _held()) for number in pair]
    return Opens(_kind(source), end, n, n_wrong, *pairs, seconds)


def _open_often(source: Path | str, end: str, expected: _Expected, seeds: range) -> int:
    n_wrong = 0
    for seed in seeds:
        terrain = terrainwave.open(source, threads=2)
        n_wrong += expected.n_wrong(terrain, 1, seed, side=_SMALL_SIDE)
        if end == "closed":
            terrain.close()
        del terrain
    return n_wrong


def _held() -> tuple[int, int, int]:
    """Return open files, threads and MB of memory of this process."""
    gc.collect()
    time.sleep(1)  # for threads that end, of the server too
    n_files, n_threads = (len(os.listdir(f"/proc/self/{what}")) for what in ("fd", "task"))
    resident = int(Path("/proc/self/statm").read_text().split()[1])
    return n_files, n_threads, resident * os.sysconf("SC_PAGE_SIZE") >> 20
