"""The site is built without a warning, and every page of it is whole in a browser, on a phone as on a desk."""

import importlib.util
import os
import pathlib
import subprocess
import sys
import time

import pytest
import site_browser

pytestmark = [pytest.mark.site, pytest.mark.slow]

ROOT = pathlib.Path(__file__).parents[1]
NEEDED = {"material": "mkdocs-material", "mkdocs_jupyter": "mkdocs-jupyter", "mkdocstrings": "mkdocstrings", "selenium": "selenium"}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    missing = [package for module, package in NEEDED.items() if not importlib.util.find_spec(module)]
    if missing:
        pytest.skip(f"The extra `docs` is not installed: {', '.join(missing)}.")
    if None in site_browser.chromium():
        pytest.skip("There is no Chromium with its driver (packages chromium and chromium-driver).")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", ROOT / "docs" / "mkdocs.yml", "-d", folder]
    begin = time.monotonic()
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    assert run.returncode == 0, "\n".join(line for line in run.stderr.splitlines() if not line.startswith("INFO"))
    print(f"built in {time.monotonic() - begin:.0f} s")
    return folder


def test_no_page_has_a_fault(site):
    begin = time.monotonic()
    found, pages, formulas = site_browser.faults(site)
    print(f"{pages} pages with {formulas} formulas, each at {len(site_browser.SIZES)} sizes, in {time.monotonic() - begin:.0f} s")
    assert pages > 40 and formulas > 300
    assert not found, "\n" + site_browser.table(found)
