"""CPU time that is really used: nanoseconds from schedstat, of a process with its threads, or of a whole tree.

Some kernels account CPU time by sampling at the tick, which is blind to a process that runs between ticks; User-
Mode Linux is one.  There the whole guest is a tree of processes of the host, whose kernel counts properly: the
measurement inside prints marks, and whoever started the guest reads the tree's CPU time at each mark.
"""

from __future__ import annotations

from pathlib import Path

_FINEST_TICK_NS = 1_000_000


def of_process(pid: int) -> float:
    """CPU seconds of a process so far, all threads; 0 when it is gone."""
    total = 0
    for thread in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        try:
            total += int(thread.read_text().split()[0])
        except (OSError, IndexError):
            continue
    return 1e-9 * total


def of_tree(root: int) -> float:
    """CPU seconds of a process and everything that descends from it and still lives."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
        except (OSError, IndexError):
            continue
        children.setdefault(parent, []).append(int(stat.parent.name))
    tree, seen = [root], 0
    while seen < len(tree):
        tree += children.get(tree[seen], [])
        seen += 1
    return sum(of_process(pid) for pid in tree)


def is_counted_by_tick() -> bool:
    """Whether this kernel only counts whole ticks of 1 ms or more."""
    seen = {int(Path("/proc/self/schedstat").read_text().split()[0]) for _ in range(3000)}
    steps = [b - a for a, b in zip(sorted(seen), sorted(seen)[1:], strict=False)]
    return not steps or min(steps) >= _FINEST_TICK_NS
