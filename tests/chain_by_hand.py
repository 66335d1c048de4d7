"""A chain that falls on a table by another way: in angles, in NumPy, each mode's end found by SciPy's events, after Gauss and Moreau.

Of all accelerations that the contacts allow, the one nearest to that of the free masses (Gauss); of all velocities after an inelastic
impact, the one nearest to that before it (Moreau). Both are least distance problems (Lawson & Hanson, Solving Least Squares Problems,
chapter 23): min ‖w‖² with A w ≥ b, which non-negative least squares solve.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import nnls

G, TOUCH, REST = 9.81, 1e-10, 1e-10


def least_distance(A, b):
    """w and the multipliers λ ≥ 0, w = Aᵀ λ."""
    if not len(b) or np.all(b <= 0):
        return np.zeros(A.shape[1]), np.zeros(len(b))
    scale = np.max(np.abs(b))
    E, f = np.vstack([A.T, b / scale]), np.append(np.zeros(A.shape[1]), 1.0)
    u, _ = nnls(E, f, maxiter=1000)
    residual = f - E @ u  # (−w, 1) times its own last entry
    multipliers = u / residual[-1] * scale
    return A.T @ multipliers, multipliers


class Chain:
    """Unit masses joined by rods of the length l: y = (x₀, y₀, angles, and their rates)."""

    def __init__(self, q, l):
        self.l, self.size = l, len(q)
        self.links = np.tril(np.ones((self.size - 1, self.size - 2)), -1)  # which links lead to a mass

    def places(self, q):
        """x and y of all masses."""
        turned = self.l * np.stack([np.cos(q[2:]), np.sin(q[2:])])
        return q[:2, None] + turned @ self.links.T

    def slopes(self, q, v):
        """The derivative of the places by q, those of x before those of y, and its rate times v."""
        c, s, one = np.cos(q[2:]), np.sin(q[2:]), np.ones((self.size - 1, 1))
        J = np.block([[one, 0 * one, -self.l * s * self.links], [0 * one, one, self.l * c * self.links]])
        return J, -self.l * np.concatenate([self.links @ (c * v[2:] ** 2), self.links @ (s * v[2:] ** 2)])

    def reduced(self, q, v):
        """In the coordinates R q̇, of which half the square is the kinetic energy: R, the free acceleration, the rows and offsets of ÿ."""
        J, bend = self.slopes(q, v)
        Q, R = np.linalg.qr(J)
        weight = np.concatenate([np.zeros(self.size - 1), np.full(self.size - 1, -G)])
        return R, Q.T @ (weight - bend), Q[self.size - 1 :], bend[self.size - 1 :]

    def accelerated(self, q, v, closed):
        """q̈ and the forces of the contacts, with these closed."""
        R, free, A, offset = self.reduced(q, v)
        A, forces = A[closed], np.zeros(self.size - 1)
        forces[closed] = np.linalg.solve(A @ A.T, -offset[closed] - A @ free)
        return np.linalg.solve(R, free + A.T @ forces[closed]), forces

    def struck(self, q, v, touching):
        """q̇ after an inelastic impact, and the impulses."""
        R, _, A, _ = self.reduced(q, v)
        w, impulses = least_distance(A[touching], -A[touching] @ (R @ v))
        every = np.zeros(self.size - 1)
        every[touching] = impulses
        return v + np.linalg.solve(R, w), every

    def closed(self, q, v, resting):
        """Which of the contacts that rest stay closed."""
        R, free, A, offset = self.reduced(q, v)
        _, forces = least_distance(A[resting], -offset[resting] - A[resting] @ free)
        every = np.zeros(self.size - 1, bool)
        every[resting] = forces > 1e-9
        return every

    def simulated(self, q, v, ts):
        """At some times the places, the velocities, how often each mass has struck by then, and the sum of the impulses; and the changes
        of mode as (time, which contacts are closed).
        """
        t, y, opened = ts[0], np.concatenate([q, v]), None
        n, rows, course = self.size, [], []
        impacts, impulse = np.zeros(n - 1), 0.0
        while t < ts[-1]:
            q, v = y[:n], y[n:]
            near = self.places(q)[1] < TOUCH
            to_rates = self.slopes(q, v)[0][n - 1 :]
            hits = near & ((to_rates @ v) < -REST)
            if np.any(hits):
                v, impulses = self.struck(q, v, near)
                impacts, impulse = impacts + hits, impulse + np.sum(impulses)
            resting = near & (np.abs(to_rates @ v) < REST)
            if opened is not None and not np.any(hits):
                resting[opened] = False
            closed = self.closed(q, v, resting)
            course.append((t, closed))
            events = list(self.ends(closed))
            rates = lambda t, y, closed=closed: np.concatenate([y[n:], self.accelerated(y[:n], y[n:], closed)[0]])
            steps = {"first_step": min(1e-7, ts[-1] - t), "max_step": 1e-3}  # a gap may dip below zero just after an impact
            part = solve_ivp(
                rates, (t, ts[-1]), np.concatenate([q, v]), "DOP853", events=events, rtol=1e-12, atol=1e-13, dense_output=True, **steps
            )
            for s in ts:
                if t <= s < part.t[-1] or s == part.t[-1] == ts[-1]:
                    at = part.sol(s)
                    rows.append((self.places(at[:n]), self.slopes(at[:n], at[n:])[0] @ at[n:], impacts, impulse))
            which = next((i for i, found in enumerate(part.t_events) if found.size), None)
            opened = which if which is not None and closed[which] else None
            t, y = part.t[-1], part.y[:, -1]
        return [np.array(column) for column in zip(*rows, strict=True)], course

    def ends(self, closed):
        """Events that end a mode: heights of open contacts, forces of closed ones."""
        n = self.size
        for i in range(n - 1):
            if closed[i]:
                event = lambda t, y, i=i: self.accelerated(y[:n], y[n:], closed)[1][i]
            else:
                event = lambda t, y, i=i: self.places(y[:n])[1, i]
            event.terminal, event.direction = True, -1
            yield event
