"""Base parameters: combinations of parameters that measurements determine, where they do not determine each parameter."""

import dataclasses
import fractions
import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

AROUND = 0.3  # of a parameter, by which points differ from the estimate
MOST_POINTS = 40
UNUSED = 2  # of them, at which is checked what was found without them
DEGREE = 3  # of a polynomial: a moment of inertia m a² has it
LARGEST, FACTORS = 6, 3  # parameters in one polynomial, as in I + m₁ a² + (m₂ + m₃) L²; and those of them that are determined
MANY_GROUPS, MANY_VECTORS = 4000, 500  # of parameters, and of solutions for one group, that are tried
MINUS = 3  # terms that are as bad as a minus sign: masses and inertias add up
DENOMINATOR = 12  # of coefficients, 1/12 m l²; others are written as decimals
ROUNDING, NOISE = 1e-9, 100.0  # of slopes along what does not show, relative; or times the error of its directions
NEGLIGIBLE = 1e-6  # entries of a null vector, relative to the parameters, that count as zero
SURE = 10.0  # tolerances, from which on a number is not zero
APART = 1e-4  # of their sizes: a product of vectors that are not orthogonal
LARGEST_ERROR = 1e-3  # of a coefficient, relative, until it is checked
DECIMALS = 1e-6  # up to which tolerance coefficients can be read as decimals

Point = tuple[np.ndarray, np.ndarray]  # θ, and the changes that do not show there, as columns


