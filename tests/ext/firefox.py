"""Debian's Firefox on a virtual screen, driven by WebDriver BiDi: no package has its driver."""

import base64
import contextlib
import io
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from ext.browser import PATIENCE
from PIL import Image
from websocket import create_connection

# WebGL by Mesa's software driver; nothing is asked of Mozilla's servers.
PREFERENCES = {
    "app.update.enabled": False,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "gfx.x11-egl.force-enabled": True,
    "network.captive-portal-service.enabled": False,
    "webgl.force-enabled": True,
    "webgl.out-of-process": False,
}


class Firefox:
    """One window."""

    def __init__(self, address):
        self._socket = create_connection(address, timeout=PATIENCE, suppress_origin=True)
        self._ids = itertools.count(1)
        self.log = []  # texts of warnings and errors
        self._ask("session.new", capabilities={})
        self._ask("session.subscribe", events=["log.entryAdded"])
        self._window = self._ask("browsingContext.getTree")["contexts"][0]["context"]

    def close(self):
        self._socket.close()

    def get(self, address):
        self._ask("browsingContext.navigate", context=self._window, url=address, wait="complete")

    def execute_script(self, script):
        """Return what an expression gives."""
        script = script.removeprefix("return ")
        return self._evaluate(f"JSON.stringify({script}) ?? null", json.loads)

    def give(self, name, *paths):
        """Choose files in the input of an id."""
        found = self._evaluate(f"document.getElementById({name!r})", None)
        element = {"sharedId": found["sharedId"]}
        self._ask("input.setFiles", context=self._window, element=element, files=[*map(str, paths)])

    def screenshot(self):
        """Return the picture, shape (rows, columns, 3)."""
        data = self._ask("browsingContext.captureScreenshot", context=self._window)["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def get_log(self, _):
        return [{"level": "SEVERE", "message": text} for text in self.log]

    def _evaluate(self, expression, of_text):
        target = {"context": self._window}
        answer = self._ask(
            "script.evaluate", expression=expression, target=target, awaitPromise=True
        )
        assert answer["type"] == "success", answer
        found = answer["result"]
        return found if of_text is None else found.get("value") and of_text(found["value"])

    def _ask(self, method, **params):
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            told = json.loads(self._socket.recv())
            if told.get("method") == "log.entryAdded" and told["params"]["level"] in {
                "warn", "error",
            }:  # fmt: skip
                self.log.append(told["params"]["text"])
            if told.get("id") == number:
                assert told["type"] == "success", told
                return told["result"]


@contextlib.contextmanager
def firefox():
    """Yield a driven Firefox with nothing stored."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        lines = [
            f"user_pref({json.dumps(one)}, {json.dumps(is_on)});"
            for one, is_on in PREFERENCES.items()
        ]
        (Path(profile) / "user.js").write_text("\n".join(lines), encoding="ascii")
        command = [
            "xvfb-run", "-a", "-s", "-screen 0 1000x800x24", shutil.which("firefox-esr"),
            "--profile", profile, "--remote-debugging-port", "0", "--no-remote",
        ]  # fmt: skip
        log = Path(profile) / "log"
        with log.open("w") as target:
            process = subprocess.Popen(
                command, stdout=target, stderr=target, env=os.environ | {"HOME": profile},
                start_new_session=True,
            )  # fmt: skip
        try:
            with contextlib.closing(Firefox(f"{address_in(log)}/session")) as driver:
                yield driver
        finally:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait(30)


def address_in(log):
    """Return the address that Firefox listens at, once it is in its log."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        for line in log.read_text(errors="replace").splitlines():
            if "WebDriver BiDi listening on" in line:
                return line.split()[-1]
        time.sleep(0.1)
    raise AssertionError(log.read_text(errors="replace"))
