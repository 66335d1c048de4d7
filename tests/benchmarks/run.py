"""All speed comparisons in one run, each in its own process; the tables go to `results.json`, which `docs/figures.py` shows.

Peers: pip install -e ".[benchmarks]". A peer that is not installed is listed as skipped.
numbalsoda is not in that extra, because building it needs a Fortran compiler.
Run: python tests/benchmarks/run.py
"""

import subprocess
import sys
from pathlib import Path

TOPICS = ("vehicle", "friction", "devices", "pendulum", "constraints", "bodies", "growth", "first_use", "emitters")


def main():
    for topic in TOPICS:
        subprocess.run([sys.executable, Path(__file__).with_name(f"bench_{topic}.py")], check=True)


if __name__ == "__main__":
    main()
