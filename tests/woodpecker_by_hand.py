"""Glocker's woodpecker toy by another way: in NumPy, each mode's end found by SciPy's events, modes and impacts found by trying all.

    M u̇ = h(q) + W_N λ_N + W_T λ_T,    g = W_Nᵀ q + g₀,    q = (y, φ_M, φ_S): the sleeve's height and angle, the bird's angle

Source: Glocker, Set-Valued Force Laws (2001); Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts (1996), section 15.3.
"""

import itertools

import numpy as np
from scipy.integrate import solve_ivp

G, C, MU = 9.81, 0.0056, 0.3
M_M, M_S, J_M, J_S = 0.0003, 0.0045, 5e-9, 7e-7
R0, R_M, H_M, L_M, L_G, H_S, L_S = 0.0025, 0.0031, 0.0058, 0.010, 0.015, 0.02, 0.0201

START = np.array([0.0, -(R_M - R0) / H_M, -0.2788]), np.array([-0.3411, 0.0, -7.4583])  # Glocker has −0.1036, 1e-6 m inside of the rod
NAMES = ("beak", "lower", "upper")
E_N = np.array([0.5, 0.0, 0.0])
M = np.array(
    [[M_S + M_M, M_S * L_M, M_S * L_G], [M_S * L_M, J_M + M_S * L_M**2, M_S * L_M * L_G], [M_S * L_G, M_S * L_M * L_G, J_S + M_S * L_G**2]]
)
W_N = np.array([[0.0, 0.0, -H_S], [0.0, H_M, 0.0], [0.0, -H_M, 0.0]]).T
W_T = np.array([[1.0, L_M, L_G - L_S], [1.0, R_M, 0.0], [1.0, R_M, 0.0]]).T
G0 = np.array([L_M + L_G - L_S - R0, R_M - R0, R_M - R0])

OPEN, STICK = "open", 0  # modes of a contact, beside slip in the direction +1 or −1
TOUCH, REST, ZERO = 1e-10, 1e-8, 1e-9  # of gaps in m, of velocities, and of what a law may be violated by


def load(q):
    spring = C * (q[1] - q[2])
    return np.array([-(M_S + M_M) * G, -spring - M_S * G * L_M, spring - M_S * G * L_G])


def solved(known, modes, wanted):
    """x with M x = known + W λ and the forces λ of contacts in these modes, where x W_N is as `wanted` while a contact is closed."""
    rows, columns = [], []
    for i, mode in enumerate(modes):
        if mode == OPEN:
            continue
        rows.append((W_N[:, i], wanted[i]))
        columns.append(W_N[:, i] - (0 if mode == STICK else mode * MU) * W_T[:, i])
        if mode == STICK:
            rows.append((W_T[:, i], 0.0))
            columns.append(W_T[:, i])
    k = len(rows)
    B, A = np.array(columns).reshape(k, 3).T, np.array([row for row, _ in rows]).reshape(k, 3)
    matrix = np.block([[M, -B], [A, np.zeros((k, k))]])
    scale = np.concatenate([[1.0, 1e-2, 1e-2], np.ones(k)])  # lengths of some centimetres
    if k and np.linalg.cond(matrix * scale[:, None]) > 1e12:
        return None
    x = np.linalg.solve(matrix, np.concatenate([known, [value for _, value in rows]]))
    normal, tangential, at = np.zeros(3), np.zeros(3), 3
    for i, mode in enumerate(modes):
        if mode == OPEN:
            continue
        normal[i], tangential[i] = x[at], x[at + 1] if mode == STICK else -mode * MU * x[at]
        at += 2 if mode == STICK else 1
    return x[:3], normal, tangential


