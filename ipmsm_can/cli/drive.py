"""`ipmsm-can drive`: simulated drives on a CAN bus, in real time."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from ipmsm_can.cli import bus

if TYPE_CHECKING:
    from ipmsm_can.config import DriveConfig
    from ipmsm_can.drive.node import DriveNode
    from ipmsm_can.drive.profile import Profile
    from ipmsm_can.wire.protocol import Protocol

HELP = """\
Put simulated drives on a CAN bus, in real time: samples, status and encoder out, injection commands in.
For a bus that stands on a desk: it transmits, and uses the identifiers of a real drive.
"""
EPILOG = """\
examples:
  ipmsm-can drive -i socketcan -c vcan0                       the paper's motor m2, profile demo
  ipmsm-can drive drive.toml --profile crane.toml -i socketcan -c vcan0 --duration 60
  ipmsm-can drive left.toml right.toml -i socketcan -c vcan0  two drives on one bus
  ipmsm-can drive -i socketcan -c vcan0 --fd                  10 kHz in CAN FD blocks
  ipmsm-can drive -i socketcan -c vcan0 --firmware            through the C library for a drive's microcontroller

a profile file:
  speed_rpm = [[0, 0], [1, 20], [2, 1000]]       breakpoints [s, rpm mechanical]; or speed_rad_s
  load_torque = [[0, 0], [4, 0], [4, 6.2]]       [s, N m], optional
  duration = 8.0                                 s, optional

exit codes: 0 ended by you or at the end of the profile, 1 the bus went away, 2 bad input
"""
_DEFAULT_MOTOR = "m2"
_DEFAULT_PROFILE = "demo"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("configs", nargs="*", metavar="drive.toml",
                        help=f"configuration of a drive, one file each (default: motor {_DEFAULT_MOTOR})")
    parser.add_argument("--profile", default=_DEFAULT_PROFILE, metavar="NAME|FILE.toml",
                        help="speed and load over time: demo, paper_ramp, torque_pulses, or a file (default: demo)")
    parser.add_argument("--duration", type=bus.seconds, metavar="S",
                        help="end after so many seconds; beyond its end a profile's last values hold "
                             "(default: the profile's duration)")
    parser.add_argument("--tick", type=_tick, default=1e-3, metavar="MS",
                        help="time between two looks at the bus, 0.1 to 100 ms (default: 1); the samples of a "
                             "tick are sent at once")
    parser.add_argument("--seed", type=_seed, default=0, metavar="N", help="of the sensor noise (default: 0)")
    parser.add_argument("--theta0", type=_angle, default=0.0, metavar="DEG",
                        help="rotor angle at the start, electrical (default: 0)")
    parser.add_argument("--firmware", action="store_true",
                        help="speak through the C library of firmware_stub, compiled on first use (needs cffi and "
                             "a C compiler); it never probes with more than 30 V")
    parser.add_argument("--quiet", action="store_true", help="no status while it runs, only the summary")
    bus.add_arguments(parser)


def _tick(text: str) -> float:
    return 1e-3 * _number(text, 0.1, 100.0, "a number of ms from 0.1 to 100")


def _angle(text: str) -> float:
    return math.radians(_number(text, -1e6, 1e6, "an angle in degrees"))


def _seed(text: str) -> int:
    return int(_number(text, 0, 2**63, "a whole number of 0 or more", whole=True))


def _number(text: str, low: float, high: float, allowed: str, whole: bool = False) -> float:
    try:
        value = int(text) if whole else float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"it is {text!r}; allowed is {allowed}")
    return value


def main(args: argparse.Namespace) -> int:
    """Drive until the end of the profile or until told to end; returns the exit code."""
    from ipmsm_can.config import config_from, load_configs

    configs = load_configs(args.configs) or (config_from({"motor": {"preset": _DEFAULT_MOTOR}}),)
    bus.check_named(args)

    from ipmsm_can.bus.drive_runner import DriveRunner
    from ipmsm_can.bus.warmup import warm_up_drives
    from ipmsm_can.cli.monitor import DriveMonitor
    from ipmsm_can.config.build import build_protocol

    profile = read_profile(args.profile)
    fd = "fd" in args or any(c.simulation.fd for c in configs)
    protocol = build_protocol(configs)
    with bus.patience():
        warm_up_drives(build_drives(configs, protocol, profile, args.theta0, args.seed, "fd" in args,
                                    args.firmware), protocol)
    drives = build_drives(configs, protocol, profile, args.theta0, args.seed, "fd" in args, args.firmware)
    duration = profile.duration if args.duration is None else args.duration
    with bus.stop_on_signals(duration) as stop, bus.open_bus(args, fd) as port:
        runner = DriveRunner(port, drives, args.tick)
        monitor = DriveMonitor(runner, duration, "ipmsm-can drive" + " --firmware" * args.firmware)
        return bus.serve("drive", lambda: runner.run(stop, monitor.observe), monitor.status, args.quiet)[0]


def read_profile(name: str) -> Profile:
    """A preset by its name, or the profile in a file.

    Raises ValueError for an unknown name or a wrong file.
    """
    from ipmsm_can.drive.profile import PRESETS, Profile

    if name in PRESETS:
        return PRESETS[name]()
    if not Path(name).is_file():
        raise ValueError(f"--profile is {name!r}; allowed is {', '.join(PRESETS)}, or a TOML file that exists")
    return Profile.from_toml(name)


def build_drives(configs: tuple[DriveConfig, ...], protocol: Protocol, profile: Profile, theta_0: float = 0.0,
                 seed: int = 0, fd: bool = False, firmware: bool = False) -> list[DriveNode]:
    """One simulated drive for each configuration; each has noise of its own, from `seed` on.

    theta_0 [rad electrical]; fd: CAN FD for all, whatever simulation.fd says; firmware: through the C library.
    Raises ValueError naming the key where the settings of a drive do not go together, or saying what the C library
    lacks.
    """
    from ipmsm_can.config.build import drive_node_settings, drive_parameters
    from ipmsm_can.drive.node import DriveNode
    from ipmsm_can.drive.simulation import DriveSimulation

    kind: type[DriveNode] = DriveNode
    if firmware:
        from ipmsm_can.drive.firmware import FirmwareNode

        kind = FirmwareNode
    drives = []
    for k, config in enumerate(configs):
        simulation = DriveSimulation(config.build_motor(), drive_parameters(config, fd), profile, theta_0, seed + k)
        drives.append(kind(protocol, config.wire.node, simulation, drive_node_settings(config, fd)))
    return drives
