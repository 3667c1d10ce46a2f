"""JupyterLab on this machine alone, with a notebook in it, for tests of widgets in a browser."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
import urllib.request

from ext.browser import PATIENCE, wait_until

_PANEL = "[...jupyterapp.shell.widgets('main')][0]"
_IS_IDLE = (
    f"window.jupyterapp?.shell && {_PANEL}?.sessionContext?.session?.kernel?.status === 'idle'"
)
QUIET = [
    "--no-browser", "--allow-root", "--expose-app-in-browser", "--IdentityProvider.token=",
    "--ServerApp.port_retries=0", "--LabApp.news_url=None",
    "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate",
]  # fmt: skip


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def set_up(folder, what, settings):
    """Write settings that a page has when it is loaded again."""
    place = folder / "jupyter" / "LAB_SETTINGS" / "@jupyterlab" / "apputils-extension"
    place.mkdir(parents=True, exist_ok=True)
    (place / f"{what}.jupyterlab-settings").write_text(json.dumps(settings))


@contextlib.contextmanager
def jupyter_lab(folder):
    """Yield the address of a JupyterLab that shows a folder and keeps all its files in it."""
    own = {
        f"JUPYTER{name}_DIR": str(folder / "jupyter" / name)
        for name in ("_CONFIG", "_DATA", "_RUNTIME", "LAB_SETTINGS", "LAB_WORKSPACES")
    }
    own |= {"IPYTHONDIR": str(folder / "jupyter" / "ipython"), "JUPYTER_PLATFORM_DIRS": "1"}
    address = f"http://127.0.0.1:{(port := free_port())}"
    set_up(folder, "notification", {"fetchNews": "false"})
    log = folder / "jupyter.log"
    with log.open("wb") as out:
        server = subprocess.Popen(
            [sys.executable, "-m", "jupyterlab", *QUIET, f"--ServerApp.port={port}",
             f"--ServerApp.root_dir={folder}"],
            cwd=folder, env=os.environ | own, stdout=out, stderr=subprocess.STDOUT,
        )  # fmt: skip
    try:
        end = time.monotonic() + PATIENCE
        while True:
            with contextlib.suppress(OSError):
                json.load(urllib.request.urlopen(f"{address}/api/status"))
                break
            assert server.poll() is None, log.read_text()
            assert time.monotonic() < end, log.read_text()
            time.sleep(0.25)
        yield address
    finally:
        server.terminate()
        server.wait(30)


class Notebook:
    """A notebook that a driven browser shows.

    Parameters
    ----------
    driver : selenium's
    address : str
        Of the JupyterLab.
    path : Path
        Of the new notebook, in the folder that it shows.
    cells : list of str
        Their code.
    """

    def __init__(self, driver, address, path, cells):
        import nbformat  # here: it takes six seconds, of each worker

        spec = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
        made = nbformat.v4.new_notebook(
            cells=[nbformat.v4.new_code_cell(code) for code in cells], metadata=spec
        )
        nbformat.write(made, path)
        self.driver = driver
        driver.get(f"{address}/doc/tree/{path.name}")
        # A notebook with its kernel: a cell that runs before is dropped.
        wait_until(driver, _IS_IDLE)

    def start(self, number):
        """Begin to run a cell."""
        self.driver.execute_script(
            f"const {{ content }} = {_PANEL}; content.activeCellIndex = {number};"
            "jupyterapp.commands.execute('notebook:run-cell')"
        )

    def run(self, number):
        """Run a cell, and return the text of its output."""
        count = self.driver.execute_script(
            f"return {_PANEL}.model.cells.get({number}).executionCount"
        )
        self.start(number)
        wait_until(
            self.driver,
            f"(({{ executionCount: n, executionState: s }}) => n && n !== {count or 0}"
            f" && s !== 'running')({_PANEL}.model.cells.get({number}))",
        )
        return self.text(number)

    def text(self, number):
        """Return what a cell has printed, its errors too."""
        outputs = self.driver.execute_script(
            f"return {_PANEL}.model.cells.get({number}).outputs.toJSON()"
        )
        return "".join(
            output.get("text") or "\n".join(output.get("traceback", [])) for output in outputs
        )

    def is_idle(self):
        """Say whether no cell runs."""
        return self.driver.execute_script(f"return {_IS_IDLE}")

    def restart(self):
        """Begin with a new kernel."""
        self.driver.execute_script(f"{_PANEL}.sessionContext.restartKernel()")

    def frame(self):
        """Turn to the map, whose page is a document of its own."""
        self.driver.switch_to.default_content()
        wait_until(self.driver, "document.querySelector('iframe[title=Terrain]')")
        self.driver.switch_to.frame(
            self.driver.find_element("css selector", "iframe[title=Terrain]")
        )

    def top(self):
        """Turn back to the notebook."""
        self.driver.switch_to.default_content()
