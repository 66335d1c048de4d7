"""What tests take, most of it compilation: `pytest --costs=FILE` measures, `python tests/costs.py FILE` prints a table by file.

Of each test a line: its name, seconds, of these what JAX traced, what XLA compiled, and how many programs it compiled. What a test starts
as another process counts as seconds alone.
"""

import collections
import contextlib
import pathlib
import sys
import time

TRACED = {"/jax/core/compile/jaxpr_trace_duration", "/jax/core/compile/jaxpr_to_mlir_module_duration"}
COMPILED = "/jax/core/compile/backend_compile_duration"


@contextlib.contextmanager
def measured(file, name):
    """Appends the line of what is done within."""
    import jax

    spent, begin = collections.Counter(), time.perf_counter()

    def listen(event, seconds, **_):
        if event in TRACED:
            spent["traced"] += seconds
        elif event == COMPILED:
            spent["compiled"] += seconds
            spent["programs"] += 1

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
        seconds = time.perf_counter() - begin
        numbers = f"{seconds:.3f}\t{spent['traced']:.3f}\t{spent['compiled']:.3f}\t{spent['programs']}"
        with open(file, "a") as lines:
            lines.write(f"{name}\t{numbers}\n")


def main(path):
    """By file, the longest first."""
    total = collections.defaultdict(lambda: [0.0] * 5)
    for line in pathlib.Path(path).read_text().splitlines():
        name, *numbers = line.split("\t")
        for key in (name.split("::")[0], "all"):
            total[key] = [a + b for a, b in zip(total[key], [1, *map(float, numbers)], strict=True)]
    print(f"{'file':60} tests  seconds   traced compiled programs")
    for key, (tests, seconds, traced, compiled, programs) in sorted(total.items(), key=lambda item: -item[1][1]):
        print(f"{key:60} {tests:5.0f} {seconds:8.1f} {traced:8.1f} {compiled:8.1f} {programs:8.0f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
