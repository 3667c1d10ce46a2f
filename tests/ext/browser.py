"""A headless Chromium and a server in a thread, for tests of pages."""

import contextlib
import io
import shutil
import socket
import tempfile
import threading
import time

import numpy as np
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service

from terrainwave.ext.serve.client_limits import server_of

ARGUMENTS = (
    "--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage",
    "--window-size=800,600", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist", "--disable-features=BackForwardCache",
)  # fmt: skip
PATIENCE = 240  # seconds: WebGL runs on the processor, and machines are shared


@contextlib.contextmanager
def served(app, port=0):
    """Yield the address at which `app` answers."""
    with socket.create_server(("127.0.0.1", port)) as listener:
        server = server_of(app)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(30)


@contextlib.contextmanager
def chromium():
    """Yield a driven browser with WebGL and nothing stored."""
    options = Options()
    options.binary_location = shutil.which("chromium") or "chromium"
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        for argument in (*ARGUMENTS, f"--user-data-dir={profile}"):
            options.add_argument(argument)
        service = Service(shutil.which("chromedriver") or "chromedriver")
        driver = webdriver.Chrome(options=options, service=service)
        try:
            yield driver
        finally:
            driver.quit()


def wait_until(driver, script):
    """Return what the script gives once it is true."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = driver.execute_script(f"return {script}")
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError(f"never true: {script}; console: {console(driver)}")


def console(driver):
    """Return warnings and errors the page logged since the last call."""
    return [
        entry for entry in driver.get_log("browser")
        if entry["level"] in ("WARNING", "SEVERE") and "GPU stall" not in entry["message"]
    ]  # fmt: skip


def screenshot(driver):
    """Return the picture, shape (rows, columns, 3)."""
    return np.asarray(Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB"))
