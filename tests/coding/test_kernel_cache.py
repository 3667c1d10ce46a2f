"""Are kernels found where they cannot be written, and kept where nobody else can?"""

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from numba import types
from numba.core import config
from strangers import (
    as_root_without_rights,
    as_stranger,
    forbid_writing,
    is_other_user,
    own_folder,
    visible_folder,
)

from terrainwave.coding import kernel_cache, kernel_places
from terrainwave.coding.jit import kernel
from terrainwave.errors import TerrainwaveWarning

PACKAGE = Path(__file__).parents[2] / "src" / "terrainwave"

pytestmark = [
    pytest.mark.large,  # plain Python keeps no kernels
    pytest.mark.skipif(sys.platform == "win32", reason="no modes of folders there"),
]

# Calls a kernel; says what was compiled, and what was told.
USE = """
import json, sys, warnings
import numpy as np
from numba.core import event
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    from terrainwave.coding import jit, kernel_places
    exec(sys.argv[2])
    from terrainwave.render.modes import regular
    with event.install_recorder("numba:compile") as recorder:
        regular.half_place(np.zeros((3, 3), sys.argv[1]), 2, 2)
names = [e.data["dispatcher"].py_func.__name__ for _, e in recorder.buffer if e.is_start]
place = regular.half_place._cache.place
print(json.dumps([names, [str(one.message) for one in told], place._asdict()]))
"""
BOTH = pytest.mark.parametrize(
    ("place", "by"),
    [
        ("beside", as_stranger),
        pytest.param("named", as_root_without_rights, marks=pytest.mark.full),
    ],
)


@pytest.fixture
def tmp_path():
    """A folder that strangers can look into."""
    with visible_folder() as folder:
        yield folder


@pytest.fixture(scope="module")
def installed():
    """A copy of the package that only this user can write, with no kernel."""
    ignored = shutil.ignore_patterns("__pycache__", "static", "reader")
    with visible_folder() as root:
        shutil.copytree(PACKAGE, root / "installed" / "terrainwave", ignore=ignored)
        yield root / "installed"


@pytest.fixture(scope="module")
def shipped(installed):
    """The same package with one kernel beside it, and a folder with that kernel, read-only."""
    root = installed.parent
    shutil.copytree(installed, root / "beside")
    assert used(root / "beside")[0] == ["half_place"]
    assert used(root / "beside", cache=root / "named")[0] == ["half_place"]
    forbid_writing(root / "named")
    forbid_writing(root / "beside")
    before = files_of(root / "beside") | files_of(root / "named")
    yield root
    assert files_of(root / "beside") | files_of(root / "named") == before


