"""Draws from posteriors: are they right, and how many independent ones come in a second?

First the lecture's vehicle, b, c and k from 101 noisy samples of y, φ and ẋ: effective draws in a second of `LogDensity.sample`, beside
NUTS of numpyro with the vehicle's equations solved by hand and integrated by diffrax, in logarithms of the parameters, each with the
mode of derivatives that serves it best. Four chains, each after compilation; one after the other, as both do it on a CPU.
Then simulation-based calibration (Talts et al., arXiv 1804.06788): an oscillator with dry and viscous friction, parameters drawn from
their priors, a recording of each, and the rank of the truth among draws that are nearly independent, which is uniform if all is right.

python tests/benchmarks/bench_posterior.py vehicle
python tests/benchmarks/bench_posterior.py calibration --replicas 500
"""

import argparse
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats
from vehicle_by_hand import FEW, SEEN, START, THETA, rates

import jaxlag as jl
from jaxlag.examples import vehicle

SIGMA = np.array([2e-3, 1e-3, 2e-2])  # of y, φ, ẋ
NAMES = ("b", "c", "k")
RTOL, ATOL = 1e-6, 1e-8
RUBBED = jl.System(
    lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2,
    dissipation={"viscous": lambda qdot, b: 0.5 * b * qdot**2, "dry": lambda qdot, F: F * jnp.abs(qdot)},
)
PRIORS = {"c": (4.0, 0.3), "b": (0.3, 0.05), "F": (0.15, 0.03)}
RANKS, BINS, THINNED = 49, 10, 8  # draws that are ranked, classes of ranks, and draws for each of those that are ranked


def by_hand(theta, rtol=RTOL, adjoint=None):
    """y, φ and ẋ of the vehicle at the samples."""
    field = lambda t, s, args: jnp.stack([jnp.asarray(x) for x in rates(*s, *args)])
    control = dfx.PIDController(rtol=rtol, atol=ATOL)
    times = {"t0": FEW[0], "t1": FEW[-1], "dt0": None, "saveat": dfx.SaveAt(ts=FEW), "max_steps": 4096, "throw": False}
    adjoint = {} if adjoint is None else {"adjoint": adjoint}
    return dfx.diffeqsolve(
        dfx.ODETerm(field), dfx.Tsit5(), y0=jnp.array(START), args=theta, stepsize_controller=control, **times, **adjoint
    ).ys[:, SEEN]


def recorded():
    """A recording of the vehicle."""
    return np.asarray(by_hand(jnp.asarray(THETA), 1e-10)) + SIGMA * np.random.default_rng(0).normal(size=(len(FEW), 3))


def ours(z, draws, warmup):
    """Seconds of the first call and of the second, and what that found."""
    of = lambda q, qdot: {"y": q["y"], "phi": q["phi"], "v": qdot["x"]}
    values, sigma = ({name: x[..., i] for i, name in enumerate(("y", "phi", "v"))} for x in (z, SIGMA))
    record = jl.Experiment(FEW, values, vehicle.q0, vehicle.qdot0, sigma=sigma, observe=of)
    density = jl.log_density(vehicle.system, record, vehicle.params, free=NAMES, rtol=RTOL, atol=ATOL)
    run = lambda key: density.sample(jax.random.key(key), draws, chains=4, warmup=warmup)
    first, seconds, found = timed(run)
    return first, seconds, {name: np.asarray(found.draws[name]) for name in NAMES}


