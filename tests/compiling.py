"""How tests are compiled, and where that is kept: to be imported before JAX, which reads it of the environment as it is imported.

With the flag that README recommends for a CPU and few of LLVM's optimisations it takes two thirds of the time, which is most of what tests
take. Where XLA_FLAGS is set, if only to nothing, it is taken as it is: so CI runs the fast tests as users run jaxlag. Level 0 beside that
flag is not right: a gradient is off by a third. What is compiled is kept between runs, but not in CI.
"""

import hashlib
import os
import pathlib
import platform
import tempfile
from importlib.metadata import version

KEPT_IN = pathlib.Path.home() / ".cache" / "jaxlag" / "tests"
CACHE, LEAST = "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"


def folder_of_this_machine() -> str:
    """What is compiled with this JAX and these flags for this processor."""
    processor = pathlib.Path("/proc/cpuinfo")
    flags = [line for line in processor.read_text().splitlines() if line.startswith("flags")][:1] if processor.exists() else []
    words = version("jaxlib"), os.environ["XLA_FLAGS"], platform.machine(), flags
    return str(KEPT_IN / hashlib.sha256(repr(words).encode()).hexdigest()[:16])


if "XLA_FLAGS" not in os.environ:
    has_old_emitters = tuple(map(int, version("jaxlib").split(".")[:2])) <= (0, 10)  # an unknown flag would end the process
    os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=1" + " --xla_cpu_use_fusion_emitters=false" * has_old_emitters
if CACHE not in os.environ:  # what one worker has compiled serves all, and the programs that tests start
    if os.environ.get("CI"):
        folder = tempfile.TemporaryDirectory(prefix="jaxlag-tests-")  # removed at the end of the run
        os.environ |= {CACHE: folder.name, LEAST: "0"}
    else:
        os.environ |= {CACHE: folder_of_this_machine(), LEAST: "0.1"}
