"""Atomic publication: the target is absent, old or complete, whatever happens."""

import errno
import os
import signal
import subprocess
import sys
import textwrap
from unittest.mock import Mock

import pytest
from commands import environment, python
from container.toys import toy_header, toy_spools
from containers import open_container

from terrainwave.container.targets import publication as publish_module
from terrainwave.container.targets.publication import publish, remove_stale_parts, scratch_directory
from terrainwave.container.writer import assemble
from terrainwave.errors import StorageError

OLD = b"the old file"


@pytest.fixture(params=["absent", "old"])
def target(request, tmp_path):
    path = tmp_path / "a.twz"
    if request.param == "old":
        path.write_bytes(OLD)
    return path


def state(target):
    return target.read_bytes() if target.exists() else None


def others(target):
    """Return the names of all other files in the directory."""
    return sorted(path.name for path in target.parent.iterdir() if path != target)


def test_the_file_appears_when_the_block_ends(target):
    before = state(target)
    with publish(target, overwrite=True) as part:
        part.file.write(b"new")
        assert state(target) == before
        assert part.path.parent == target.parent
    assert target.read_bytes() == b"new"
    assert others(target) == []


def test_the_part_can_be_read_by_its_path_before_it_is_published(target, tmp_path):
    header = toy_header(300, 300)
    with publish(target, overwrite=True) as part:
        assemble(part.file, header, toy_spools(header.grid, tmp_path))
        with open_container(part.path) as container:
            assert list(container.check()) == []
    with open_container(target) as container:
        assert container.header == header


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit, StorageError])
def test_an_exception_leaves_the_target_and_removes_the_part(target, error):
    before = state(target)

    def stop_halfway():
        with publish(target, overwrite=True) as part:
            part.file.write(b"half")
            raise error("stop")

    with pytest.raises(error, match="stop"):
        stop_halfway()
    assert state(target) == before
    assert others(target) == []


def test_ctrl_c_while_the_part_is_locked_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "terrainwave.container.targets.publication._try_lock",
        Mock(side_effect=KeyboardInterrupt),
    )
    with pytest.raises(KeyboardInterrupt), publish(tmp_path / "a.twz"):
        pytest.fail("the block must not run")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_target_is_refused_before_the_block(tmp_path):
    target = tmp_path / "a.twz"
    target.write_bytes(OLD)
    with pytest.raises(StorageError, match="already exists"):
        with publish(target):
            pytest.fail("the block must not run")
    assert target.read_bytes() == OLD
    assert others(target) == []


def test_a_target_that_appears_meanwhile_is_not_replaced(tmp_path):
    target = tmp_path / "a.twz"

    def overtaken():
        with publish(target) as part:
            part.file.write(b"new")
            target.write_bytes(OLD)

    with pytest.raises(StorageError, match="already exists"):
        overtaken()
    assert target.read_bytes() == OLD
    assert others(target) == []


@pytest.mark.parametrize(
    ("name", "message"),
    [("no/such/a.twz", "no directory"), ("", "not a regular file"), ("x" * 300, "too long")],
)
def test_a_target_that_cannot_be_is_refused_before_the_block(tmp_path, name, message):
    with pytest.raises(StorageError, match=message):
        with publish(tmp_path / name, overwrite=True):
            pytest.fail("the block must not run")
    assert list(tmp_path.iterdir()) == []


def test_a_new_file_has_the_usual_permissions_and_an_old_one_keeps_its_own(tmp_path):
    usual, new, old = tmp_path / "usual", tmp_path / "new.twz", tmp_path / "old.twz"
    usual.touch()
    old.touch()
    old.chmod(0o640)
    for target in (new, old):
        with publish(target, overwrite=True):
            pass
    assert new.stat().st_mode == usual.stat().st_mode
    assert old.stat().st_mode & 0o777 == 0o640


def test_a_symbolic_link_is_followed(tmp_path):
    (tmp_path / "real").mkdir()
    real, link = tmp_path / "real" / "a.twz", tmp_path / "link.twz"
    real.write_bytes(OLD)
    link.symlink_to(real)
    with publish(link, overwrite=True) as part:
        part.file.write(b"new")
    assert link.is_symlink()
    assert real.read_bytes() == b"new"


OF_GDAL = ["a.twz.aux.xml", "a.twz.msk", "a.twz.ovr"]


def test_what_gdal_kept_of_an_earlier_raster_goes_and_other_neighbours_stay(target):
    for name in (*OF_GDAL, "a.twz.json", "b.twz.aux.xml"):
        target.with_name(name).write_bytes(OLD)
    with publish(target, overwrite=True) as part:
        part.file.write(b"new")
        assert set(OF_GDAL) < set(others(target))
    assert others(target) == ["a.twz.json", "b.twz.aux.xml"]


