"""The page of a fit: well formed, whole without a network, with the numbers of the fit; and the spectrum of its residuals."""

import html.parser
import re

import jax
import matplotlib
import numpy as np
import pytest
import site_browser

import jaxlag as jl
from jaxlag._fit.autocorrelation import spectrum

matplotlib.use("Agg")
TS = np.linspace(0.0, 6e-3, 200)
UNITS = {"t": "s", "x": "mm", "c": "1/s²", "b": "1/s"}
spring = jl.System(
    lambda q, qdot, c: 0.5 * qdot["x"] ** 2 - 0.5 * c * q["x"] ** 2,
    dissipation={"oil": lambda qdot, b: 0.5 * b * qdot["x"] ** 2},
    units=UNITS,
)


@pytest.fixture(scope="module")
def fits():
    """Of a recording in mm and s with a hum of 5 kHz that the model lacks, and of the same after one step from far away."""
    c, b = 4e6, 200.0
    w = np.sqrt(c - b**2 / 4)
    x = np.exp(-b / 2 * TS) * (np.cos(w * TS) + b / 2 / w * np.sin(w * TS)) + 0.02 * np.sin(2 * np.pi * 5e3 * TS)
    x[40:50] = np.nan
    record = jl.Experiment(TS, {"x": x + 1e-3 * np.random.default_rng(0).standard_normal(200)}, {"x": 1.0}, {"x": 0.0})
    params = {"c": 3.9e6, "b": 100.0}
    return (
        jl.fit(spring, record, params, free=("c", "b")),
        jl.fit(spring, record, params | {"c": 9e6}, free=("c", "b"), max_steps=1),
        record,
    )


class _Tags(html.parser.HTMLParser):
    VOID = ("meta", "img", "link")

    def __init__(self):
        super().__init__()
        self.open, self.seen, self.text = [], [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_the_page_is_whole_and_says_what_the_fit_says(fits, tmp_path):
    good, poor, record = fits
    file = tmp_path / "report.html"
    both = {"good": good, "poor": poor}
    good.report(file, title="Spring <1> & oil", level=0.9, comparison=jl.compare(both), validation=jl.validate(good, record))
    text = file.read_text(encoding="utf-8")
    tags = _Tags()
    tags.feed(text)
    words = " ".join(" ".join(tags.text).split())
    assert not tags.open and not re.search(r'(src|href)="(?!data:)', text) and "http" not in re.sub(r"data:[^\"]*", "", text)
    assert "Spring <1> & oil" in words and "90 % interval" in words
    for row in good.to_dict(level=0.9)["parameters"]:
        assert f"{row['name']} " in words and row["unit"] in words
    c = float(good.estimates["c"])
    assert f"{c:.8g}"[:5].replace(".", "") in words.replace(".", "") and "oil" in words
    assert all(" ".join(remark.split()) in words for remark in good.remarks)
    assert "ẍ + b ẋ + c x = 0" in words and "Comparison: smaller is better" in words and "Validation" in words
    assert '"free": [ "c", "b" ]' in words and '"jaxlag"' in words
    pictures = [attrs for tag, attrs in tags.seen if tag == "img"]
    assert len(pictures) == 4 and all(p["alt"] and len(p["src"]) > 5000 for p in pictures)


def test_a_fit_that_is_none_says_so_at_the_top(fits, tmp_path):
    _, poor, _ = fits
    poor.report(tmp_path / "poor.html")
    text = (tmp_path / "poor.html").read_text()
    assert not poor.converged and text.index("not converged") < text.index("<h2>") and 'class="doubt"' in text


@pytest.mark.fast
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e5])
def test_the_spectrum_of_residuals(unit):
    """|FFT|²/T at its own frequencies for samples at even times, by NumPy; a hum is found among uneven ones with gaps, at a late time."""
    rng = np.random.default_rng(0)
    ts, r = unit * np.arange(200) / 100, rng.standard_normal(200)
    frequencies, power = spectrum(ts, r)
    exact = np.abs(np.fft.rfft(r - np.mean(r))) ** 2 / 200
    at = np.fft.rfftfreq(200, unit / 100)
    near = [int(np.argmin(np.abs(frequencies - f))) for f in at[5:-5]]
    same = np.abs(frequencies[near] - at[5:-5]) < 1e-9 / unit
    assert same.all()
    np.testing.assert_allclose(power[near], exact[5:-5], rtol=1e-6)
    ts = unit * (1e6 + np.sort(rng.uniform(0, 2, 300)))
    r = np.sin(2 * np.pi * 17.3 / unit * (ts - ts[0])) + 0.1 * rng.standard_normal(300)
    r[100:130] = np.nan
    frequencies, power = spectrum(ts, r)
    assert abs(frequencies[np.argmax(power)] * unit - 17.3) < 0.5
    assert spectrum(ts, np.full(300, np.nan)) is None and spectrum(ts, np.zeros(300)) is None


@pytest.mark.slow
def test_what_cannot_be_printed_is_left_out_with_its_reason(tmp_path):
    """A force by Bessel functions."""
    table = lambda q: -4 * q * jax.scipy.special.i0e(0.1 * q)
    ts = np.linspace(0, 2, 30)
    found = jl.fit(
        jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=table), jl.Experiment(ts, np.cos(2 * ts), 1.0, 0.0), {"m": 1.3}, free="m"
    )
    found.report(tmp_path / "table.html")
    assert "The equations are not printed:" in (tmp_path / "table.html").read_text()


@pytest.mark.site
@pytest.mark.slow
def test_it_reads_on_a_phone(fits, tmp_path):
    pytest.importorskip("selenium")
    if None in site_browser.chromium():
        pytest.skip("There is no Chromium with its driver (packages chromium and chromium-driver).")
    for k, found in enumerate(fits[:2]):
        found.report(tmp_path / f"{k}.html")
    seen, pages, _ = site_browser.faults(tmp_path)
    assert pages == 2 and not seen, site_browser.table(seen)
