"""Contact: impacts per second of computing, what a contact costs where nothing touches, and the wait for the compiler.

python tests/benchmarks/bench_contact.py

Beside each time is that of the same by hand in the same run: one bounce in closed form per turn of a compiled loop; the same system
without its contact; and a first motion without contact. Medians of 9.
"""

import statistics
import subprocess
import sys

import jax
import jax.numpy as jnp
from timing import medians

import jaxlag as jl

jax.config.update("jax_enable_x64", True)
PARAMS = {"m": 1.0, "g": 9.81, "e": 1.0}
COLD = """
import time, jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import jaxlag as jl
contacts = {"unilateral": {"floor": jl.Contact(lambda q: q, restitution=lambda e: e)}} if CONTACT else {}
ball = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot**2 - m * g * q, **contacts)
start = time.perf_counter()
jax.block_until_ready(jl.simulate(ball, 1.0, 0.0, jnp.linspace(0, 1, 11), {"m": 1.0, "g": 9.81, "e": 0.8}).q)
print(time.perf_counter() - start)
"""


def ball(q, qdot, m, g):
    return 0.5 * m * qdot**2 - m * g * q


def smooth(q, qdot):
    return 0.5 * (qdot @ qdot) - 0.5 * (q @ q) - 0.1 * (q[0] * q[1]) ** 2


@jax.jit
def bounces(g, e, n):
    """The time after n bounces from the height 1, in closed form, one by one."""
    turn = lambda _, carry: (carry[0] + 2 * carry[1] / g, e * carry[1])
    return jax.lax.fori_loop(0, n, turn, (jnp.sqrt(2 / g), jnp.sqrt(2 * g)))[0]


def impacts():
    """A ball without loss for 900 s."""
    system = jl.System(ball, unilateral={"floor": jl.Contact(lambda q: q, restitution=lambda e: e)})
    run = lambda: jl.simulate(system, 1.0, 0.0, jnp.array([0.0, 900.0]), PARAMS)
    count = int(run().contacts["floor"].impacts[-1])
    seconds = medians({"jaxlag": lambda: run().q, "by hand": lambda: bounces(9.81, 1.0, count)})
    print(f"impacts per second    {count / seconds['jaxlag']:10.0f}    in closed form {count / seconds['by hand']:.3g}")


def where_nothing_touches():
    """A smooth motion with a wall out of reach."""
    ts, start = jnp.linspace(0, 1000, 11), (jnp.array([1.0, 0.5]), jnp.zeros(2))
    without, beside = jl.System(smooth), jl.System(smooth, unilateral={"wall": lambda q: q[0] + 10.0})
    run = lambda system: lambda: jl.simulate(system, *start, ts).q
    seconds = medians({"without": run(without), "with": run(beside)})
    ratio = seconds["with"] / seconds["without"]
    print(f"with a wall           {1e3 * seconds['with']:10.2f} ms   without {1e3 * seconds['without']:.2f} ms, {ratio:.2f} times")


def cold():
    """The first motion in a fresh process."""
    first = {}
    for contact in (True, False):
        run = lambda contact=contact: subprocess.run([sys.executable, "-c", f"CONTACT = {contact}\n{COLD}"], capture_output=True, text=True)
        first[contact] = statistics.median(float(run().stdout) for _ in range(3))
    print(f"first motion          {first[True]:10.2f} s   without contact {first[False]:.2f} s")


if __name__ == "__main__":
    impacts()
    where_nothing_touches()
    cold()
