"""Autocorrelation of residuals: a test for it, its length in samples, its effect on the covariance of the estimates; their spectrum."""

import numpy as np

from .._program.registry import remembered

LAGS = 20
COLOURED = 0.01  # p-value below which residuals are taken as correlated
FREQUENCIES = 500  # of a spectrum, at most
NEGLIGIBLE = 0.1  # a smaller correlation is ignored
COMMON_SAMPLES = 10  # that two channels need for an estimate of their correlation


def whiteness(residuals: np.ndarray) -> float:
    """The p-value of the test of Ljung and Box: the probability of autocorrelations this large in white noise.

    **Source:** Ljung & Box, Biometrika 65 (1978) 297.
    """
    from scipy import special  # SciPy is a dependency of JAX; imported here because that takes a while

    n = residuals.size
    lags = min(LAGS, n // 5)
    r = residuals - np.mean(residuals) if n else residuals
    power = r @ r
    if lags == 0 or power == 0:
        return np.nan
    rho = np.array([r[k:] @ r[:-k] for k in range(1, lags + 1)]) / power
    return float(special.chdtrc(lags, n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, lags + 1)))))


def autoregression(r: np.ndarray) -> np.ndarray:
    r"""The coefficients a of $r_t = \sum_k a_k r_{t-k} + e_t$; none where r is white.

    From the equations of Yule and Walker, whose model is stable; the order minimises Schwarz's criterion.

    **Source:** Brockwell & Davis, Time Series: Theory and Methods, 2nd ed. (1991), sections 5.2 and 8.1.
    """
    return _autoregression(np.asarray(r, float).tobytes())


@remembered  # the covariance and the table of channels ask for the same
def _autoregression(samples):
    r = np.frombuffer(samples)
    n = r.size
    if not whiteness(r) < COLOURED:
        return np.zeros(0)
    most = min(n // 5, int(10 * np.log10(n)))
    gamma = np.array([r[k:] @ r[: n - k] for k in range(most + 1)]) / n
    a, power = np.zeros(0), gamma[0]
    best, least = a, n * np.log(power)
    for k in range(1, most + 1):
        reflection = (gamma[k] - a @ gamma[k - 1 : 0 : -1]) / power
        a, power = np.append(a - reflection * a[::-1], reflection), power * (1 - reflection**2)
        if not power > 0:
            break
        criterion = n * np.log(power) + k * np.log(n)
        if criterion < least:
            best, least = a, criterion
    return best


def response(a: np.ndarray, count: int) -> np.ndarray:
    """The impulse response r of the autoregression, (count,)."""
    from scipy import signal

    return signal.lfilter([1.0], np.append(1.0, -a), np.eye(1, count)[0])


def correlation_length(a: np.ndarray, count: int) -> int:
    """The number of samples over which noise with these coefficients is correlated; 0 where it is white."""
    if a.size == 0:
        return 0
    spectrum = np.abs(np.fft.rfft(response(a, count), 2 * count)) ** 2
    gamma = np.fft.irfft(spectrum)[:count]
    return int(np.flatnonzero(np.abs(gamma) >= NEGLIGIBLE * gamma[0])[-1]) + 1


def independent_samples(count: int, correlated: int) -> float:
    """About how many independent samples tell as much about a variance as `count` samples that are `correlated` over so many.

    With r_t = ρ r_{t−1} + e_t these are count (1 − ρ²)/(1 + ρ²), and the correlation falls to a tenth within 2.3 / (1 − ρ) samples.

    **Source:** Bayley & Hammersley, J. R. Stat. Soc. Suppl. 8 (1946) 184.
    """
    return 2 * count / max(correlated, 2)


def coloured_information(J: np.ndarray, r: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    r"""$J^T R J$ for correlated residuals, the middle of the sandwich $(J^T J)^{-1} J^T R J (J^T J)^{-1}$; (x, x).

    R is the correlation of stationary noise $r = A^{-1} e$, with the autoregression A of each channel, whose shocks e may be correlated
    between channels. So $J^T R J = K^T \Sigma K$ with $K = A^{-T} J$, a filter that runs backwards in time.

    **Arguments:** `J` (T, C, x) and `r` (T, C), NaN where nothing was measured: such samples are left out, and the times are taken as
    evenly spaced. `sizes` (C,): the standard deviations of the channels in R.

    **Source:** Newey & West, Econometrica 55 (1987) 703, with their weighted autocovariances replaced by those of an autoregression whose
    order Schwarz's criterion chooses: den Haan & Levin, NBER Technical Working Paper 195 (1996). Missing samples left out: Datta & Du,
    International Finance Discussion Papers 1060 (2012). Correlated channels: Parks, J. Am. Stat. Assoc. 62 (1967) 500.
    """
    from scipy import signal

    T, C, _ = J.shape
    K, shocks, deviations = np.zeros((2 * T, *J.shape[1:])), np.full((T, C), np.nan), np.zeros(C)
    for c in range(C):
        there = np.flatnonzero(np.isfinite(r[:, c]))
        a = autoregression(r[there, c])
        rows = np.append(np.arange(T), T + there)  # T samples before the first one
        backwards = np.concatenate([np.zeros((T, J.shape[2])), J[there, c]])[::-1]
        K[rows, c] = signal.lfilter([1.0], np.append(1.0, -a), backwards, axis=0)[::-1]
        shocks[there[a.size :], c] = signal.lfilter(np.append(1.0, -a), [1.0], r[there, c])[a.size :]
        deviations[c] = sizes[c] / np.linalg.norm(response(a, 2 * T))
    covariance = _correlations(shocks) * np.outer(deviations, deviations)
    return np.tensordot(K, covariance @ K, axes=([0, 1], [0, 1]))


def _correlations(shocks):
    """Correlations of the channels, each over the samples that two have in common; made positive semidefinite."""
    C = shocks.shape[1]
    found = np.eye(C)
    for c in range(C):
        for d in range(c):
            both = shocks[np.all(np.isfinite(shocks[:, [c, d]]), axis=1)][:, [c, d]]
            power = np.prod(np.sum(both**2, axis=0))
            if len(both) >= COMMON_SAMPLES and power > 0:
                found[c, d] = found[d, c] = both[:, 0] @ both[:, 1] / np.sqrt(power)
    values, vectors = np.linalg.eigh(found)
    return vectors * np.maximum(values, 0) @ vectors.T


def spectrum(ts: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Frequencies, in one over the unit of time, and the periodogram of what was measured there; None for less than four samples."""
    from scipy.signal import lombscargle  # imported here because that takes a while

    there = np.isfinite(r)
    ts, r = ts[there], r[there] - np.mean(r[there]) if there.any() else r[there]
    if ts.size < 4 or not np.any(r):
        return None
    frequencies = np.linspace(0, (ts.size - 1) / (2 * (ts[-1] - ts[0])), min(ts.size // 2, FREQUENCIES) + 1)[1:]
    return frequencies, lombscargle(ts - ts[0], r, 2 * np.pi * frequencies)
