"""Runs the programs of the pages and writes their output and pictures into the pages.

python docs/fill.py docs/pages/howto/friction.md …
"""

import contextlib
import io
import os
import re
import sys
import warnings
from pathlib import Path

BLOCK = re.compile(r"```python\n(.*?)```\n\n```text\n(.*?)```", re.S)


def outputs(text: str) -> list[tuple[str, str]]:
    """The output stated after each program of a page, and the output it prints; pictures go to the current folder."""
    import matplotlib

    matplotlib.use("Agg")
    names: dict = {}
    found = []
    for code, stated in BLOCK.findall(text):
        out = io.StringIO()
        with contextlib.redirect_stdout(out), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            exec(code, names)
        found.append((stated, out.getvalue().rstrip() + "\n"))
    return found


def main() -> None:
    """Fills each page, in its own folder."""
    for page in map(Path, sys.argv[1:]):
        page, text = page.resolve(), page.read_text()
        os.chdir(page.parent)
        for stated, printed in outputs(text):
            text = text.replace(f"```text\n{stated}```", f"```text\n{printed}```", 1)
        page.write_text(text)


if __name__ == "__main__":
    main()
