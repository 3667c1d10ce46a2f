"""What several tests of pages and servers share."""

import pytest
from ext.rasters import BOUNDS, hills, write_twz


@pytest.fixture(scope="session")
def browser():
    """A headless Chromium, one for all files: each test opens a page anew."""
    from ext.browser import chromium

    with chromium() as driver:
        driver.set_script_timeout(120)
        yield driver


@pytest.fixture(scope="module")
def hilly(tmp_path_factory):
    """A file of hills within 2."""
    return write_twz(tmp_path_factory.mktemp("hills"), hills(65, 97), BOUNDS, max_error=2)
