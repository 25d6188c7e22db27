"""`ipmsm-can replay --map`: a log of any inverter through the estimator, or through the steady-state equations."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ipmsm_can.bus.replay import NodeSummary
    from ipmsm_can.config import DriveConfig
    from ipmsm_can.mapping import MappedBlock, Plan
    from ipmsm_can.mapping.steady import SteadyRows
    from ipmsm_can.mapping.track import MappedTracking

STEADY_COLUMNS = ("time_s", "i_d", "i_q", "v_d", "v_q", "omega_rad_s", "theta_rad", "v_dc", "torque",
                  "torque_model", "power", "psi_m", "v_d_rest", "quality")


def replay_mapped(args: argparse.Namespace) -> int:
    """Replay; returns the exit code.  The log is read twice: what it allows is known only at its end."""
    from ipmsm_can.bus.rows import check_rows_path
    from ipmsm_can.config import load_configs
    from ipmsm_can.logs import read_log
    from ipmsm_can.mapping import load_map, make_plan
    from ipmsm_can.mapping.check import abilities, doubtful, missing, wrong_bus
    from ipmsm_can.mapping.survey import Survey

    if len(args.drive) != 1:
        raise ValueError(f"--map takes one --drive, and there are {len(args.drive)}")
    config = load_configs(args.drive)[0]
    out = None if args.out is None else Path(args.out)
    if out is not None:
        check_rows_path(out)
        inputs = [Path(args.log), Path(args.drive[0])]
        if any(out.exists() and given.exists() and out.samefile(given) for given in inputs):
            raise ValueError(f"--out {out} is one of the input files; allowed is another file")
    inverter = load_map(args.map)
    plan = make_plan(inverter, node=args.node, pole_pairs=config.build_motor().pole_pairs)
    survey = Survey(plan, config.wire.sample_rate)
    survey.run(read_log(Path(args.log), channel=args.channel))
    if not survey.found:
        raise ValueError(wrong_bus(survey, args.log))
    if not survey.rows:
        raise ValueError(f"{args.log} holds no sample of the map {args.map}; `ipmsm-can map --check` says why")
    for sentence in (*missing(survey), *doubtful(survey)):
        print(f"note: {sentence}")
    reader = read_log(Path(args.log), channel=args.channel)
    fast, steady = abilities(survey)[:2]
    if fast.able:
        print(f"fast observer: {fast.why}")
        _track(config, plan, survey.rate, reader, out)
    else:
        if not steady.able:
            raise ValueError(f"{args.log} with the map {args.map} allows neither the fast observer ({fast.why}) "
                             f"nor steady-state checks ({steady.why})")
        print(f"no fast observer: {fast.why}")
        _steady(config, plan, survey.rate, reader, out)
    if reader.problem or reader.bad_lines:
        told = reader.problem or f"{args.log} is damaged: {reader.bad_lines} of its lines cannot be read"
        print(f"ipmsm-can replay: {told}; what was readable is replayed", file=sys.stderr)
        return 2
    return 0


def _blocks(plan: Plan, rate: float, reader: Any) -> Any:
    from ipmsm_can.mapping import Mapper

    mapper = Mapper(plan, rate)
    for block in reader:
        yield mapper.feed(block)
    yield mapper.flush()


def _track(config: DriveConfig, plan: Plan, rate: float, reader: Any, out: Path | None) -> None:
    from ipmsm_can.bus.rows import open_rows
    from ipmsm_can.mapping.track import MappedTracking

    file = None if out is None else open_rows(out)
    try:
        tracking = MappedTracking(config, plan.map, rate, None if file is None else file.write)
        for block in _blocks(plan, rate, reader):
            tracking.feed(block)
    finally:
        if file is not None:
            file.close()
    print("\n".join(_lines(tracking, tracking.summary)))
    if out is not None:
        print(f"wrote {out}")


def _lines(tracking: MappedTracking, s: NodeSummary) -> list[str]:
    def when(what: str, at: float | None) -> str:
        return f"never {what}" if at is None else f"first {what} at {at:.3f} s"

    lines = [f"{s.rows} samples over {s.duration:.3f} s at {s.sample_rate:.6g} Hz",
             f"  wire       {tracking.lost} lost, {tracking.filled} of them filled; "
             f"{tracking.unusable} unusable (impossible, incomplete, or reported too far apart)"]
    if not s.rows:
        return lines
    lines.append(f"  lock       {when('locked', s.first_locked)}, locked {100.0 * s.locked / s.rows:.1f} %; "
                 f"{when('valid', s.first_valid)}, valid {100.0 * s.valid / s.rows:.1f} % of the samples")
    timing = tracking.estimator.voltage_delay.words
    if timing:
        lines.append(f"  timing     {timing}")
    e = s.encoder
    if e.compared:
        lines.append(f"  encoder    error {math.degrees(e.rms):.3f} deg rms, {math.degrees(e.largest):.3f} deg at "
                     f"most (electrical), at {e.compared} valid samples")
    else:
        lines.append(f"  encoder    {e.references} measured angles, none at a valid sample" if e.references
                     else "  encoder    no measured angle to compare with")
    return lines


def _steady(config: DriveConfig, plan: Plan, rate: float, reader: Any, out: Path | None) -> None:
    from ipmsm_can.mapping.steady import SteadyState

    if out is not None and out.suffix != ".csv":
        raise ValueError(f"--out is {out}; steady-state quantities are written as .csv only")
    state = SteadyState(config.build_motor(), plan.map)
    if out is None:
        for block in _blocks(plan, rate, reader):
            state.feed(block)
    else:
        with out.open("w", encoding="utf-8") as file:
            file.write(",".join(STEADY_COLUMNS) + "\n")
            for block in _blocks(plan, rate, reader):
                _write(file, block, state.feed(block))
    print("\n".join(["steady-state quantities only:", *(f"  {line}" for line in state.words())]))
    if out is not None:
        print(f"wrote {out}")


def _write(file: Any, b: MappedBlock, s: SteadyRows) -> None:
    import numpy as np

    np.savetxt(file, np.stack([s.time_s, b.i_d, b.i_q, b.v_d, b.v_q, b.turning, b.theta_e, b.v_dc, b.torque,
                               s.torque_model, s.power, s.psi_m, s.v_d_rest, b.quality], axis=1),
               fmt="%.10g", delimiter=",")