def selected(known, choices, wanted):
    """Of all combinations of modes, those that fulfil the laws of contact and friction: (modes, x, normal, tangential)."""
    found = []
    for modes in itertools.product(*choices):
        solution = solved(known, modes, wanted)
        if solution is None:
            continue
        x, normal, tangential = solution
        size = ZERO * (1 + np.max(np.abs(normal)))
        departs, slips = x @ W_N - wanted, x @ W_T
        fits = True
        for i, mode in enumerate(modes):
            if len(choices[i]) == 1:
                continue
            little = ZERO * (1 + np.max(np.abs(x)))
            law = departs[i] >= -little if mode == OPEN else normal[i] >= -size
            if mode == STICK:
                law &= abs(tangential[i]) <= MU * normal[i] + size
            elif mode != OPEN and STICK in choices[i]:
                law &= mode * slips[i] >= -little
            fits &= law
        if fits:
            found.append((modes, x, normal, tangential))
    return found


def struck(u, touching):
    """u after the impact of the contacts that touch."""
    choices = [(OPEN, STICK, 1, -1) if near else (OPEN,) for near in touching]
    found = selected(M @ u, choices, -E_N * np.minimum(u @ W_N, 0))
    assert found and all(np.allclose(x, found[0][1], rtol=1e-7, atol=1e-9) for _, x, _, _ in found)  # one solution, perhaps on two ways
    return found[0][1], found[0][2]


def mode_of(q, u, ended=None):
    """The mode in which the motion goes on, another than the one that has `ended`."""
    choices = [(OPEN,)] * 3
    for i in np.flatnonzero((np.abs(W_N.T @ q + G0) < TOUCH) & (np.abs(u @ W_N) < REST)):
        slip = u @ W_T[:, i]
        choices[i] = (OPEN, STICK, 1, -1) if abs(slip) < REST else (OPEN, int(np.sign(slip)))
    found = [solution for solution in selected(load(q), choices, np.zeros(3)) if solution[0] != ended]
    assert found and all(np.allclose(x, found[0][1], rtol=1e-6, atol=1e-6) for _, x, _, _ in found)
    return found[0][0]


def ends(modes):
    """Events that end these modes: gaps, normal forces, slip, and what friction has left."""

    def event(function):
        function.terminal, function.direction = True, -1
        return function

    forces = lambda y: solved(load(y[:3]), modes, np.zeros(3))
    for i, mode in enumerate(modes):
        if mode == OPEN:
            yield event(lambda t, y, i=i: (W_N[:, i] @ y[:3] + G0[i]) * 1e3)
            continue
        yield event(lambda t, y, i=i: forces(y)[1][i])
        if mode == STICK:
            for side in (1, -1):
                yield event(lambda t, y, i=i, side=side: MU * forces(y)[1][i] - side * forces(y)[2][i])
        else:
            yield event(lambda t, y, i=i, mode=mode: mode * (W_T[:, i] @ y[3:]))


def simulated(until, ts, start=START):
    """The states at some times; of each impact the time, the contacts that were struck, u behind it and its normal impulses; and the
    times and modes in between.
    """
    t, (q, u), modes = 0.0, start, None
    states, impacts, course = [], [], []
    while t < until:
        gaps = W_N.T @ q + G0
        hits = (gaps < TOUCH) & (u @ W_N < -REST)
        if np.any(hits):
            u, impulses = struck(u, gaps < TOUCH)
            impacts.append((t, hits, u, impulses))
        modes = mode_of(q, u, None if np.any(hits) else modes)
        course.append((t, modes))
        assert len(course) < 60
        rates = lambda t, y, modes=modes: np.concatenate([y[3:], solved(load(y[:3]), modes, np.zeros(3))[0]])
        part = solve_ivp(
            rates,
            (t, until),
            np.concatenate([q, u]),
            "DOP853",
            rtol=1e-12,
            atol=1e-15,
            events=list(ends(modes)),
            dense_output=True,
            max_step=5e-3,
        )
        states += [part.sol(s) for s in ts if t <= s < part.t[-1] or s == part.t[-1] == until]
        t, q, u = part.t[-1], part.y[:3, -1], part.y[3:, -1]
    return np.array(states), impacts, course
