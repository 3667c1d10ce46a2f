"""Read capsules with nothing but a C compiler: python tools/check_capsule.py FILE ...

A raster is compressed first, losslessly. Each file's capsule is unpacked in an empty folder, into
which the compiler and what it needs are put: gcc, its linker, the C library and its headers. That
folder becomes the root of the file system (chroot): there the reader is built as the capsule's
README says, checks the file and prints its root, which must be that of the file. Needs Linux, and
the right to chroot or to make a user namespace.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import terrainwave
from terrainwave.capsule import write_capsule

COMPILER = "/usr/bin/cc"
PROGRAMS = ("cc1", "collect2", "as", "ld")
# What programs are linked with, and the linker's plugin.
FILES = (
    "crt1.o", "crti.o", "crtn.o", "crtbegin.o", "crtend.o", "crtbeginS.o", "crtendS.o", "Scrt1.o",
    "libc.so", "libc.so.6", "libc_nonshared.a", "libgcc.a", "libgcc_s.so", "libgcc_s.so.1",
    "liblto_plugin.so", "lto-wrapper",
)  # fmt: skip


def told(*command):
    """Return what a command prints."""
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def needed(folder):
    """Return what the compiler needs to build sources in a folder: names of files."""
    programs = [shutil.which(told(COMPILER, f"-print-prog-name={name}")) for name in PROGRAMS]
    files = [told(COMPILER, f"-print-file-name={name}") for name in FILES]
    found = {COMPILER, *programs, *files}
    for program in (COMPILER, *programs):
        found |= {word for word in told("ldd", program).split() if word.startswith("/")}
    for source in folder.glob("*.c"):
        headers = told(COMPILER, "-M", str(source)).replace("\\\n", " ").split()
        found |= {word for word in headers if word.startswith("/usr/")}
    return [name for name in found if os.path.isfile(name)]


def furnish(folder, names):
    """Put files into a folder, under the names that they have here."""
    for name in names:
        target = folder / os.path.normpath(name).lstrip("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(os.path.realpath(name), target)
    (folder / "tmp").mkdir(exist_ok=True)


def inside(folder, where, *command):
    """Run a command with a folder as root of the file system; return what it prints."""
    chroot = ["chroot", str(folder), *command]
    if os.geteuid():
        chroot = ["unshare", "--map-root-user", *chroot]
    done = subprocess.run(chroot, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{where}: {' '.join(command)}: {done.stderr.strip()}")
    return done.stdout.strip()


def check(path, folder):
    """Check the capsule of a file."""
    if not path.endswith(".twz"):
        raster, path = path, str(folder / f"{Path(path).stem}.twz")
        terrainwave.compress(raster, path)
    archive = folder / "capsule.zip"
    write_capsule(path, archive)
    with zipfile.ZipFile(archive) as capsule:
        capsule.extractall(folder / "root")
    archive.unlink()
    furnish(folder / "root", needed(folder / "root" / "capsule" / "decoder"))
    at = "/capsule"
    sources = f"{at}/decoder/terrainwave.c", f"{at}/decoder/twz.c"
    inside(folder / "root", path, COMPILER, *sources, "-o", f"{at}/twz")
    name = f"{at}/{Path(path).name}"
    inside(folder / "root", path, f"{at}/twz", "check", name)
    found = inside(folder / "root", path, f"{at}/twz", "root", name)
    with terrainwave.open(path) as terrain:
        expected = terrain.digest()
    if found != expected:
        raise SystemExit(f"{path}: found root {found}, expected {expected}")
    print(f"{Path(path).name}: root {found}")


def main():
    """Check the capsules of all files that are named."""
    if not sys.argv[1:]:
        raise SystemExit(__doc__)
    for path in sys.argv[1:]:
        with tempfile.TemporaryDirectory() as folder:
            check(path, Path(folder))


if __name__ == "__main__":
    main()
