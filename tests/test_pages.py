"""README and the pages of the site: their programs run and print what the page says, what they link to exists, and claims have tests."""

import ast
import json
import pathlib
import re
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[1]
sys.path.append(str(ROOT / "docs"))
import figures  # noqa: E402
from fill import outputs  # noqa: E402

PAGES = ROOT / "docs" / "pages"
TEXTS = [ROOT / "README.md", PAGES / "start.md", *sorted(PAGES.glob("*/*.md"))]
WITH_PROGRAMS = [page for page in TEXTS if "```python" in page.read_text()]
TESTED = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")
named = [page.relative_to(ROOT).as_posix() for page in WITH_PROGRAMS]


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_PROGRAMS, ids=named)
def test_examples_print_what_the_page_says(page, tmp_path, monkeypatch, compilation_cache):
    monkeypatch.chdir(tmp_path)
    text = page.read_text()
    found = outputs(text)
    assert len(found) == text.count("```python")
    for stated, printed in found:
        assert printed.strip() == stated.strip()
    for picture in re.findall(r"!\[[^\]]*\]\((\w+\.png)\)", text):
        assert (tmp_path / picture).stat().st_size > 5000


@pytest.mark.fast
def test_what_the_readme_links_to_exists_and_it_is_short():
    readme = (ROOT / "README.md").read_text()
    for link in re.findall(r"\]\(([^)h#][^)]*)\)", readme):
        assert (ROOT / link).exists(), link
    assert len(readme.encode()) < 7000


@pytest.mark.fast
def test_tables_of_times_are_those_that_the_benchmarks_wrote():
    results, text = json.loads(figures.RESULTS.read_text()), figures.PAGE.read_text()
    assert figures.filled(text, results) == text
    assert text.count("<!-- figures:") == text.count("<!-- end -->") == len(figures.BLOCK.findall(text)) >= 6
    assert "| jaxlag |" in text


@pytest.mark.fast
@pytest.mark.parametrize("page", ["claims", "gaps"])
def test_what_is_claimed_is_tested(page):
    rows = [line for line in (PAGES / f"{page}.md").read_text().splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 5
    for row in rows:
        ((file, name),) = TESTED.findall(row)
        tests = [node.name for node in ast.parse((ROOT / file).read_text()).body if isinstance(node, ast.FunctionDef)]
        assert name in tests, row
