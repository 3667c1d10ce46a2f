"""The terrainwave command: where it is, and how it is started.

It has an environment of its own: QGIS's Python needs none of its packages.
"""

from __future__ import annotations

import json
import os
import queue
import re
import shutil
import subprocess
import sys
import threading

from qgis.core import QgsProcessingException, QgsSettings

SETTING = "terrainwave/command"
# Seconds between two looks at the button that cancels.
_PATIENCE = 0.1
_PROGRESS = re.compile(r"progress: (.+) (\d+) %")
# What QGIS sets for its own Python, GDAL and PROJ, which are others than the command's.
_OF_QGIS = (
    "PYTHONHOME", "PYTHONPATH", "GDAL_DATA", "GDAL_DRIVER_PATH", "PROJ_LIB", "PROJ_DATA",
)  # fmt: skip


class CommandNotFoundError(Exception):
    """There is no terrainwave command where it is looked for."""


def find_command() -> str:
    """Return the path of the command: the one that is set, or that on the PATH.

    Raises
    ------
    CommandNotFoundError
        If there is none; the message is one line.
    """
    chosen = QgsSettings().value(SETTING, "", type=str).strip()
    folders = [chosen, os.path.join(chosen, "bin"), os.path.join(chosen, "Scripts")]
    if os.path.isdir(chosen):
        found = shutil.which("terrainwave", path=os.pathsep.join(folders))
    else:
        found = shutil.which(chosen or "terrainwave")
    if found is None:
        raise CommandNotFoundError(
            f"no terrainwave command {f'at {chosen}' if chosen else 'on the PATH'}: install it"
            ' with pip install "terrainwave[serve]", then name its environment in'
            " Plugins > terrainwave > Settings"
        )
    return found


def environment() -> dict[str, str]:
    """Return the environment variables of the command."""
    kept = {name: value for name, value in os.environ.items() if name not in _OF_QGIS}
    return kept | {"TERRAINWAVE_PROGRESS": "lines", "PYTHONIOENCODING": "utf-8"}


def run(arguments: list[str], feedback) -> dict:
    """Run the command to its end and return what it prints as JSON, if it does.

    Parameters
    ----------
    arguments : list of str
    feedback : QgsProcessingFeedback
        Is told of progress and notes; cancels. What is cancelled leaves nothing behind.

    Raises
    ------
    QgsProcessingException
        With the command's own line if it fails; if it was cancelled.
    """
    try:
        command = [find_command(), *arguments]
    except CommandNotFoundError as error:
        raise QgsProcessingException(str(error)) from error
    feedback.pushCommandInfo(subprocess.list2cmdline(command))
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment(),
        creationflags=subprocess.CREATE_NO_WINDOW if sys.platform == "win32" else 0,
    )
    lines: queue.Queue = queue.Queue()
    output: list[bytes] = []
    readers = [
        threading.Thread(target=lambda: output.append(process.stdout.read()), daemon=True),
        threading.Thread(target=_read_lines, args=(process.stderr, lines), daemon=True),
    ]
    for reader in readers:
        reader.start()
    problem = _tell(lines, process, feedback)
    status = process.wait()
    for reader in readers:
        reader.join()
    process.stdout.close()
    process.stderr.close()
    if feedback.isCanceled():
        raise QgsProcessingException("cancelled: nothing was written")
    text = output[0].decode("utf-8", "replace").strip()
    printed = json.loads(text) if text.startswith("{") else {}
    if status != 0:
        problem = problem or "; ".join(printed.get("problems", []))
        raise QgsProcessingException(problem or f"terrainwave ended with status {status}")
    for note in printed.get("notes", []):
        feedback.pushInfo(f"note: {note}")
    return printed


def _read_lines(stream, lines: queue.Queue) -> None:
    for line in stream:
        lines.put(line.decode("utf-8", "replace").rstrip())
    lines.put(None)


def _tell(lines: queue.Queue, process: subprocess.Popen, feedback) -> str:
    """Tell of all lines, end the process where that is asked for; return the last error."""
    problem = stage = ""
    is_ending = False
    while True:
        if feedback.isCanceled() and not is_ending:
            process.terminate()
            is_ending = True
        try:
            line = lines.get(timeout=_PATIENCE)
        except queue.Empty:
            continue
        if line is None:
            return problem
        progress = _PROGRESS.fullmatch(line)
        if progress:
            if progress[1] != stage:
                stage = progress[1]
                feedback.setProgressText(stage)
            feedback.setProgress(int(progress[2]))
        elif line.startswith("terrainwave"):
            problem = line
        elif line:
            feedback.pushInfo(line)
