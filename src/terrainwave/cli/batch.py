"""Batches: one result for each file, several files at a time, continuing after failures."""

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click

from terrainwave import interrupts
from terrainwave.arguments import checked_path, checked_threads, count_of, path_in_url
from terrainwave.cli.output import (
    Bar,
    announce_compiling,
    line_of,
    plain,
    print_error,
    print_json_line,
    print_note,
)
from terrainwave.cli.streams import STREAM
from terrainwave.container.sources.addresses import display_name
from terrainwave.errors import InvalidArgumentError, TerrainwaveError
from terrainwave.progress import Progress, ProgressCallback

NAME = ".terrainwave-manifest.jsonl"
UNKNOWN = "no manifest says what it was made of"
_MOST_LINES = 100

# Takes source, target, and the difference found by the manifest; returns why the target is not what
# the command makes of the source, None if it is.
Compare = Callable[[str, str, str, ProgressCallback], str | None]


class Manifest:
    """Targets in a directory, and their sources.

    `compare` is for existing targets that the manifest does not confirm. Without `skips`, targets
    are only recorded.
    """

    def __init__(
        self,
        directory: str,
        asked: dict[str, Any],
        *,
        files_of: Callable[[str], list[str]],
        compare: Compare,
        skips: bool = True,
    ) -> None:
        self._path = Path(directory) / NAME
        self._asked = json.loads(json.dumps(asked, default=str))
        self._files_of = files_of
        self._compare = compare
        self._skips = skips
        self._lock = threading.Lock()
        self._entries = _read_entries(self._path) if skips else {}

    @contextmanager
    def checked(self, source: str, target: str, progress: ProgressCallback) -> Iterator[str | None]:
        """Yield why a target has to be made again ("" if it is new); None if it is up to date.

        The target is recorded when the block ends without an exception.
        """
        # Taken before the source is read, so that the next run notices changes made meanwhile.
        sources = self._source_states(source)
        name = os.path.relpath(target, self._path.parent).replace(os.sep, "/")
        before = self._entries.get(name)
        entry = {"target": name, "asked": self._asked, "sources": sources}
        difference: str | None = ""
        if self._skips and os.path.exists(target):
            known = _difference(before, entry | {"state": _state(target)})
            difference = known and self._compare(source, target, known, progress)
        yield difference
        entry["state"] = _state(target)
        if sources is not None and entry != before:
            self._write(entry)

    def _source_states(self, source: str) -> list[list[Any]] | None:
        from terrainwave.errors import TerrainwaveError

        try:
            names = self._files_of(source)
            # Includes the time of change: copying tools copy the time of modification.
            return [
                [os.path.abspath(name), *_state(name), os.stat(name).st_ctime_ns] for name in names
            ] or None
        except (TerrainwaveError, OSError):  # reading reports it, or it is not a local file
            return None

    def _write(self, entry: dict[str, Any]) -> None:
        """Append a line; without it, the next run compares the files themselves."""
        # The line feed comes first: a truncated line spoils no other.
        line = "\n" + _line(entry)
        with self._lock:
            self._entries[entry["target"]] = entry
            with suppress(OSError), self._path.open("a", encoding="ascii") as file:
                file.write(line)


def _difference(before: dict[str, Any] | None, now: dict[str, Any]) -> str | None:
    if before is None:
        return UNKNOWN
    if before.get("asked") != now["asked"]:
        return "it was made with other options"
    if now["sources"] is None or before.get("sources") != now["sources"]:
        return "its source has changed"
    return None if before.get("state") == now["state"] else "it has changed since it was made"


def _state(path: str) -> list[int]:
    found = os.stat(path)
    return [found.st_size, found.st_mtime_ns]


def _read_entries(path: Path) -> dict[str, dict[str, Any]]:
    entries: dict[str, dict[str, Any]] = {}
    try:
        lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return entries
    for line in filter(None, lines):
        with suppress(ValueError, RecursionError):
            entry = json.loads(line)
            if isinstance(entry, dict) and isinstance(entry.get("target"), str):
                entries[entry["target"]] = entry
    if len(lines) > _MOST_LINES + 4 * len(entries):
        _shorten(path, entries)
    return entries


def _shorten(path: Path, entries: dict[str, dict[str, Any]]) -> None:
    """Keep one line per target. Targets that another run adds meanwhile are compared again."""
    from terrainwave.container.targets.publication import publish
    from terrainwave.errors import StorageError

    with suppress(StorageError), publish(path, overwrite=True) as part:
        part.file.write("\n".join(map(_line, entries.values())).encode("ascii"))


def _line(entry: dict[str, Any]) -> str:
    return json.dumps(entry, ensure_ascii=True, sort_keys=True)


@dataclass(frozen=True)
class FileJob:
    """A source, and the file to write or to compare it with, if any."""

    source: str
    target: str | None = None


