"""Dry friction by another way: blocks in a row, stepped finely in NumPy, each end of a mode found by SciPy, modes found by trying all.

    m_i ẍ_i = −c_i (x_i − x_{i−1}) + c_{i+1} (x_{i+1} − x_i) − b_i ẋ_i + load_i(t) + Σ_j W_ji μ_j,    s = W ẋ − belt(t)

Block i rubs on the one before it (`linked`) or on a belt of its own: |μ_i| ≤ F_i(t), which varies and may vanish.
"""

import itertools

import numpy as np
from scipy.optimize import brentq

H = 0.01  # step of Dormand and Prince's scheme
A = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
C = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1)
AHEAD = 1e-7  # how far ahead forces are judged where a mode ends


def load(t, p, xp=np):
    waves = sum(p["size"][k] * xp.sin(p["rate"][k] * t + p["phase"][k]) for k in (0, 1))
    return waves + p["pulse"] * xp.exp(-(((t - p["when"]) / p["wide"]) ** 2))


def bound(t, p, xp=np):
    return xp.maximum(p["F"] * (1 + p["wave"] * xp.cos(p["F_rate"] * t)), 0)


def belt(t, p, xp=np):
    return p["belt"] * xp.sin(p["belt_rate"] * t)


class Blocks:
    """One motion of the blocks: `run(ts)` gives x at the times, and how often an element changed between sticking and either slip."""

    def __init__(self, p):
        self.p = {name: np.asarray(value, float) for name, value in p.items()}
        self.n = self.p["m"].size
        self.active = np.flatnonzero(self.p["F"] > 0)
        self.W = (np.eye(self.n) - np.diag(self.p["linked"][1:], -1))[self.active]
        stretch = np.eye(self.n) - np.eye(self.n, k=-1)
        self.K = stretch.T @ np.diag(self.p["c"]) @ stretch

    def accelerated(self, t, y, sigma):
        """Accelerations, friction forces, bounds, rates of slip."""
        p, x, v, W = self.p, y[: self.n], y[self.n :], self.W
        f, F = load(t, p) - self.K @ x - p["b"] * v, bound(t, p)[self.active]
        a, mu, stuck = (f - W.T @ (F * sigma)) / p["m"], -F * sigma, sigma == 0
        drift = -(p["belt"] * p["belt_rate"] * np.cos(p["belt_rate"] * t))[self.active]
        if stuck.any():
            mu[stuck] = np.linalg.solve(W[stuck] / p["m"] @ W[stuck].T, -drift[stuck] - W[stuck] @ a)
            a = a + W[stuck].T @ mu[stuck] / p["m"]
        return a, mu, F, W @ a + drift

    def slip(self, t, y):
        return self.W @ y[self.n :] - belt(t, self.p)[self.active]

    def margins(self, t, y, sigma):
        _, mu, F, _ = self.accelerated(t, y, sigma)
        return np.where(sigma == 0, F - np.abs(mu), sigma * self.slip(t, y))

    def kinks(self, end):
        """The times at which a bound vanishes or comes back."""
        p, turns = self.p, np.arange(end)
        first = np.arccos(-1 / np.maximum(p["wave"], 1))
        return np.unique(
            [(2 * np.pi * k + sign * a) / r for k in turns for a, r in zip(first, p["F_rate"], strict=True) for sign in (1, -1)]
        )

    def step(self, t, h, y, sigma):
        rate = lambda t, y: np.concatenate([y[self.n :], self.accelerated(t, y, sigma)[0]])
        k = [rate(t, y)]
        for a, c in zip(A[:-1], C, strict=True):
            k.append(rate(t + c * h, y + h * sum(w * r for w, r in zip(a, k, strict=True))))
        return y + h * sum(w * r for w, r in zip(A[-1], k, strict=True))

    def mode(self, t, y, at_rest, sigma):
        """Of all ways to stick and slip the one whose forces agree with it, with as little slip as possible."""
        found = []
        for ways in itertools.product((0, 1, -1), repeat=int(at_rest.sum())):
            tried = sigma.copy()
            tried[at_rest] = ways
            _, mu, F, rate = self.accelerated(t + AHEAD, y, tried)
            wrong = np.where(tried == 0, np.abs(mu) - F, -tried * rate)[at_rest]
            found.append((max(np.max(wrong, initial=0), 1e-9), np.count_nonzero(ways), ways))
        sigma = sigma.copy()
        sigma[at_rest] = min(found)[-1]
        return sigma

    def run(self, ts):
        y, t, states, changes = np.zeros(2 * self.n), ts[0], [], 0
        y[self.n :] = self.p["v0"]
        slip = self.slip(t, y)
        sigma = self.mode(t, y, np.abs(slip) < 1e-12, np.sign(slip))
        kinks = self.kinks(ts[-1])
        for end in ts:
            while t < end:
                h = min(H, end - t, np.min(kinks[kinks > t], initial=np.inf) - t)
                after = self.step(t, h, y, sigma)
                looks = [(part, self.margins(t + part * h, self.step(t, part * h, y, sigma), sigma)) for part in (0.25, 0.5, 0.75)]
                looks.append((1.0, self.margins(t + h, after, sigma)))
                beyond = next(((part, np.flatnonzero(m < -1e-12)) for part, m in looks if np.any(m < -1e-12)), None)
                if beyond is None:
                    t, y = t + h, after
                    continue
                part, which = beyond
                value = lambda x, j, h=h, t=t, y=y, sigma=sigma: self.margins(t + x * h, self.step(t, x * h, y, sigma), sigma)[j] + 1e-13
                first = min(0.0 if value(0.0, j) <= 0 else brentq(value, 0.0, part, args=(j,), xtol=1e-15) for j in which)
                y, t = self.step(t, first * h, y, sigma), t + first * h
                ended = np.abs(self.margins(t, y, sigma)) < 1e-9
                ended[which] |= len(which) == 1
                new = self.mode(t, y, (sigma == 0) | ended, sigma)
                changes += np.count_nonzero(new != sigma)
                if (new == sigma).all():  # it only touched its end
                    y, t = self.step(t, AHEAD, y, sigma), t + AHEAD
                sigma, stuck = new, new == 0
                if stuck.any():
                    W = self.W[stuck]
                    y[self.n :] -= W.T @ np.linalg.solve(W / self.p["m"] @ W.T, self.slip(t, y)[stuck]) / self.p["m"]
            states.append(y[: self.n].copy())
        return np.array(states), changes
