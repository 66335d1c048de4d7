"""The demo, `python -m jaxlag`: b, c and k of the lecture's vehicle, identified from a recorded drive."""

import argparse
import csv
import sys
import time
from pathlib import Path

import jax
import numpy as np

import jaxlag as jl
from jaxlag import plot
from jaxlag.examples import vehicle

COLUMNS = ("t", "y", "phi", "xdot")
GUESS = {"b": 6000.0, "c": 20000.0, "k": 0.3}  # a factor of two off
UNITS = {"b": "N s/m", "c": "N/m", "k": "kg/m", "t": "s", "y": "m", "phi": "rad", "xdot": "m/s"}


def main(argv: list[str] | None = None) -> int:
    """Runs the demo: prints the table of estimates and saves the picture.

    **Arguments:** `argv`: the command line; by default that of the process.

    **Returns:** the exit status: 0; 1 where the fit did not converge; 2 where the data cannot be used.
    """
    begin = time.perf_counter()
    arguments = _parser().parse_args(argv)
    try:
        ts, values = _read(arguments.data or vehicle.recording)
        jax.config.update("jax_enable_x64", True)
        experiment = jl.Experiment(ts, values, vehicle.q0, vehicle.qdot0, observe=vehicle.observe)
        print(f"{len(ts)} samples read; compiling takes some seconds before the first step.", file=sys.stderr, flush=True)
        fit = jl.fit(vehicle.system, experiment, vehicle.params | GUESS, free=tuple(GUESS), progress=True)
    except (ValueError, OSError, csv.Error) as error:
        print(error, file=sys.stderr)
        return 2
    print(_table(fit, vehicle.params if arguments.data is None else None))
    try:
        figure = plot.fit(fit, units=UNITS)[0, 0].figure
        figure.savefig(arguments.picture, dpi=100)
        print(f"picture: {arguments.picture}")
    except (ImportError, OSError, ValueError) as error:
        print(f"no picture: {error}")
    print(f"elapsed: {time.perf_counter() - begin:.1f} s")
    return 0 if fit.converged else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m jaxlag",
        description="Identifies damping b, stiffness c and air drag k of the lecture's vehicle from a recording. "
        "The guesses are a factor of two off.",
        epilog=f"The motion starts at the first sample with q0 = {vehicle.q0} and qdot0 = {vehicle.qdot0}, whatever the file contains; "
        "all other parameters are those of jaxlag.examples.vehicle (SI units). "
        "Exit status: 0; 1 where the fit did not converge; 2 where the data cannot be used.",
    )
    parser.add_argument("--data", type=Path, help="your own recording: a CSV file with the columns t,y,phi,xdot (s, m, rad, m/s)")
    parser.add_argument("--picture", type=Path, default="jaxlag_fit.png", help="file for the plot of the fit (default %(default)s)")
    return parser


def _read(file: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times and measured channels of a recording."""
    with open(file, newline="", encoding="utf-8-sig") as lines:
        rows = csv.DictReader(lines, skipinitialspace=True)
        missing = [name for name in COLUMNS if name not in (rows.fieldnames or ())]
        if missing:
            expected = ",".join(COLUMNS)
            raise ValueError(f"`{file}` must have the columns {expected}, but has no {', '.join(missing)}. Name them in its first line.")
        table = [[_number(row[name], f"`{file}`, line {rows.line_num}, column {name},") for name in COLUMNS] for row in rows]
    if len(table) < 2:
        raise ValueError(f"`{file}` must contain at least two samples, but contains {len(table)}. Record a drive of some seconds.")
    t, *channels = np.array(table).T
    return t, dict(zip(COLUMNS[1:], channels, strict=True))


def _number(text: str | None, where: str) -> float:
    try:
        number = float(text or "")
        if np.isfinite(number):
            return number
    except ValueError:
        pass
    raise ValueError(f"{where} must be a finite number, but is {text or ''!r}. Correct it or drop the sample.")


def _table(fit: jl.results.Fit, true: dict[str, float] | None) -> str:
    """Estimates with standard errors and, where the true values are known, their errors."""
    rows = [f"{'':3}{'value':>12}{'std. error':>12}" + (f"{'true':>10}{'off by (std. errors)':>22}" if true else "") + "   unit"]
    for name, value in fit.estimates.items():
        error = fit.standard_errors[name]
        known = f"{true[name]:10g}{(value - true[name]) / error:22.2f}" if true else ""
        rows.append(f"{name:3}{value:12.7g}{error:12.2g}{known}   {UNITS[name]}")
    outcome = "converged" if fit.converged else "not converged"
    return "\n".join([*rows, f"{outcome} after {fit.steps} steps; residual sigma {fit.sigma:.4g}"])


if __name__ == "__main__":
    sys.exit(main())