class FullDisk:
    """A file on a disk with room for `room` bytes."""

    name = "a.twz"

    def __init__(self, file, room):
        self.file, self.room = file, room

    def write(self, data):
        self.room -= len(data)
        if self.room < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self.file.write(data)

    def flush(self):
        self.file.flush()


@pytest.mark.parametrize("room", [0, 200, 1000])
def test_a_full_disk_is_one_clear_line_and_no_file(target, tmp_path, room):
    before = state(target)
    header = toy_header(300, 300)
    spools = toy_spools(header.grid, tmp_path)
    with pytest.raises(StorageError, match=r"^cannot write a\.twz: the disk is full$"):
        with publish(target, overwrite=True) as part:
            assemble(FullDisk(part.file, room), header, spools)
    assert state(target) == before
    assert others(target) == []


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_disk_that_is_full_at_the_end_leaves_the_target(target, monkeypatch, call):
    before = state(target)

    monkeypatch.setattr(
        publish_module.os, call, Mock(side_effect=OSError(errno.ENOSPC, "no space"))
    )
    with pytest.raises(StorageError, match="the disk is full"):
        with publish(target, overwrite=True) as part:
            part.file.write(b"new")
    monkeypatch.undo()
    assert state(target) == before
    assert others(target) == []


def test_a_file_held_open_for_a_moment_is_replaced_later(target, monkeypatch):
    calls = []

    def replace(source, destination):
        calls.append(source)
        if len(calls) < 3:
            raise PermissionError(errno.EACCES, "in use")
        os.rename(source, destination)

    monkeypatch.setattr(publish_module.os, "replace", replace)
    monkeypatch.setattr(publish_module, "_ON_WINDOWS", True)
    monkeypatch.setattr(publish_module.time, "sleep", lambda seconds: None)
    with publish(target, overwrite=True) as part:
        part.file.write(b"new")
    assert len(calls) == 3
    assert target.read_bytes() == b"new"


@pytest.mark.parametrize("error", [errno.EWOULDBLOCK, errno.ENOLCK])
def test_a_part_whose_lock_is_held_or_cannot_be_tried_stays(target, monkeypatch, error):
    part = target.parent / f".{target.name}.0123456789abcdef.twz-part"
    part.touch()

    monkeypatch.setattr(
        publish_module.fcntl, "flock", Mock(side_effect=OSError(error, os.strerror(error)))
    )
    assert remove_stale_parts(target) == []
    assert others(target) == [part.name]


def test_a_file_system_without_locks_can_be_written(target, monkeypatch):
    monkeypatch.setattr(
        publish_module.fcntl, "flock", Mock(side_effect=OSError(errno.ENOLCK, "no locks"))
    )
    with publish(target, overwrite=True) as part:
        part.file.write(b"new")
    assert target.read_bytes() == b"new"


class FakeMsvcrt:
    """What Windows' locking does, on a set of locked positions."""

    LK_NBLCK = 2

    def __init__(self):
        self.locked = set()

    def locking(self, handle, mode, n_bytes):
        assert (mode, n_bytes) == (self.LK_NBLCK, 1)
        place = os.fstat(handle).st_ino, os.lseek(handle, 0, os.SEEK_CUR)
        if place in self.locked:
            raise PermissionError(errno.EACCES, "locked")
        self.locked.add(place)


def test_windows_locks_lie_far_behind_the_content(target, monkeypatch):
    fake = FakeMsvcrt()
    monkeypatch.setattr(publish_module, "fcntl", None)
    monkeypatch.setattr(publish_module, "msvcrt", fake)
    with publish(target, overwrite=True) as part:
        part.file.write(b"new")
        assert {position for _, position in fake.locked} == {2**40}
        assert remove_stale_parts(target) == []
    assert target.read_bytes() == b"new"
    assert others(target) == []


PUBLISH = """
    import sys, time
    from terrainwave.container.targets.publication import publish
    with publish(sys.argv[1], overwrite=True) as part:
        part.file.write(b"half")
        part.file.flush()
        print("ready", flush=True)
        time.sleep(600)
"""
SCRATCH = """
    import sys, time
    from terrainwave.container.targets.publication import scratch_directory
    with scratch_directory(sys.argv[1], "a.twz") as path:
        (path / "big").write_bytes(b"spool")
        print("ready", flush=True)
        time.sleep(600)
"""


def start(script, argument):
    """Start a process that waits in the middle of `script`; return it."""
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script), str(argument)],
        stdout=subprocess.PIPE,
        env=environment(),
    )
    assert process.stdout.readline().strip() == b"ready"
    return process