@dataclass(frozen=True)
class Done:
    """Result of one job, as a line of text and for JSON."""

    line: str
    fields: dict[str, Any] = field(default_factory=dict)
    is_good: bool = True


@dataclass(frozen=True)
class _Outcome:
    job: FileJob
    seconds: float
    done: Done | None = None
    error: Exception | None = None

    @property
    def name(self) -> str:
        return plain(display_name(self.job.source))

    @property
    def message(self) -> str:
        assert self.error is not None
        text = line_of(self.error, advice="--threads 1")
        return text if self.name in text else f"{self.name}: {text}"

    def to_dict(self, word: str) -> dict[str, Any]:
        named = {
            "source": display_name(self.job.source),
            "target": self.job.target,
            "seconds": round(self.seconds, 3),
        }
        if self.error is not None:
            error_class = type(self.error).__name__
            return named | {
                "status": "failed", "error": self.message, "error_class": error_class,
            }  # fmt: skip
        if self.done is None:
            return named | {"status": "skipped"}
        return named | {"status": word if self.done.is_good else "failed"} | self.done.fields


Work = Callable[[FileJob, int, ProgressCallback], Done]


# Endings of rasters that are searched in folders; others must be named.
RASTER_ENDINGS = (
    ".tif", ".tiff", ".vrt", ".img", ".hgt", ".asc", ".dem", ".bil", ".flt", ".nc", ".dt0",
    ".dt1", ".dt2", ".twz",
)  # fmt: skip
# Rasters that are folders in GDAL's formats.
_FOLDERS_THAT_ARE_RASTERS = (".zarr", ".gdb")


def plan(
    sources: Sequence[str], directory: str, ending: str, endings: Sequence[str] = RASTER_ENDINGS
) -> list[FileJob]:
    """Return a job for each source; its target has the same name with `ending`.

    A folder means all files below it that end in one of `endings`; their targets lie in folders of
    the same names. Hidden files and files below `directory` are left out.
    """
    jobs: dict[str, FileJob] = {}
    if STREAM in sources:
        raise click.UsageError(
            "found - and --to, expected names of files: targets get their names from them"
        )
    for source, folder in with_files_of_folders(sources, endings, directory):
        stem = Path(path_in_url(source)).stem
        job = FileJob(source, os.path.join(directory, folder, stem + ending))
        other = jobs.setdefault(os.path.join(folder, stem).casefold(), job)
        if other is not job:
            raise click.UsageError(
                f"found {display_name(other.source)} and {display_name(source)}, which would both"
                f" be {job.target}; expected names that differ"
            )
    return list(jobs.values())


def with_files_of_folders(
    sources: Sequence[str], endings: Sequence[str], directory: str | None = None
) -> Iterator[tuple[str, str]]:
    """Yield files, and those in folders with one of `endings`, each with its relative folder."""
    for source in sources:
        checked_path(source)
        if not os.path.isdir(source) or source.lower().endswith(_FOLDERS_THAT_ARE_RASTERS):
            yield source, ""
            continue
        found = list(_files_below(source, directory, endings))
        if not found:
            raise click.UsageError(
                f"found no file in {source} that ends in {', '.join(endings)}; expected one, or"
                " the names of the files themselves"
            )
        yield from found


def _files_below(
    source: str, directory: str | None, endings: Sequence[str]
) -> Iterator[tuple[str, str]]:
    target = None if directory is None else os.path.realpath(directory)
    for path, folders, names in os.walk(source):
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and os.path.realpath(os.path.join(path, name)) != target
        )
        for name in sorted(names):
            if name.lower().endswith(tuple(endings)) and not name.startswith("."):
                folder = os.path.relpath(path, source)
                yield os.path.join(path, name), "" if folder == os.curdir else folder


@contextmanager
def made(directories: Iterable[str]) -> Iterator[None]:
    missing = set[Path]()
    try:
        for directory in directories:
            path = Path(directory).absolute()
            missing |= {part for part in (path, *path.parents) if not part.exists()}
            path.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for part in sorted(missing, reverse=True):
            with suppress(OSError):  # in use
                part.rmdir()


