"""`make bench`: one table, everything side by side in one run.

    python -m tools.bench               everything; the part on a bus by tools/vcan/run, 10 s a subject
    python -m tools.bench --seconds 60  the same with a minute of traffic
    python -m tools.bench --no-bus      what needs no bus; --only-bus: the rest
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

from tools.bench import cpu, offline
from tools.bench.on_bus import MARK

NO_VCAN = 77


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--no-bus", action="store_true")
    parser.add_argument("--only-bus", action="store_true")
    parser.add_argument("--only", default="", help="some subjects on the bus, by comma; see tools.bench.on_bus")
    args = parser.parse_args()
    if not args.only_bus:
        offline.main()
    if args.no_bus:
        return 0
    print(flush=True)
    return on_bus(args.seconds, args.only)


def on_bus(seconds: float, only: str) -> int:
    """The part on a bus, in whatever tools/vcan/run provides; reads the CPU time at its marks."""
    runner = Path(__file__).resolve().parents[1] / "vcan" / "run"
    process = subprocess.Popen([str(runner), sys.executable, "-m", "tools.bench.on_bus", "--seconds", str(seconds),
                                *(["--only", only] if only else [])], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    stretches: list[tuple[str, float, float]] = []  # name, CPU seconds, length
    frames: dict[str, int] = {}
    begin = (0.0, 0.0)
    for line in process.stdout:
        words = line.split()
        if words[:1] != [MARK]:
            print(line, end="", flush=True)
        elif words[1] == "begin":
            begin = (cpu.of_tree(process.pid), time.monotonic())
        elif words[1] == "end":
            stretches.append((" ".join(words[2:]), cpu.of_tree(process.pid) - begin[0],
                              time.monotonic() - begin[1]))
        else:
            frames[" ".join(words[3:])] = int(words[2])
    code = process.wait()
    if code == NO_VCAN:
        print("the part on a real CAN interface was left out: none can be had here")
        return 0
    if stretches:
        cpu_table(stretches, frames)
    return code


def cpu_table(stretches: list[tuple[str, float, float]], frames: dict[str, int]) -> None:
    """CPU time of each subject: its stretch less the mean of the stretches without a subject around it."""
    print(f"\n{'CPU time, counted outside the guest':36s} {'us/frame':>9s} {'CPU %':>7s} {'traffic alone %':>16s}")
    for k, (name, used, length) in enumerate(stretches):
        if name == "nobody":
            continue
        alone = [100 * s[1] / s[2] for s in stretches[max(0, k - 1):k + 2] if s[0] == "nobody"]
        share = 100 * used / length - sum(alone) / len(alone)
        print(f"{name:36s} {1e4 * share * length / max(1, frames[name]):9.1f} {share:7.1f} "
              f"{alone[0]:8.1f} {alone[-1]:7.1f}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
