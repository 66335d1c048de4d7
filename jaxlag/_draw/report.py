"""A fit as one page for a colleague, which needs neither Python nor a network."""

import base64
import html
import io
import json
import platform
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._fit.autocorrelation import spectrum
from .._fit.experiment import Experiment
from .._fit.fit_card import channel_rows
from .._fit.response_curve_test import ResponseCurveTest
from .._fit.result import Fit
from .._fit.rounding import plus_minus, rounded
from .._motion.export import jsonable
from .._paper.equations import equations
from .axes import channels, label, panels, pyplot, units_of
from .fit import MOST_PARAMETERS, convergence, parameters
from .fit import fit as fitted

MOST_COORDINATES = 12  # whose equations are printed
MOST_DRAWN = 6  # recordings
PACKAGES = "jaxlag", "jax", "diffrax", "numpy"
ICON = '<link rel="icon" href="data:,">'  # none: a browser would ask for one
STYLE = """<style>
:root { color-scheme: light dark; --line: #8884; --card: #8881; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 0 auto; padding: 1rem; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line); }
.wide { overflow-x: auto; } table { border-collapse: collapse; }
th, td { padding: .25rem .75rem .25rem 0; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
pre { background: var(--card); padding: .75rem; overflow-x: auto; font-size: .85rem; }
.wide img { max-width: 100%; min-width: 34rem; background: white; } .doubt { border-left: .3rem solid #d55e00; padding-left: .75rem; }
</style>"""


def report(
    fit: Fit, file: str | Path, *, title: str = "Identification", level: float = 0.95, comparison: Any = None, validation: Any = None
) -> None:
    r"""Writes a fit as one HTML page: model and equations, estimates with their intervals and remarks, each channel with its residuals and
    their spectrum, correlations, how the iteration went, and the settings to run it again.

    $$ S(f) = \frac{1}{T} \Bigl|\sum_i r_i\, e^{-2\pi\mathrm{i} f t_i}\Bigr|^2 $$

    The spectrum S of the T residuals r is flat where they are noise; a peak is a frequency that the model lacks. Samples may be irregular.
    Everything is within the file: it needs no network, and reads on a phone.

    **Arguments:**

    - `file`: the path of the page.
    - `title`: its heading.
    - `level`: of the intervals and bands, between 0 and 1.
    - `comparison`: what `compare` returned, to be shown, too; `validation`: likewise what `validate` returned.

    **Raises:** `ValueError` if `level` is out of range; `ImportError` without matplotlib. Equations are left out, with the reason, if SymPy
    is missing or the system has none that can be printed.

    **Source:** Lomb, Astrophys. Space Sci. 39 (1976) 447 (spectra of irregular samples); Ljung, System Identification, 2nd ed.,
    section 16.6.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    fit = jl.fit(oscillator, jl.Experiment(ts, jnp.cos(2.0 * ts) + 0.01 * jnp.sin(999.0 * ts), 1.0, 0.0), {"c": 3.0}, free="c")
    fit.report("report.html", title="The oscillator on the bench")
    ```
    """
    sections = [
        _heading(fit, title),
        _section("Estimates", _estimates(fit, level)),
        _section("Model", _model(fit)),
        *(_section(f"Recording {k}", part) for k, part in _recordings(fit, level)),
        _section("Channels", f"<pre>{html.escape(chr(10).join(channel_rows(fit.channels)))}</pre>"),
        *([_section("Errors and correlations", _picture(parameters(fit), "Errors and correlations"))] if _few(fit) else []),
        _section("Iteration", _picture(convergence(fit), "The cost after each step")),
        *(_section(name, f"<pre>{html.escape(repr(given))}</pre>") for name, given in _given(comparison, validation)),
        _section("To run it again", f"<pre>{html.escape(json.dumps(_settings(fit), indent=1, ensure_ascii=False))}</pre>"),
    ]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{html.escape(title)}</title>{ICON}{STYLE}'
    page = f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{chr(10).join(sections)}\n</body></html>\n'
    Path(file).write_text(page, encoding="utf-8")


def _section(name: str, content: str) -> str:
    return f"<h2>{html.escape(name)}</h2>\n{content}"


def _heading(fit: Fit, title: str) -> str:
    """The title, the first line of the card, and the remarks."""
    first = html.escape(repr(fit).splitlines()[0])
    remarks = "".join(f"<li>{html.escape(remark)}</li>" for remark in fit.remarks)
    kind = "" if fit.converged and not fit.remarks else ' class="doubt"'
    found = f"<p>Start found by {html.escape(', then '.join(fit.start_log))}.</p>" if fit.start_log else ""
    return f"<h1>{html.escape(title)}</h1>\n<div{kind}><p><b>{first}</b></p>{found}{f'<ul>{remarks}</ul>' if remarks else ''}</div>"


