"""The README's code runs and prints what the README says."""

import contextlib
import io
import pathlib
import re

import pytest

README = (pathlib.Path(__file__).parents[1] / "README.md").read_text()


@pytest.mark.slow
def test_the_examples_print_what_they_say(compilation_cache):
    examples = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", README, re.S)
    assert len(examples) == README.count("```python")
    names: dict = {}
    for code, said in examples:
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(code, names)
        assert out.getvalue().strip() == said.strip()


def test_every_picture_and_notebook_it_links_to_exists():
    for link in re.findall(r"\]\(([^)h#][^)]*)\)", README):
        assert (pathlib.Path(__file__).parents[1] / link).exists(), link
