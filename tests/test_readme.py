"""The README's code runs and prints what the README says."""

import contextlib
import io
import pathlib
import re

README = (pathlib.Path(__file__).parents[1] / "README.md").read_text()


def test_the_example_prints_what_it_says():
    (code, said), *others = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", README, re.S)
    assert not others
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(code, {})
    assert out.getvalue().strip() == said.strip()


def test_every_picture_and_notebook_it_links_to_exists():
    for link in re.findall(r"\]\(([^)h#][^)]*)\)", README):
        assert (pathlib.Path(__file__).parents[1] / link).exists(), link