def _estimates(fit: Fit, level: float) -> str:
    """A row for each number."""
    columns = ["", "estimate", "unit", f"{100 * level:g} % interval"]
    rows = []
    for row in fit.to_dict(level=level)["parameters"]:
        error = row["standard_error"]
        known = error is not None and np.isfinite(error)
        ends = (f"{rounded(row[end], error)}" if row[end] is not None else "∞" for end in ("lower", "upper"))
        value = plus_minus(row["value"], error) if known else f"{row['value']:.6g}, not determined"
        rows.append([row["name"], value, row.get("unit", ""), " … ".join(ends) if known else ""])
    if not any(unit for _, _, unit, _ in rows):
        columns, *rows = [[name, value, interval] for name, value, _, interval in (columns, *rows)]
    return _table(columns, rows)


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    line = lambda cells, tag: "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"
    return f'<div class="wide"><table>{line(columns, "th")}{"".join(line(row, "td") for row in rows)}</table></div>'


def _model(fit: Fit) -> str:
    """The terms of the system, and its equations of motion."""
    system, params = fit.problem.model.system, fit.params
    q = next((q for q in map(_coordinates, fit.experiments) if q is not None), None)
    named = ", ".join(html.escape(name) for name in system.terms if name != "time")
    terms = f"<p>Dissipation, forces and constraints: {named}.</p>" if named else ""
    if q is None:
        return terms
    if sum(np.size(leaf) for leaf in jax.tree.leaves(q)) > MOST_COORDINATES:
        return f"{terms}<p>The equations of so many coordinates are not printed.</p>"
    try:
        return f"{terms}<pre>{html.escape(str(equations(system, q, params)))}</pre>"
    except (ImportError, NotImplementedError, TypeError, ValueError) as reason:
        return f"{terms}<p>The equations are not printed: {html.escape(str(reason))}</p>"


def _coordinates(experiment: Any) -> PyTree:
    """Coordinates as an experiment or a test has them; None of a measurement."""
    if isinstance(experiment, Experiment):
        return experiment.q0
    return experiment.start["q"] if isinstance(experiment, ResponseCurveTest) else getattr(experiment, "q", None)


def _recordings(fit: Fit, level: float) -> Iterator[tuple[int, str]]:
    """Pictures of each recording in time and of each sweep: measured, fitted, residuals, of recordings their spectrum."""
    recorded = [(k, e) for k, e in enumerate(fit.experiments) if isinstance(e, (Experiment, ResponseCurveTest))]
    for k, e in recorded[:MOST_DRAWN]:
        motion = _picture(fitted(fit, number=k, level=level), f"Recording {k}: measured and fitted, and the residuals")
        has_samples = isinstance(e, Experiment) and len(channels(fit.residuals[k], "z")) > len(e.events)
        yield k, motion + (_picture(_spectra(fit, k), f"Recording {k}: spectrum of the residuals") if has_samples else "")
    if len(recorded) > MOST_DRAWN:
        yield len(recorded), f"<p>{len(recorded) - MOST_DRAWN} more recordings are not drawn.</p>"


def _spectra(fit: Fit, number: int) -> Any:
    """Axes with the spectrum of the residuals of each channel."""
    experiment, units = fit.experiments[number], units_of(fit.units, None)
    assert isinstance(experiment, Experiment)
    residuals, ts = channels(fit.residuals[number], "z"), np.asarray(experiment.ts)
    residuals = {name: entries for name, entries in residuals.items() if name not in experiment.events}
    drawn = panels(None, (1, len(residuals)), "one for each channel", figsize=(max(5.0, 3.6 * len(residuals)), 2.4))
    for ax, (name, entries) in zip(np.ravel(drawn), residuals.items(), strict=True):
        for entry, r in entries.items():
            if frequencies_and_power := spectrum(ts, np.asarray(r)):
                ax.semilogy(*frequencies_and_power, linewidth=1, label=entry)
        ax.set_ylabel(f"S of {name}")
        ax.set_xlabel(f"frequency (1/{units['t']})" if "t" in units else label("frequency", {}))
    return drawn


def _picture(axes: Any, words: str) -> str:
    """The figure of these axes as part of the page; it is closed."""
    figure, data = np.ravel(axes)[0].figure, io.BytesIO()
    figure.savefig(data, format="png", dpi=110, bbox_inches="tight")
    pyplot().close(figure)
    return f'<p class="wide"><img alt="{html.escape(words)}" src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}"></p>'


def _few(fit: Fit) -> bool:
    """Whether errors can be drawn."""
    return 0 < len(fit.names) <= MOST_PARAMETERS and bool(np.any(np.isfinite(np.diag(fit.covariance))))


def _given(comparison: Any, validation: Any) -> list[tuple[str, Any]]:
    return [(name, given) for name, given in (("Comparison", comparison), ("Validation", validation)) if given is not None]


def _settings(fit: Fit) -> dict[str, Any]:
    """The settings that decide the fit, apart from the system and the recordings."""
    free = fit.problem.free
    pairs = lambda lower, upper: dict(zip(fit.names, np.stack([lower, upper], axis=1).tolist(), strict=True))
    numerics = {name: value if isinstance(value, (int, float, str)) else repr(value) for name, value in fit.problem.model.numerics}
    found: dict[str, Any] = {
        "free": list(free.names),
        "start": dict(zip(fit.names, np.asarray(free.start).tolist(), strict=True)),
        "bounds": pairs(np.asarray(free.lower), np.asarray(free.upper)),
        "numerics": numerics,
        "samples": [int(e.ts.size) if isinstance(e, Experiment) else e.measurements for e in fit.experiments],
        "params": fit.params,
        "versions": {name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
    }
    return jsonable(found)