def run(
    jobs: Sequence[FileJob],
    work: Work,
    *,
    word: str,
    threads: int | None,
    as_json: bool,
    quiet: bool,
    manifest: Manifest | None = None,
) -> int:
    """Do the jobs, print the result of each and a summary; return the exit status.

    With `as_json`, stdout gets a line of JSON for each file as soon as it is done. Up to `threads`
    jobs run at a time and share the threads.
    """
    n_threads = checked_threads(threads)
    n_at_once = min(len(jobs), n_threads)
    is_stopped = threading.Event()

    def go_on(_: object = None) -> None:
        if is_stopped.is_set() or interrupts.is_requested():
            raise KeyboardInterrupt

    def attempt(job: FileJob) -> Done | None:
        if manifest is None:
            return work(job, n_threads // n_at_once, go_on)
        with manifest.checked(job.source, str(job.target), go_on) as difference:
            if difference is None:
                return None
            if difference:
                print_note(f"{job.target} is made again: {difference}")
            return work(job, n_threads // n_at_once, go_on)

    def outcome_of(job: FileJob) -> _Outcome:
        go_on()
        start = time.monotonic()
        try:
            done = attempt(job)
        except Exception as error:  # noqa: BLE001  one file of many: the others go on
            return _Outcome(job, time.monotonic() - start, error=error)
        return _Outcome(job, time.monotonic() - start, done)

    outcomes: dict[FileJob, _Outcome] = {}
    is_silent = quiet or as_json
    with Bar(quiet=is_silent) as bar, ThreadPoolExecutor(n_at_once) as executor:
        try:
            for future in as_completed([executor.submit(outcome_of, job) for job in jobs]):
                interrupts.check()
                outcome = future.result()
                outcomes[outcome.job] = outcome
                _tell(outcome, bar, quiet=is_silent)
                if as_json:
                    print_json_line(outcome.to_dict(word))
                bar(Progress(f"files {word}", len(outcomes), len(jobs)))
        except BaseException:
            # Running jobs end at their next report of progress, and leave nothing.
            is_stopped.set()
            executor.shutdown(wait=False, cancel_futures=True)
            raise
    in_order = [outcomes[job] for job in jobs]
    if not is_silent:
        click.echo(_summary(in_order, word))
    return _status(in_order)


def run_to(
    sources: tuple[str, ...],
    directory: str,
    ending: str,
    work: Work,
    word: str,
    *,
    endings: Sequence[str] = RASTER_ENDINGS,
    manifest: Manifest | None,
    threads: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    if not sources:
        raise click.UsageError("Missing argument 'SOURCE'.")
    jobs = plan(sources, directory, ending, endings)
    announce_compiling(quiet=quiet)
    with made({os.path.dirname(str(job.target)) for job in jobs}):
        status = run(
            jobs, work, word=word, threads=threads, as_json=as_json, quiet=quiet,
            manifest=manifest,
        )  # fmt: skip
    finish(status)


def _tell(outcome: _Outcome, bar: Bar, *, quiet: bool) -> None:
    if outcome.error is not None:
        print_error(outcome.message, outcome.error)
    elif not quiet:
        bar.echo(f"{outcome.name}: {plain(outcome.job.target)} exists already, skipped"
                 if outcome.done is None else outcome.done.line)  # fmt: skip


def _summary(outcomes: Sequence[_Outcome], word: str) -> str:
    n_skipped = sum(outcome.done is None and outcome.error is None for outcome in outcomes)
    n_failed = sum(_has_failed(outcome) for outcome in outcomes)
    n_good = len(outcomes) - n_skipped - n_failed
    parts = [f"{n_good:,} {word}"]
    parts += [f"{n_skipped:,} skipped"] * bool(n_skipped)
    parts += [f"{n_failed:,} failed"] * bool(n_failed)
    return f"{count_of(len(outcomes), 'file')}: {', '.join(parts)}"


def _has_failed(outcome: _Outcome) -> bool:
    return outcome.error is not None or (outcome.done is not None and not outcome.done.is_good)


def _status(outcomes: Sequence[_Outcome]) -> int:
    if all(isinstance(outcome.error, InvalidArgumentError) for outcome in outcomes):
        return 2
    return int(any(map(_has_failed, outcomes)))


def find_original(file: str, directory: Path) -> str:
    from terrainwave.errors import StorageError

    stem = Path(file).stem
    found = sorted(str(path) for path in directory.glob("*") if path.stem == stem)
    rasters = [path for path in found if not path.lower().endswith(_NO_RASTERS)]
    if len(rasters) != 1:
        names = ", ".join(rasters) or f"no raster {stem}"
        raise StorageError(f"{file}: found {names} in {directory}, expected one, as {stem}.tif")
    return rasters[0]


_NO_RASTERS = (".twz", ".json", ".xml", ".txt", ".prj", ".tfw")


def refuse_unknown_raster(target: str) -> None:
    from terrainwave.errors import StorageError
    from terrainwave.raster_io.dataset import open_dataset

    try:
        open_dataset(target).close()
    except TerrainwaveError:
        return
    raise StorageError(
        f"{target} already exists, and no manifest says what it was made of: the command leaves it"
        " as it is; to replace it, use `overwrite` instead of `skip_existing`"
    )


def refuse_options_of_batches(to: str | None, *, skip_existing: bool, overwrite: bool) -> None:
    if skip_existing and to is None:
        raise click.UsageError("found --skip-existing without --to, expected both")
    if skip_existing and overwrite:
        raise click.UsageError("found --skip-existing and --overwrite, expected one of them")


def finish(status: int) -> None:
    if status:
        sys.exit(status)