def numpyros(z, draws, warmup, forward):
    """The same of numpyro."""
    import numpyro
    from numpyro import distributions as d
    from numpyro.infer import MCMC, NUTS, init_to_value

    def model():
        logs = [numpyro.sample(name, d.ImproperUniform(d.constraints.real, (), ())) for name in NAMES]
        seen = by_hand(jnp.asarray(THETA) * jnp.exp(jnp.stack(logs)), RTOL, dfx.ForwardMode() if forward else None)
        numpyro.sample("z", d.Normal(seen, SIGMA[None]).to_event(2), obs=z)

    kernel = NUTS(
        model,
        forward_mode_differentiation=forward,
        dense_mass=True,
        init_strategy=init_to_value(values=dict.fromkeys(NAMES, 0.0)),
    )
    mcmc = MCMC(kernel, num_warmup=warmup, num_samples=draws, num_chains=4, chain_method="sequential", progress_bar=False)

    def run(key):
        mcmc.run(jax.random.key(key))
        return jax.block_until_ready(mcmc.get_samples(group_by_chain=True))

    first, seconds, found = timed(run)
    return first, seconds, {name: THETA[i] * np.exp(np.asarray(found[name])) for i, name in enumerate(NAMES)}


def timed(run):
    """Seconds of the first call and of the second, and what that found."""
    begin = time.perf_counter()
    run(0)
    middle = time.perf_counter()
    found = run(1)
    end = time.perf_counter()
    return middle - begin, end - middle, found


def of_vehicle(draws, warmup):
    from blackjax import diagnostics

    z = recorded()
    runs = {
        "jaxlag": lambda: ours(z, draws, warmup),
        "numpyro + diffrax, forward": lambda: numpyros(z, draws, warmup, True),
        "numpyro + diffrax, reverse": lambda: numpyros(z, draws, warmup, False),
    }
    print(f"{'':28}{'first s':>9}{'run s':>9}{'least ESS':>11}{'ESS/s':>9}{'R̂':>8}   mean ± deviation of b, c, k over the truth")
    for name, run in runs.items():
        first, seconds, found = run()
        together = jnp.stack([found[name] for name in NAMES], axis=-1)
        ess, r_hat = (np.asarray(of(together)) for of in (diagnostics.effective_sample_size, diagnostics.potential_scale_reduction))
        flat = np.asarray(together).reshape(-1, 3) / THETA
        said = "  ".join(f"{m:.4f} ± {s:.4f}" for m, s in zip(flat.mean(0), flat.std(0), strict=True))
        print(f"{name:28}{first:9.1f}{seconds:9.2f}{ess.min():11.0f}{ess.min() / seconds:9.0f}{r_hat.max():8.4f}   {said}", flush=True)


def of_calibration(replicas):
    rng, ts = np.random.default_rng(1), np.linspace(0.0, 4.0, 41)
    ranks, begin, divergent = {name: [] for name in PRIORS}, time.perf_counter(), 0
    for i in range(replicas):
        truth = {name: rng.normal(*prior) for name, prior in PRIORS.items()}
        motion = jl.simulate(RUBBED, 1.0, 0.0, ts, truth)
        record = jl.Experiment(ts, np.asarray(motion.q) + 0.02 * rng.normal(size=ts.size), 1.0, 0.0, sigma=0.02)
        start = {name: mean for name, (mean, _) in PRIORS.items()}
        density = jl.log_density(RUBBED, record, start, free=tuple(PRIORS), priors=PRIORS)
        posterior = density.sample(jax.random.key(i), RANKS * THINNED, chains=1, warmup=200)
        divergent += posterior.divergences
        for name, x in posterior.draws.items():
            ranks[name].append(np.sum(x[0, ::THINNED] < truth[name]))
        if i in (0, 9, 99):
            print(f"{i + 1} replicas: {time.perf_counter() - begin:.0f} s", flush=True)
    print(f"{replicas} replicas in {time.perf_counter() - begin:.0f} s; {divergent} divergent steps; ranks among {RANKS} draws")
    for name, found in ranks.items():
        counts = np.histogram(found, np.linspace(-0.5, RANKS + 0.5, BINS + 1))[0]
        print(f"  {name}: {counts}, p = {stats.chisquare(counts).pvalue:.3f}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=["vehicle", "calibration"])
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--warmup", type=int, default=500)
    parser.add_argument("--replicas", type=int, default=500)
    given = parser.parse_args()
    if given.part == "vehicle":
        of_vehicle(given.draws, given.warmup)
    else:
        of_calibration(given.replicas)


if __name__ == "__main__":
    main()