class Combination(NamedTuple):
    """Σ c Π θ^x: coefficients c, (terms,), and exponents x, (terms, p)."""

    coefficients: tuple[fractions.Fraction | float, ...]
    exponents: tuple[tuple[fractions.Fraction | int, ...], ...]

    @property
    def has_minus(self) -> bool:
        """Whether a coefficient is negative."""
        return any(c < 0 for c in self.coefficients)

    @property
    def parameters(self) -> set[int]:
        """Indices of the parameters on which it depends."""
        return {j for row in self.exponents for j, x in enumerate(row) if x}

    def sorted(self) -> "Combination":
        """Terms without a number first."""
        order = sorted(range(len(self.coefficients)), key=lambda i: self.coefficients[i] != 1)
        return Combination(tuple(self.coefficients[i] for i in order), tuple(self.exponents[i] for i in order))

    def value(self, theta: np.ndarray) -> float:
        """At θ; NaN where a root is not real."""
        return float(np.array(self.coefficients, float) @ monomials(theta, np.array(self.exponents, float)))

    def gradient(self, theta: np.ndarray) -> np.ndarray:
        """∂/∂θ, (p,)."""
        return np.array(self.coefficients, float) @ slopes(theta, np.array(self.exponents, float))

    def estimate(self, theta: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
        """Value and standard error, from the covariance among the directions that are determined."""
        g = self.gradient(theta)
        return self.value(theta), float(np.sqrt(np.maximum(g @ covariance @ g, 0)))


def monomials(theta: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """Π θ^x, (terms,)."""
    with np.errstate(invalid="ignore"):
        return np.prod(theta[None] ** exponents, axis=1)


def slopes(theta: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """∂/∂θ of Π θ^x, (terms, p)."""
    lowered = exponents[:, None] - np.eye(theta.size)[None] * (exponents != 0)[:, :, None]
    with np.errstate(invalid="ignore"):
        return exponents * np.prod(theta[None, None] ** lowered, axis=2)


class Places:
    """An estimate and points around it, (θ, N): N are the changes that do not show there, as an orthonormal basis, (p, k).

    All is relative to the `scale` of the estimate. `points` yields θ and such changes, and is only asked for as many as are needed;
    parameters that are `fixed` do not change. `tolerance`: of what is zero along N.
    """

    def __init__(self, points: Iterable[Point], fixed: Sequence[int], tolerance: float) -> None:
        self._points, self._fixed, self._known = iter(points), list(fixed), list[Point]()
        theta, null = next(self._points)
        self.scale, self.tolerance = np.where(theta == 0, 1, np.abs(theta)), tolerance
        self._points = itertools.chain([(theta, null)], self._points)

    def first(self, count: int) -> list[Point]:
        """So many of them, the estimate first, or as many as there are."""
        for theta, null in itertools.islice(self._points, max(count - len(self._known), 0)):
            relative = null / self.scale[:, None]
            size = np.linalg.norm(relative, axis=0)
            relative[self._fixed] = 0
            self._known.append((theta / self.scale, column_space(relative[:, np.linalg.norm(relative, axis=0) > NEGLIGIBLE * size])))
        return self._known[:count]


def nearby(theta: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> Iterator[np.ndarray]:
    """Points around θ, within the bounds."""
    random, away = np.random.default_rng(0), AROUND * np.where(theta == 0, 1, np.abs(theta))
    for _ in range(MOST_POINTS):
        yield random.uniform(np.maximum(theta - away, lower), np.minimum(theta + away, upper))


def column_space(A: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what the columns span; of nothing but rounding there is none."""
    U, s, _ = np.linalg.svd(A, full_matrices=False)
    return U[:, s > NEGLIGIBLE * max(s[0], 1e-300)] if s.size else U


def parts_of(basis: np.ndarray, negligible: float = NEGLIGIBLE) -> list[list[int]]:
    """The finest groups of indices so that a space, given by an orthonormal basis, (n, d), is the sum of spaces of one group each.

    They are the blocks of its projector. Indices at which all vectors vanish are in none.
    """
    size = np.linalg.norm(basis, axis=1)
    touches = np.abs(basis @ basis.T) > APART * np.outer(size, size)
    left, parts = set(np.flatnonzero(size > negligible).tolist()), []
    while left:
        part, grown = set[int](), {min(left)}
        while grown != part:
            part = grown
            grown = part | (left & set(np.flatnonzero(np.any(touches[sorted(part)], axis=0)).tolist()))
        parts.append(sorted(part))
        left -= part
    return parts


def base_parameters(joint: Sequence[int], determined: Sequence[int], places: Places) -> tuple[Combination, ...] | None:
    """As many polynomials as are determined of the `joint` parameters, independent of each other; None where so many are not found.

    f(θ) is determined if ∇f · N = 0 at all θ, for the changes N that do not show. That is linear in the coefficients of a polynomial; each
    point gives some equations. Wanted are the solutions with the fewest terms, without a minus sign if that is possible. Parameters that
    are `determined` may be factors, as L is in m L².

    **Source:** Gautier & Khalil, IEEE Trans. Robot. Autom. 6 (1990) 368 (base parameters); Rockafellar, in Bose & Dowling, Combinatorial
    Mathematics and Its Applications (1969) 104 (elementary vectors of a subspace).
    """
    ((theta, null),) = places.first(1)
    count = len(joint) - column_space(null[joint]).shape[1]
    found: dict[Combination, None] = {}
    independent = lambda combinations: _independent(combinations, joint, theta * places.scale, places.scale)
    for degree in range(1, DEGREE + 1) if count else ():
        space, chosen = _Monomials.of(joint, determined, degree, places), ()
        for groups in _groups(joint, determined, null, degree):
            for group, functions in groups:
                known = [c for c in found if not c.has_minus and c.parameters <= {*group}]
                if len(independent(known)) < functions:
                    found |= dict.fromkeys(space.determined_of(group))
            chosen = independent(found)
            if len(chosen) == count and not any(c.has_minus for c in chosen):
                return chosen
        if len(chosen) == count:
            return chosen
    return None


def _groups(joint, determined, null, degree):
    """Parameters between which a polynomial may be sought, and of how many independent functions of them; lists of groups of one size."""
    if degree == 1:
        yield [(tuple(joint), len(joint))]
        return
    left = MANY_GROUPS
    for size in range(1, LARGEST + 1):
        groups = (
            (tuple(sorted(group + factors)), functions)
            for factors_size in range(min(FACTORS, size - 1, len(determined)) + 1)
            for group in itertools.combinations(joint, size - factors_size)
            if (functions := _functions(null[list(group)]))
            for factors in itertools.combinations(determined, factors_size)
        )
        tried = list(itertools.islice(groups, left))
        left -= len(tried)
        yield tried


def _functions(rows):
    """How many functions of these parameters can be determined; 0 if none of them depends on each parameter."""
    U, s, _ = np.linalg.svd(rows)
    left = U[:, int(np.sum(s > NEGLIGIBLE)) :]
    return left.shape[1] if np.all(np.linalg.norm(left, axis=1) > NEGLIGIBLE) else 0


@dataclasses.dataclass
class _Monomials:
    """Those up to some degree with one of the joint parameters at least, (monomials, p); and their slopes at each place, all of them and
    those along N.
    """

    exponents: np.ndarray
    degree: int
    places: Places
    slopes: list[np.ndarray] = dataclasses.field(default_factory=list)
    along: list[np.ndarray] = dataclasses.field(default_factory=list)

    @classmethod
    def of(cls, joint, determined, degree, places):
        """The simplest first."""
        every = sorted([*joint, *determined])
        products = (x for d in range(1, degree + 1) for x in itertools.combinations_with_replacement(every, d))
        return cls(np.array([np.bincount(x, minlength=places.scale.size) for x in products if {*x} & {*joint}]), degree, places)

    def determined_of(self, group: tuple[int, ...]) -> Iterator[Combination]:
        """Polynomials of the group that are determined, with few terms."""
        within = np.flatnonzero(self.exponents[:, list(group)].sum(axis=1) == self.exponents.sum(axis=1))
        ((_, null),) = self.places.first(1)
        enough = -(-within.size // column_space(null[list(group)]).shape[1]) + 1
        points = self.places.first(enough + UNUSED)
        if len(points) < enough + UNUSED:
            return
        self.slopes += [slopes(theta, self.exponents) for theta, _ in points[len(self.slopes) :]]
        self.along += [(S @ null).T for S, (_, null) in zip(self.slopes[len(self.along) :], points[len(self.along) :], strict=True)]
        tolerance = self.places.tolerance
        _, s, Vt = np.linalg.svd(np.concatenate(self.along[:enough])[:, within])
        solutions = Vt[int(np.sum(s > tolerance * s[0])) :].T
        for part in parts_of(solutions, SURE * tolerance):
            indices = within[part]
            exponents = self.exponents[indices]
            if self.degree > 1 and not np.all(np.any(exponents[:, list(group)], axis=0)):  # found in a smaller group
                continue
            for v in _sparse(column_space(solutions[part])):
                kept = np.abs(v) > max(NEGLIGIBLE, SURE * tolerance) * np.max(np.abs(v))
                found = _exact(v[kept], exponents[kept], self.places.scale, tolerance)
                relative = np.array(found.coefficients, float) * monomials(self.places.scale, exponents[kept])
                gradients = [relative @ S[indices[kept]] for S in self.slopes]
                constant = (_is_constant(g, null, SURE * tolerance) for g, (_, null) in zip(gradients, points, strict=False))
                if all(constant) and (tolerance <= DECIMALS or not _numbers(found.coefficients)[0]):
                    yield found.sorted()


def _is_constant(gradient, null, tolerance):
    """Whether a function does not change along null."""
    return np.linalg.norm(gradient @ null) <= tolerance * np.linalg.norm(gradient)


def _sparse(basis):
    """The vectors of a space with fewest entries: those that vanish at as many indices as can be chosen. `basis`: (n, d)."""
    n, d = basis.shape
    for zeros in itertools.islice(itertools.combinations(range(n), d - 1), MANY_VECTORS):
        _, s, Vt = np.linalg.svd(np.vstack([basis[list(zeros)], np.zeros((1, d))]))
        if d == 1 or s[d - 2] > NEGLIGIBLE:
            yield basis @ Vt[-1]


def _exact(v, exponents, scale, tolerance):
    """With coefficients that are small fractions where that is possible; of all multiples the one with the smallest numbers, and none in
    the term of highest degree, as in m a + 0.25 M.
    """
    raw, degree = v / monomials(scale, exponents), exponents.sum(axis=1)
    errors = np.minimum(SURE * tolerance * np.max(np.abs(v)) / np.abs(v), LARGEST_ERROR)
    multiples = [tuple(map(_fraction, raw / divisor, errors + error)) for divisor, error in zip(raw, errors, strict=True)]
    mixed = np.ptp(degree) > 0
    best = min(range(len(raw)), key=lambda i: (-degree[i] * mixed, _numbers(multiples[i])))
    return Combination(multiples[best], tuple(map(tuple, exponents.tolist())))


def _fraction(x, error):
    near = fractions.Fraction(float(x)).limit_denominator(DENOMINATOR)
    return near if abs(x - near) <= error * abs(x) and abs(near.numerator) <= DENOMINATOR else float(x)


def _independent(candidates, joint, theta, scale):
    """The simplest of them whose slopes are independent."""
    chosen, basis = [], np.zeros((len(joint), 0))
    for c in sorted(candidates, key=_complexity):
        g = (c.gradient(theta) * scale)[joint]
        left = g - basis @ (basis.T @ g)
        if np.linalg.norm(left) > APART * np.linalg.norm(g):
            chosen.append(c)
            basis = np.column_stack([basis, left / np.linalg.norm(left)])
    return tuple(chosen)


def _complexity(combination):
    """Terms, degrees and numbers; then which parameters are in it."""
    coefficients, exponents = combination
    terms = len(exponents) + MINUS * combination.has_minus
    return terms, sum(map(sum, exponents)), _numbers(coefficients), [[-x for x in row] for row in exponents]


def _numbers(coefficients):
    """How many are decimals, how large the numbers in the fractions are, how many are negative."""
    exact = [x for x in coefficients if isinstance(x, fractions.Fraction)]
    return len(coefficients) - len(exact), sum(abs(x.numerator) + x.denominator for x in exact), sum(x < 0 for x in coefficients)
