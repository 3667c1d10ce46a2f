"""Commands run by tests: in this process, or in one of their own."""

import os
import signal
import subprocess
import sys

from click.testing import CliRunner

from terrainwave.cli import main


def run(*args):
    """Run a command in this process; errors must have become a line and a status."""
    result = CliRunner().invoke(main, [str(arg) for arg in args], prog_name="terrainwave")
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def _with_default_signals():
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.SIG_DFL)


def environment(**variables):
    """Return the variables of a process that imports what this one does."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)} | variables


def python(code, *words, **options):
    """Run code in a process of its own; its output is text."""
    return python_with(["-c", code, *words], **options)


def python_with(arguments, **options):
    """Run this Python with arguments; its output is text."""
    options = {"capture_output": True, "text": True, "check": False, "timeout": 400} | options
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, **{"env": environment()} | options)


def start(*args, **options):
    """Start a command in a process of its own."""
    program = "import sys; from terrainwave.cli import main; main(prog_name='terrainwave')"
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, args)],
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options,
        encoding="utf-8",
        # What was started in the background of a shell ignores Ctrl-C, what nohup started SIGHUP,
        # and both hand that on.
        preexec_fn=None if sys.platform == "win32" else _with_default_signals,
        env=environment(PYTHONIOENCODING="utf-8"),
    )


def one_line(result, status):
    """Return the one line of stderr of a failed command."""
    assert result.exit_code == status, result.output
    assert result.stdout == ""
    lines = [line for line in result.stderr.splitlines() if not line.startswith("compiling")]
    assert len(lines) == 1, lines
    assert lines[0].startswith("terrainwave")
    return lines[0]