def used(package, *, cache=None, by=list, home=None, dtype="float64", first="", **settings):
    """Return what a new process compiled, what it was told and where its kernels are."""
    environment = {"PATH": os.environ["PATH"], "PYTHONDONTWRITEBYTECODE": "1"}
    environment |= {"PYTHONPATH": str(package), "HOME": "/nonexistent", **settings}
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    if home is not None:
        environment |= {"XDG_CACHE_HOME": str(home / "cache"), "TMPDIR": str(home)}
    done = subprocess.run(
        by([sys.executable, "-c", USE, dtype, first]),
        env=environment, cwd="/", capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def files_of(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.full
@BOTH
def test_kernels_are_read_where_they_cannot_be_written(shipped, tmp_path, place, by):
    home = own_folder(tmp_path / "home", by)
    cache = shipped / "named" if place == "named" else None
    compiled, told, _ = used(shipped / "beside", cache=cache, by=by, home=home)
    assert compiled == []
    assert told == []
    assert not list(home.rglob("*.nb?"))


@BOTH
def test_a_kernel_that_is_not_there_is_compiled_once_and_kept_for_the_user(
    shipped, tmp_path, place, by
):
    home = own_folder(tmp_path / "home", by)
    cache = shipped / "named" if place == "named" else None
    for expected in ["half_place"], []:
        options = {"cache": cache, "by": by, "home": home}
        compiled, told, where = used(shipped / "beside", dtype="float32", **options)
        assert compiled == expected
        assert told == []
        assert used(shipped / "beside", **options)[0] == []  # what is there still counts
    private = home / "cache" / "terrainwave" / "kernels"
    assert where["kept_in"] == str(private)
    assert str(shipped) in where["instead_of"]
    assert private.stat().st_mode & 0o777 == 0o700


@pytest.mark.full
@pytest.mark.parametrize("kind", ["writable", "link", "below others"])
def test_a_folder_that_others_can_write_is_never_used(shipped, tmp_path, kind):
    """Its entries are pickles, which run code; the next candidate is taken."""
    temporary, spare = own_folder(tmp_path / "temporary"), own_folder(tmp_path / "spare")
    number = temporary.stat().st_uid
    private = temporary / f"terrainwave-kernels-{number}"
    if kind == "link":
        own_folder(tmp_path / "elsewhere")
        private.symlink_to(tmp_path / "elsewhere")
    else:
        own_folder(private).chmod(0o777 if kind == "writable" else 0o700)
        if kind != "writable":
            temporary.chmod(0o777)
    _, told, where = used(
        shipped / "beside", dtype="float32", by=as_stranger, TMPDIR=str(temporary), TEMP=str(spare)
    )
    assert told == []
    assert where["kept_in"] == str(spare / f"terrainwave-kernels-{number}")
    assert not list(private.rglob("*.nb?"))


def test_a_folder_of_another_user_is_not_private_even_to_root(tmp_path):
    """Root can write it, and so can its owner."""
    assert kernel_places._is_private(str(own_folder(tmp_path / "own", list)))
    foreign = own_folder(tmp_path / "foreign") if is_other_user() else Path("/usr")
    assert not kernel_places._is_private(str(foreign))
    (tmp_path / "below").mkdir()
    below = tmp_path / "below" / "own"
    below.mkdir(mode=0o700)
    assert kernel_places._is_private(str(below))
    if is_other_user():
        os.chown(below.parent, foreign.stat().st_uid, -1)
        assert not kernel_places._is_private(str(below))
    below.parent.chmod(0o777)
    assert not kernel_places._is_private(str(below))


@pytest.mark.parametrize("name", kernel_cache._SETTINGS)
def test_each_setting_of_numba_that_changes_code_has_kernels_of_its_own(monkeypatch, name):
    @kernel
    def doubled(number):
        return 2 * number

    cache = doubled._cache
    (entries,) = cache._entries
    codegen = doubled.targetctx.codegen()
    signature = (types.float64,)
    before = entries._index_key(signature, codegen)
    assert entries._index_key(signature, codegen) == before
    monkeypatch.setattr(config, name, "another")
    assert entries._index_key(signature, codegen) != before


@pytest.mark.full
def test_kernels_that_cannot_be_read_or_are_damaged_are_compiled_again(installed, tmp_path):
    cache = tmp_path / "cache"
    assert used(installed, cache=cache)[0] == ["half_place"]
    for pattern in ("*.nbi", "*.nbc"):
        for path in cache.rglob(pattern):
            path.write_bytes(path.read_bytes()[:40])
        assert used(installed, cache=cache)[:2] == [["half_place"], []]
        assert used(installed, cache=cache)[0] == []
    home = own_folder(tmp_path / "home", as_root_without_rights)
    for path in cache.rglob("*.nb?"):
        path.chmod(0)
    (folder,) = cache.iterdir()
    folder.chmod(0o555)
    options = {"cache": cache, "by": as_root_without_rights, "home": home}
    assert used(installed, **options)[:2] == [["half_place"], []]
    assert used(installed, **options)[0] == []


def test_two_processes_never_write_code_to_one_file(installed, tmp_path):
    cache = tmp_path / "cache"
    names = set()
    for settings in {}, {"NUMBA_BOUNDSCHECK": "1"}:
        assert used(installed, cache=cache, **settings)[0] == ["half_place"]
        found = {path.name for path in cache.rglob("*.nbc")}
        assert len(found - names) == 1
        names = found
        assert used(installed, cache=cache, **settings)[0] == []
    assert len({name.split("-")[-1] for name in names}) == 2


def test_code_gets_a_new_name_each_time_and_old_code_goes(monkeypatch, tmp_path):
    """Forked processes have all else in common."""

    @kernel
    def halved(number):
        return number / 2

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    assert halved(np.int64(5)) == 2.5
    (first,) = tmp_path.rglob("*.nbc")
    stale = first.with_name(first.name.replace(".1-", ".7-"))
    shutil.copy(first, stale)
    assert halved(np.float32(5)) == 2.5
    assert not stale.exists()
    names = [path.name.split("-")[-1] for path in tmp_path.rglob("*.nbc")]
    assert len(names) == len(set(names)) == 2


def test_a_place_that_numba_does_not_find_keeps_nothing(monkeypatch):
    @kernel
    def halved(number):
        return number / 2

    monkeypatch.setattr(config, "CACHE_LOCATOR_CLASSES", "numba.core.caching.IPythonCacheLocator")
    monkeypatch.setattr(kernel_places._State, "reason", "")
    monkeypatch.setattr(kernel_places._State, "n_lost", 0)
    with pytest.warns(TerrainwaveWarning, match="no locator available"):
        assert halved(np.int64(5)) == 2.5


def test_a_full_disk_does_not_stop_the_work(monkeypatch):
    @kernel
    def halved(number):
        return number / 2

    monkeypatch.setattr(
        halved._cache._entries[-1],
        "save_overload",
        Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))),
    )
    monkeypatch.setattr(kernel_places._State, "reason", "")
    monkeypatch.setattr(kernel_places._State, "n_lost", 0)
    with pytest.warns(TerrainwaveWarning, match="No space left on device"):
        assert halved(np.int64(5)) == 2.5
    assert kernel_places.kept()[1] == 1
