"""The demo: `python -m jaxlag` in a process and a folder of its own."""

import os
import subprocess
import sys

import pytest

from jaxlag.__main__ import main
from jaxlag.examples import vehicle

HEADER = "t,y,phi,xdot"
GOOD = f"{HEADER}\n0.0,0.55,0.05,0.0\n0.1,0.5,0.04,0.1\n0.2,0.4,0.02,0.2\n"


def run(folder, *arguments, **environment):
    command = [sys.executable, "-m", "jaxlag", *map(str, arguments)]
    environment = os.environ | {"MPLBACKEND": "Agg"} | environment
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, encoding="utf-8", timeout=300)


def table(text):
    """The rows of b, c and k as numbers."""
    rows = [line.split() for line in text.splitlines()]
    return {row[0]: [float(entry) for entry in row[1:-1] if entry[-1].isdigit()] for row in rows if row and row[0] in ("b", "c", "k")}


@pytest.mark.slow
def test_the_recorded_drive_is_identified(tmp_path):
    job = run(tmp_path)
    assert job.returncode == 0, job.stderr
    rows = table(job.stdout)
    assert set(rows) == {"b", "c", "k"}
    for name, (value, error, true, off) in rows.items():
        assert true == vehicle.params[name]
        assert 0 < error < 0.01 * true
        assert abs(value - true) < 3 * error
        assert off == pytest.approx((value - true) / error, abs=0.1)
    assert "compiling" in job.stderr and "step" in job.stderr
    assert "elapsed: " in job.stdout.splitlines()[-1]
    picture = (tmp_path / "jaxlag_fit.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) > 10_000


@pytest.mark.slow
def test_a_drive_of_ones_own_without_matplotlib(tmp_path):
    header, *rows = vehicle.recording.read_text().splitlines()
    (tmp_path / "mine.csv").write_text("\n".join(",".join(reversed(row.split(","))) for row in [header, *rows[:300]]))
    (tmp_path / "matplotlib").mkdir()
    (tmp_path / "matplotlib" / "__init__.py").write_text("raise ModuleNotFoundError('No module named matplotlib')")
    job = run(tmp_path, "--data", "mine.csv", "--picture", "fit.png", PYTHONPATH=str(tmp_path))
    assert job.returncode == 0, job.stderr
    assert "true" not in job.stdout
    for name, (value, error, *more) in table(job.stdout).items():
        assert abs(value - vehicle.params[name]) < 3 * error
        assert not more
    assert "no picture" in job.stdout and "Install `jaxlag[plot]`." in job.stdout
    assert not (tmp_path / "fit.png").exists()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (GOOD.replace("phi", "theta"), "must have the columns t,y,phi,xdot, but has no phi. Name them in its first line."),
        (GOOD.replace("0.4", "n/a"), "line 4, column y, must be a finite number, but is 'n/a'. Correct it or drop the sample."),
        (GOOD.replace("0.04", "nan"), "line 3, column phi, must be a finite number, but is 'nan'."),
        (GOOD + "0.3,0.4\n", "line 5, column phi, must be a finite number, but is ''."),
        (GOOD.replace("0.2,0.4", "0.05,0.4"), "`ts` must increase, but ts[1] = 0.1 is followed by ts[2] = 0.05. Sort"),
        (GOOD[: GOOD.index("0.1,")], "must contain at least two samples, but contains 1. Record a drive"),
        ("", "must have the columns t,y,phi,xdot, but has no t, y, phi, xdot."),
        (None, "No such file"),
    ],
    ids=["column", "text", "nan", "short row", "unsorted", "one sample", "empty", "no file"],
)
def test_an_unusable_file_is_refused_in_a_sentence(tmp_path, capsys, text, sentence):
    file = tmp_path / "drive.csv"
    if text is not None:
        file.write_text(text)
    assert main(["--data", str(file)]) == 2
    said = capsys.readouterr()
    assert sentence in said.err and said.err.count("\n") == 1
    assert said.out == ""


def test_the_exit_status_of_an_unusable_file_is_2(tmp_path):
    (tmp_path / "drive.csv").write_text(GOOD.replace("0.4", "n/a"))
    job = run(tmp_path, "--data", "drive.csv")
    assert job.returncode == 2
    assert "Traceback" not in job.stderr and "must be a finite number" in job.stderr


def test_help_says_where_the_motion_starts(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert str(vehicle.q0) in said and str(vehicle.qdot0) in said and HEADER in said
