"""Eats what is left of one processor and counts it: `python -m tools.bench.soaker FILE`.

Some kernels account CPU time by sampling at the tick, which is blind to a process that runs between ticks (User-
Mode Linux is one).  What a process at idle priority gets done in the meantime is not blind: the share it loses
is the share the others used.
"""

from __future__ import annotations

import mmap
import os
import struct
import sys
from pathlib import Path


def main() -> None:
    """Count into the first eight bytes of FILE until killed."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    with Path(sys.argv[1]).open("r+b") as file, mmap.mmap(file.fileno(), 8) as shared:
        print("ready", flush=True)
        count = 0
        while True:
            for _ in range(200):
                pass
            count += 1
            struct.pack_into("<q", shared, 0, count)


if __name__ == "__main__":
    main()