@pytest.mark.parametrize("how", ["kill", "terminate"])
def test_what_a_killed_run_leaves_is_removed_by_the_next(target, how):
    before = state(target)
    process = start(PUBLISH, target)
    try:
        (left_over,) = others(target)
        assert left_over.startswith(".a.twz.")
        assert left_over.endswith(".twz-part")
        # Alive: a second run leaves the part of the first alone.
        assert remove_stale_parts(target) == []
        with publish(target, overwrite=True) as part:
            part.file.write(b"second")
        assert others(target) == [left_over]
        assert target.read_bytes() == b"second"
    finally:
        getattr(process, how)()
        process.wait()
        process.stdout.close()
    assert process.returncode == -(signal.SIGKILL if how == "kill" else signal.SIGTERM)
    assert others(target) == [left_over]
    with publish(target, overwrite=True) as part:
        part.file.write(b"third")
    assert others(target) == []
    assert target.read_bytes() == b"third"
    assert before in (None, OLD)


def test_files_of_other_targets_are_left_alone(tmp_path):
    target = tmp_path / "a"
    names = [
        ".a.b.0123456789abcdef.twz-part",
        ".ab.0123456789abcdef.twz-part",
        ".a.mine.twz-part",
        ".a..twz-part",
        "a.0123456789abcdef.twz-part",
        ".a.0123456789abcdef.part",
        ".a.twz-part",
    ]
    for name in names:
        (tmp_path / name).touch()
    stale = tmp_path / ".a.0123456789abcdef.twz-part"
    stale.touch()
    assert remove_stale_parts(target) == [stale]
    assert others(target) == sorted(names)


def test_a_part_taken_away_before_its_lock_is_made_again(target, monkeypatch):
    taken = []
    try_lock = publish_module._try_lock

    def lock_too_late(file):
        (part,) = (path for path in target.parent.iterdir() if path != target)
        if not taken:
            part.unlink()
        taken.append(part)
        return try_lock(file)

    monkeypatch.setattr(publish_module, "_try_lock", lock_too_late)
    with publish(target, overwrite=True) as part:
        part.file.write(b"new")
    assert len(taken) == 2
    assert target.read_bytes() == b"new"


def test_a_scratch_directory_is_removed_at_the_end(tmp_path):
    with scratch_directory(tmp_path, "a.twz") as path:
        assert path.parent == tmp_path
        (path / "b").mkdir()
        (path / "b" / "c").write_bytes(b"x")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="stop"), scratch_directory(tmp_path, "a.twz"):
        raise ValueError("stop")
    assert list(tmp_path.iterdir()) == []


def test_a_killed_runs_scratch_directory_is_removed_by_the_next(tmp_path):
    process = start(SCRATCH, tmp_path)
    try:
        left_over, lock = sorted(tmp_path.iterdir(), key=lambda path: path.is_file())
        with scratch_directory(tmp_path, "a.twz"), scratch_directory(tmp_path, "b.twz"):
            assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 3
        assert (left_over / "big").exists()
        assert lock.exists()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    with scratch_directory(tmp_path, "b.twz"):
        assert left_over.exists()
    with scratch_directory(tmp_path, "a.twz") as path:
        assert [found for found in tmp_path.iterdir() if found.is_dir()] == [path]
    assert list(tmp_path.iterdir()) == []


# Forks that kill themselves before their first, second, … file operation in a folder, until one
# gets by; after each, a run to the end must leave the folder as it was.
KILLED_EVERYWHERE = """
    import os, signal, sys
    from pathlib import Path
    from terrainwave.container.targets.publication import {used} as used
    folder = Path(sys.argv[1])

    def use():
        with used({arguments}) as made:
            path = getattr(made, "path", made)
            if path.is_dir():
                (path / "big").write_bytes(b"spool")
            else:  # as GDAL makes overviews
                path.with_name(path.name + ".ovr.tmp").write_bytes(b"overviews")
                path.with_name(path.name + ".ovr.tmp").unlink()

    def die_before(number):
        def hook(event, arguments):
            nonlocal number
            if event in ("open", "os.mkdir", "os.remove", "os.rmdir", "os.rename"):
                number -= 1
                if number < 0:
                    os.kill(os.getpid(), signal.SIGKILL)
        sys.addaudithook(hook)

    status = number = 0
    while True:
        child = os.fork()
        if child == 0:
            die_before(number)
            use()
            os._exit(0)
        if os.waitpid(child, 0)[1] == 0:
            break
        use()
        left = sorted(set(os.listdir(folder)) - {{"a.twz"}})
        assert left == [], (number, left)
        number += 1
    assert number > 5, number
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.parametrize(
    ("used", "arguments"),
    [("scratch_directory", "folder, 'a.twz'"), ("publish", "folder / 'a.twz', overwrite=True")],
)
def test_what_a_kill_before_any_file_operation_leaves_is_removed_by_the_next_run(
    tmp_path, used, arguments
):
    script = textwrap.dedent(KILLED_EVERYWHERE.format(used=used, arguments=arguments))
    python(script, tmp_path, check=True, capture_output=False)


def test_a_scratch_directory_in_a_missing_place_is_a_storage_error(tmp_path):
    with (
        pytest.raises(StorageError, match="temporary directory"),
        scratch_directory(tmp_path / "missing", "a.twz"),
    ):
        pytest.fail("the block must not run")
