"""A linear drive under a digital controller, by NumPy alone: exact between the samples, with sticking.

    M q̈ + F_v q̇ + F_c sign(q̇) = K u − offset,    u = K_v (K_p (r − q) − q̇), within ±10 V, held for a millisecond

with the figures of A. Janot, M. Gautier & M. Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System Identification
Benchmarks (2019), rounded: K 35.15 N/V, K_p 160.18 1/s, K_v 243.45 V s/m. The controller sees a quantised position, and its difference
as q̇. Nothing of jaxlag enters.

`worn` is the same drive as machines are: F_v and F_c are unlike in both directions, friction builds up over some micrometres (Dahl, A solid
friction model, Aerospace Corp. TOR-158 (1968)), and the screw pulls by its turn.
"""

import numpy as np

TRUE = {"M": 95.0, "Fv": 200.0, "Fc": 20.0, "offset": -3.0}
K, KP, KV, LIMIT = 35.15, 160.18, 243.45, 10.0
STEP, SAMPLES, QUANTUM = 1e-3, 24841, 1e-6  # s, and m
GOALS = (0.15, 0.02, 0.22, 0.05, 0.25, 0.0, 0.12, 0.2, 0.03, 0.24, 0.1, 0.0)  # m
SPEEDS = (0.1, 0.15, 0.2, 0.12, 0.18, 0.25, 0.1, 0.2, 0.15, 0.22, 0.12, 0.1)  # m/s, on average times 1.5


def held(q, v, force, left, M, Fv, Fc, offset):
    """Position and velocity after a time under a constant force: exponentials, from one rest to the next."""
    force = force - offset
    while left > 0:
        if v == 0 and abs(force) <= Fc:
            return q, 0.0
        final = (force - Fc * np.sign(v if v else force)) / Fv
        share = final / (final - v) if v and final != v else -1
        until = min(left, -np.log(share) * M / Fv if 0 < share < 1 else np.inf)
        decayed = np.exp(-Fv * until / M)
        q, v = q + final * until + (v - final) * (1 - decayed) * M / Fv, final + (v - final) * decayed if until == left else 0.0
        left -= until
    return q, v


def path():
    """Where the drive is to go: from goal to goal with a short rest at each."""
    r, at, k = np.zeros(SAMPLES), 0.0, 500
    for goal, speed in zip(GOALS, SPEEDS, strict=True):
        count = int(1.5 * abs(goal - at) / speed / STEP)
        s = np.arange(count) / count
        r[k : k + count] = (at + (goal - at) * (10 * s**3 - 15 * s**4 + 6 * s**5))[: max(SAMPLES - k, 0)]
        r[k + count :] = goal
        at, k = goal, k + count + 200
    return r


def recording(quantum=QUANTUM):
    """Times, quantised positions, true velocities and commands, (24841,) each."""
    ts, r = np.arange(SAMPLES) * STEP, path()
    q, v, before = 0.0, 0.0, 0.0
    seen, speeds, commands = np.empty(SAMPLES), np.empty(SAMPLES), np.empty(SAMPLES)
    for k in range(SAMPLES):
        seen[k], speeds[k] = np.round(q / quantum) * quantum, v
        commands[k] = np.clip(KV * (KP * (r[k] - seen[k]) - (seen[k] - before) / STEP), -LIMIT, LIMIT)
        before = seen[k]
        q, v = held(q, v, K * commands[k], STEP, **TRUE)
    return ts, seen, speeds, commands


FORTH, BACK = {"Fv": 212.0, "Fc": 22.0}, {"Fv": 195.0, "Fc": 18.5}
PRESLIDING, PITCH = 2e-5, 0.05  # m


def strokes(goals=(0.24, 0.0) * 6, speeds=(0.2, 0.12, 0.06, 0.16) * 3, samples=SAMPLES, begin=500):
    """There and back, each stroke at a constant speed, as EMPS is led."""
    r, at, k = np.zeros(samples), 0.0, begin
    for goal, speed in zip(goals, speeds, strict=True):
        rise, T = speed / 1.0, abs(goal - at) / speed + speed / 1.0
        t = np.arange(int(T / STEP) + 1) * STEP
        way = np.where(t < rise, t**2 / 2, np.where(t < T - rise, speed * (t - rise / 2), abs(goal - at) - (T - t) ** 2 / 2))
        way = (at + np.sign(goal - at) * way)[: max(samples - k, 0)]
        r[k : k + len(way)], r[k + len(way) :] = way, goal
        at, k = goal, k + len(t) + 150
    return r


def worn(r=None, forth=FORTH, back=BACK, ripple=1.0, presliding=PRESLIDING, steps=10):
    """As `recording`, led along r, (T,) or (T, drives), and the true accelerations: ten steps of Euler's scheme a sample, in which
    friction builds up exactly.
    """
    r, h = strokes() if r is None else r, STEP / steps
    q, v, before, built = (np.zeros(r.shape[1:]) for _ in range(4))
    seen, speeds, commands, accelerations = (np.empty(r.shape) for _ in range(4))
    for k in range(len(r)):
        seen[k], speeds[k] = np.round(q / QUANTUM) * QUANTUM, v
        commands[k] = np.clip(KV * (KP * (r[k] - seen[k]) - (seen[k] - before) / STEP), -LIMIT, LIMIT)
        before = seen[k]
        for _ in range(steps):
            Fv, Fc = (np.where(v > 0, forth[name], back[name]) for name in ("Fv", "Fc"))
            built = np.sign(v) - (np.sign(v) - built) * np.exp(-np.abs(v) * h / presliding)
            pull = K * commands[k] - TRUE["offset"] - ripple * np.sin(2 * np.pi * q / PITCH)
            begin, v = v, v + h * (pull - Fc * built - Fv * v) / TRUE["M"]
            q = q + h * (begin + v) / 2
        accelerations[k] = (v - speeds[k]) / STEP
    return np.arange(len(r)) * STEP, seen, speeds, commands, accelerations


def inverse_dynamics(speeds, commands, accelerations):
    """M, Fv, Fc and the offset by least squares in the true motion, where it slides."""
    slides, v = np.abs(speeds) > 0.01, speeds + accelerations * STEP / 2
    columns = np.stack([accelerations, v, np.sign(v), np.ones_like(v)], axis=1)[slides]
    return dict(zip(TRUE, np.linalg.lstsq(columns, K * commands[slides], rcond=None)[0], strict=True))
