"""The server process that hands .twz files to GDAL as GeoTIFFs; one for all layers."""

from __future__ import annotations

import json

from qgis.PyQt.QtCore import QObject, QProcess, QProcessEnvironment, pyqtSignal

from terrainwave_plugin.command import CommandNotFoundError, environment, find_command

_SECONDS_TO_END = 3


class Server(QObject):
    """Starts ``terrainwave serve`` when the first file is asked for; never waits for it.

    The process reads names of files from its stdin and ends where that ends: with QGIS, however
    QGIS ends.
    """

    served = pyqtSignal(str, str, dict)  # a file as it was asked for, its address, what info tells
    refused = pyqtSignal(str, str)  # a file, and why it is not served
    told = pyqtSignal(str)  # what it says on stderr: that it compiles, that a block is damaged
    crashed = pyqtSignal(str)  # why: the last line of stderr, if it ended by itself

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._process: QProcess | None = None
        self._waiting: list[str] = []
        self._last_line = ""

    def serve(self, file: str) -> None:
        """Ask for a path or a URL; `served` or `refused` is the answer."""
        if "\n" in file or "\r" in file:
            self.refused.emit(file, "the name has more than one line")
            return
        try:
            process = self._process or self._start()
        except CommandNotFoundError as error:
            self.refused.emit(file, str(error))
            return
        self._waiting.append(file)
        process.write(f"{file}\n".encode())

    def _start(self) -> QProcess:
        command = find_command()
        process = QProcess(self)
        variables = QProcessEnvironment()
        for name, value in environment().items():
            variables.insert(name, value)
        process.setProcessEnvironment(variables)
        process.readyReadStandardOutput.connect(self._read_answers)
        process.readyReadStandardError.connect(self._read_complaints)
        process.finished.connect(self._ended)
        process.errorOccurred.connect(self._failed)
        self._process, self._last_line = process, ""
        process.start(command, ["serve", "--stdin", "--port", "0"])
        return process

    def _read_answers(self) -> None:
        while self._process is not None and self._process.canReadLine():
            line = bytes(self._process.readLine())
            if not line.startswith(b"{"):  # its greeting
                continue
            answer = json.loads(line)
            file = answer["file"]
            if file in self._waiting:
                self._waiting.remove(file)
            if "url" in answer:
                self.served.emit(file, answer["url"], answer["info"])
            else:
                self.refused.emit(file, answer["error"])

    def _read_complaints(self) -> None:
        text = bytes(self._process.readAllStandardError()).decode("utf-8", "replace").strip()
        if text:
            self._last_line = text.splitlines()[-1]
            self.told.emit(text)

    def _failed(self, error: QProcess.ProcessError) -> None:
        if error == QProcess.ProcessError.FailedToStart:  # no other error ends unheard
            self._ended()

    def _ended(self, *_) -> None:
        """Tell of an end that nobody asked for; the next file starts another process."""
        process, self._process = self._process, None
        if process is None:
            return
        process.deleteLater()
        self._waiting.clear()
        is_told = process.exitStatus() == QProcess.ExitStatus.NormalExit and self._last_line
        self.crashed.emit(self._last_line if is_told else process.errorString())

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        self._waiting.clear()
        if process is None:
            return
        process.closeWriteChannel()
        if not process.waitForFinished(1000 * _SECONDS_TO_END):
            process.kill()
            process.waitForFinished(1000)
        process.deleteLater()
