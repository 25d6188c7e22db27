"""`make bench`: one table, everything side by side in one run.

    python -m tools.bench               everything; the part on a bus by tools/vcan/run, 10 s a subject
    python -m tools.bench --seconds 60  the same with a minute of traffic
    python -m tools.bench --no-bus      what needs no bus
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from tools.bench import offline

NO_VCAN = 77


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--no-bus", action="store_true")
    args = parser.parse_args()
    offline.main()
    if args.no_bus:
        return 0
    print(flush=True)
    runner = Path(__file__).resolve().parents[1] / "vcan" / "run"
    done = subprocess.run([str(runner), sys.executable, "-m", "tools.bench.on_bus", "--seconds", str(args.seconds)],
                          check=False)
    if done.returncode == NO_VCAN:
        print("the part on a real CAN interface was left out: none can be had here")
        return 0
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
