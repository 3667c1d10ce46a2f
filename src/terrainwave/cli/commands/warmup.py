"""Command warmup: compilation of kernels in advance."""

import shlex
from pathlib import Path
from typing import Any

import click

from terrainwave.cli.options import Directory
from terrainwave.cli.output import CommandWithoutTarget, announce_compiling, plain, print_note
from terrainwave.names import WARMUP_TASKS


class Tasks(click.ParamType):
    """Comma-separated names of tasks."""

    name = "task,task,…"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, ...]:
        names = value if isinstance(value, tuple) else tuple(value.split(","))
        for name in names:
            if name not in WARMUP_TASKS:
                self.fail(
                    f"found {name}, expected one or more of {', '.join(WARMUP_TASKS)}", param, ctx
                )
        return names


@click.command(cls=CommandWithoutTarget)
@click.option(
    "--for",
    "tasks",
    type=Tasks(),
    default=",".join(WARMUP_TASKS),
    show_default=True,
    help="Tasks to compile kernels for; compress is always one.",
)
@click.option(
    "--to",
    "folder",
    type=Directory(),
    help="Keep the kernels in this folder. Later runs find it by NUMBA_CACHE_DIR.",
)
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
def warmup(tasks: tuple[str, ...], folder: str | None, quiet: bool) -> None:
    """Compile all kernels now, so that later runs start faster (for container images).

    The command keeps kernels next to the package, or in the folder that NUMBA_CACHE_DIR names. If
    it cannot write there, it keeps them in a private folder of the user and prints its name.
    """
    from terrainwave.cli.warmup import compile_kernels, keep_kernels_in

    if folder is not None:
        path = Path(folder).absolute()
        n_kernels = keep_kernels_in(path, tasks, quiet=quiet)
        if not quiet:
            click.echo(f"{n_kernels} kernels are in {plain(path)}; where terrainwave runs, set")
            click.echo(f"NUMBA_CACHE_DIR={plain(shlex.quote(str(path)))}")
        return
    announce_compiling(quiet=quiet)
    for left_out in compile_kernels(tasks):
        print_note(f"left out: {left_out}")
