"""`ipmsm-can demo`: a simulated drive and the companion on one bus, a live status, a summary, a plot."""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ipmsm_can.cli import bus

if TYPE_CHECKING:
    from ipmsm_can.bus.port import Port
    from ipmsm_can.cli.demo_sides import Outcome, Setting

HELP = """\
See it work: a simulated drive (the paper's experiment motor, M2) and the companion on one bus.

From standstill through 20, 100 and 1000 rpm, a reversal, and back to standstill, with load steps; then a
summary against the drive's encoder, and a plot.  On vcan0 where there is one, with the drive in a process of
its own; else on a bus inside this program.  No other bus is touched unless you name it.
"""
EPILOG = """\
examples:
  ipmsm-can demo                                   16 s in real time; plot in out/demo.html and out/demo.png
  ipmsm-can demo --fast                            the same in virtual time, without a bus
  ipmsm-can demo --fd                              CAN FD blocks, 10 kHz samples
  ipmsm-can demo -i socketcan -c can0              on a bus of yours; both sides transmit there

exit codes: 0 it locked and no frame was lost, 1 something was wrong (it says what), 2 bad input
"""
SHORTEST_S, LONGEST_S = 3.0, 300.0
_SPARE_S = 5.0
"""How long the companion waits beyond the duration for samples that do not come."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--duration", type=float, default=None, metavar="S",
                        help="how long [s], 3 to 300 (default: the profile's 16)")
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR",
                        help="where demo.html and demo.png go (default: ./out)")
    parser.add_argument("--fast", action="store_true", help="in virtual time, as fast as the machine goes, no bus")
    parser.add_argument("--seed", type=int, default=1, metavar="N",
                        help="of the sensor noise and the rotor's first angle (default: 1)")
    bus.add_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Run the demo; returns the exit code."""
    from ipmsm_can.cli.demo_sides import Setting, run_in_virtual_time, warm_up
    from ipmsm_can.drive.profile import demo

    duration = demo().duration if args.duration is None else args.duration
    if not SHORTEST_S <= duration <= LONGEST_S:
        raise ValueError(f"--duration is {duration:g} s; allowed is {SHORTEST_S:g} to {LONGEST_S:g} s")
    if args.seed < 0:
        raise ValueError(f"--seed is {args.seed}; allowed is 0 or more")
    args.out.mkdir(parents=True, exist_ok=True)
    setting = Setting(fd=bool(getattr(args, "fd", False)), seed=args.seed, duration=duration)
    begin = time.monotonic()
    if args.fast:
        with bus.patience():
            warm_up(setting)
        print(f"Drive and companion in virtual time, {duration:g} s, no bus.", flush=True)
        outcome = run_in_virtual_time(setting)
    else:
        with choose_bus(args) as port:
            if setting.fd and not port.fd:
                raise ValueError(f"{port.description} does not pass CAN FD frames; "
                                 "leave --fd out, or give the interface an mtu of 72")
            with bus.patience():
                warm_up(setting)
            outcome = _live(args, setting, port)
    took = time.monotonic() - begin
    return finish(setting, outcome, args.out, f"{'Simulated' if args.fast else 'Ran'} in {took:.1f} s.")


def choose_bus(args: argparse.Namespace) -> Port:
    """The bus that was named; else vcan0, if it is there and up; else a virtual bus in this program."""
    from ipmsm_can.bus.port import BusError, open_port

    if hasattr(args, "interface") or hasattr(args, "channel"):
        return bus.open_bus(args)
    if Path("/sys/class/net/vcan0").exists():
        args.interface, args.channel = "socketcan", "vcan0"
        try:
            return open_port(vars(args))
        except BusError as error:
            print(f"vcan0 cannot be used: {error}.", file=sys.stderr)
    args.interface, args.channel = "virtual", "ipmsm-can-demo"
    return open_port(vars(args))


