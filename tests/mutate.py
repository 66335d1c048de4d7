"""Whether the tests notice: breaks the package in one place after another and runs the tests that README's command runs.

python tests/mutate.py              # all of `mutations.txt`, two at a time: an hour or two
python tests/mutate.py impact _fit   # those whose file or words contain one of these
python tests/mutate.py --near impact  # only the tests of their topics, as each should be noticed there

In `mutations.txt` each stands with what is wrong, its file and where its topic is tested, a piece of a line and what it becomes. Tests run
there first, then everywhere, until one fails. What no test notices is listed; how many these are is the exit status.
"""

import concurrent.futures
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

ROOT = pathlib.Path(__file__).parents[1]
PYTEST = [sys.executable, "-m", "pytest", "-x", "--tb=no", "-rfE", "-p", "no:xdist", "-o", "addopts=-q --strict-markers", "-m", "not slow"]
NO_TESTS = 5  # pytest's exit status


class Mutation(NamedTuple):
    """What is wrong, in which file, where the topic is tested, what stood there and what stands there now."""

    wrong: str
    file: str
    first: list[str]
    old: str
    new: str


def mutations() -> list[Mutation]:
    """Those of the file."""
    blocks = (ROOT / "tests" / "mutations.txt").read_text().strip().split("\n\n")
    lines = [block.split("\n") for block in blocks if not block.startswith("# ")]
    return [Mutation(wrong, *(where.split()[0], where.split()[1:]), old[2:], new[2:]) for wrong, where, old, new in lines]


def copied(folder: pathlib.Path) -> None:
    """The package and its tests to a folder of their own."""
    files = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for file in files.splitlines():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, folder / file)


def mutated(mutation: Mutation, text: str) -> str:
    """The text of the file with what is wrong."""
    if text.count(mutation.old) != 1:
        raise ValueError(f"{mutation.file} must hold {mutation.old!r} once, but holds it {text.count(mutation.old)} times.")
    return text.replace(mutation.old, mutation.new)


def noticed(mutation: Mutation, near: bool) -> str:
    """The test that fails, or nothing."""
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        copied(folder)
        file = folder / mutation.file
        file.write_text(mutated(mutation, file.read_text()))
        own = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
        for where in ([f"tests/{path}" for path in mutation.first], *[["tests"]] * (not near)):
            found = subprocess.run([*PYTEST, *where], cwd=folder, env=own, capture_output=True, text=True)
            if found.returncode == 1:
                return next(line.split(" - ")[0] for line in found.stdout.splitlines() if line.startswith(("FAILED", "ERROR")))
            if found.returncode not in (0, NO_TESTS):
                raise RuntimeError(f"pytest ended with {found.returncode}: {found.stdout[-300:]}{found.stderr[-300:]}")
    return ""


def main(words: list[str]) -> int:
    """How many are not noticed."""
    near, words = "--near" in words, [word for word in words if word != "--near"]
    chosen = [x for x in mutations() if not words or any(word in f"{x.wrong} {x.file}" for word in words)]
    unnoticed, begin = 0, time.perf_counter()
    with concurrent.futures.ThreadPoolExecutor(2) as two:
        for mutation, test in zip(chosen, two.map(lambda x: noticed(x, near), chosen), strict=True):
            print(f"{time.perf_counter() - begin:6.0f} s  {mutation.wrong:55} {test or 'IS NOT NOTICED'}", flush=True)
            unnoticed += not test
    print(f"{len(chosen) - unnoticed} of {len(chosen)} are noticed")
    return unnoticed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
