"""The companion as the measurements on a bus run it: `python -m tools.bench.companion vcan0`.

The same LiveRunner, Companion and port as `ipmsm-can run --transmit`, without the display.  Ends on SIGTERM and
prints frames received, estimates sent, samples lost, kernel drops, and its own turnaround quantiles.
"""

from __future__ import annotations

import argparse
import signal
from typing import Any

import numpy as np

from ipmsm_can.bus.live import LiveRunner
from ipmsm_can.bus.socketcan import SocketCanPort
from ipmsm_can.bus.warmup import warm_up_companion
from ipmsm_can.companion import Companion
from ipmsm_can.config import config_from
from ipmsm_can.wire.protocol import Protocol


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("channel")
    parser.add_argument("--silent", action="store_true", help="only listen")
    parser.add_argument("--observer", default="riccati", help="its kind")
    args = parser.parse_args()
    config = config_from({"motor": {"preset": "m2"}, "observer": {"kind": args.observer},
                          "injection": {"enabled": False}})
    warm_up_companion([config], Protocol())
    companion = Companion([config], Protocol(), transmit=not args.silent)
    stopping = False

    def stop(*_: Any) -> None:
        nonlocal stopping
        stopping = True

    signal.signal(signal.SIGTERM, stop)
    with SocketCanPort(args.channel) as port:
        runner = LiveRunner(port, companion, 1e6, 5e6)
        print("ready", flush=True)
        runner.run(lambda: stopping)
        node = companion.nodes[0]
        q = np.nan_to_num(runner.turnaround.quantiles((0.5, 0.99, 0.999)))
        print(companion.counts.frames, node.view.estimates, node.receiver.sequencer.count("lost"), port.drops,
              *(round(1e6 * x) for x in q), flush=True)


if __name__ == "__main__":
    main()