def _live(args: argparse.Namespace, setting: Setting, port: Port) -> Outcome:
    from ipmsm_can.bus.live import LiveRunner
    from ipmsm_can.bus.port import BusError, open_port
    from ipmsm_can.cli.demo_sides import Outcome, ProcessDrive, ThreadDrive
    from ipmsm_can.cli.monitor import RunMonitor
    from ipmsm_can.cli.screen import Screen
    from ipmsm_can.cli.status import RunStatus
    from ipmsm_can.companion import Companion
    from ipmsm_can.report.recorder import Recorder
    from ipmsm_can.report.summary import QUANTILES, BusFigures

    config, protocol = setting.config(), setting.protocol()
    companion = Companion([config], protocol, transmit=True)
    runner = LiveRunner(port, companion, *bus.bit_rates(args, [config]))
    recorder = Recorder(companion, config.wire.node)

    inside = getattr(args, "interface", None) == "virtual"
    name = "python-can's virtual bus, inside this program" if inside else port.description
    where = "a thread" if inside else "a process of its own"
    print(f"Drive and companion on {name}; the drive in {where}. {setting.duration:g} s.", flush=True)

    def status() -> RunStatus:
        off = math.degrees(recorder.latest_error)
        known = f", off by {off:+.2f}°" if math.isfinite(off) else ""
        monitor.title = f"ipmsm-can demo {recorder.seconds:.0f}/{setting.duration:g} s{known}"
        return monitor.status()

    went_away = ""
    drive = ThreadDrive(setting, open_port(vars(args))) if inside else ProcessDrive(setting, vars(args))
    with drive, bus.stop_on_signals(setting.duration + _SPARE_S) as stop:
        monitor = RunMonitor(runner)
        drive.go()
        with Screen(status):
            try:
                runner.run(lambda: stop() or recorder.seconds >= setting.duration or drive.failed,
                           recorder.observe)
            except BusError as error:
                went_away = str(error)
    result = drive.finish()
    trouble = [t for t in (went_away and f"the bus went away: {went_away}", result.error,
                           stop.name and f"ended early by {stop.name}") if t]
    p50, p99, p999 = runner.turnaround.quantiles(QUANTILES).tolist()
    figures = BusFigures(name, port.drops, port.unsent + result.unsent, (p50, p99, p999), result.rejected)
    if result.slips or (not trouble and recorder.seconds < setting.duration - 0.5):
        print(f"note: this machine was too slow for real time; {recorder.seconds:.1f} of {setting.duration:g} s "
              "were simulated.", file=sys.stderr)
    return Outcome(recorder.record(), companion.nodes[config.wire.node], figures, setting.theta_0, trouble)


def finish(setting: Setting, outcome: Outcome, out: Path, how: str) -> int:
    """Print the summary, write page and picture; returns the exit code."""
    from ipmsm_can.drive.profile import demo
    from ipmsm_can.report import figure, page, png, summary

    s = summary.summarise(outcome.record, outcome.node, outcome.bus)
    motor = setting.config().build_motor()
    faults = [*outcome.trouble, *s.faults()]
    headline = (f"Motor {motor.name.upper()}, {motor.pole_pairs} pole pairs, rated {motor.rated_torque:g} N m, "
                f"on {outcome.bus.name}. The rotor began at {math.degrees(outcome.theta_0):.0f}° electrical, "
                f"which only the encoder knew; the companion had {s.sample_rate:g} current and voltage samples a "
                "second to find it with.")
    parts = figure.panels(outcome.record, s, motor, demo())
    footer = f"ipmsm-can demo{' --fd' if setting.fd else ''} --seed {setting.seed}. {how}"
    html, picture = out / "demo.html", out / "demo.png"
    html.write_text(page.build(parts, s, faults, headline, footer), encoding="utf-8")
    png.save(parts, picture, f"ipmsm-can demo on {outcome.bus.name}")

    print(f"\n{summary.text(s)}\n\n  plot: {html} and {picture}\n")
    if faults:
        print("Something was wrong: " + "; ".join(faults) + ".")
        return 1
    print("All well: it locked, and no frame was lost.")
    return 0
