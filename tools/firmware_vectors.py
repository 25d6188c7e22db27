"""Vectors that bind the C library to the Python package: `python -m tools.firmware_vectors`.

From the package comes tests/firmware/vectors.json: what goes in, and what the package makes of it.  From that
file alone comes firmware_stub/tests/vectors.h, the same as C tables, so that a microcontroller without a file
system can check itself.  The Python tests hold the file against the package, the C tests the library against
the tables.

Bytes, counters, CRCs and verdicts are exact.  Physical values in are single-precision numbers that keep clear
of the halfway point between two codes, where single and double precision may round apart.  Physical values out
are the package's, in double precision; what the C may differ by stands in the C tests.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ipmsm_can.drive import profile
from ipmsm_can.drive.node import COMMANDS_MISSED, DriveNode, DriveNodeSettings
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.frames import CAN_EFF_FLAG, FrameBlock
from ipmsm_can.motor import M2
from ipmsm_can.wire.e2e import E2EProtection, SequenceChecker
from ipmsm_can.wire.protocol import BLOCK_SAMPLES, MessageKind, Protocol
from tools.firmware_tables import tables

ROOT = Path(__file__).resolve().parents[1]
VECTORS = ROOT / "tests" / "firmware" / "vectors.json"
TABLES = ROOT / "firmware_stub" / "tests" / "vectors.h"

Json = dict[str, Any]
_AXES = ("i_alpha", "i_beta", "v_alpha", "v_beta")
_CLEAR_OF_HALFWAY = 0.01  # of a code
_PROTOCOL = Protocol()


def _single(values: Any) -> Any:
    return np.asarray(values, np.float32).astype(np.float64)


def _number(value: float) -> float | str:
    """JSON has no NaN and no infinity."""
    return float(str(np.float32(value))) if math.isfinite(value) else str(float(value))


def _payload(row: Any) -> str:
    return bytes(row[8:8 + int(row[4])]).hex()


def _clear(kind: MessageKind, signal: str, values: Any) -> Any:
    """The values as single-precision numbers, moved off the halfway point between two codes."""
    codec = _PROTOCOL.codecs[kind]
    layout = codec.layouts[codec.index[signal]]
    out = _single(values)
    codes = (np.clip(np.nan_to_num(out), -1e6, 1e6) - layout.offset) / layout.scale
    near = np.abs(codes - np.floor(codes) - 0.5) < _CLEAR_OF_HALFWAY
    return np.where(near, _single(out + 0.2 * layout.scale), out)


def _crcs(rng: np.random.Generator) -> Json:
    eights, sixteens = [], []
    for n in range(24):
        payload = FrameBlock.zeros(1)
        payload.length[:] = 8
        payload.data[0, :8] = 0 if n < 3 else rng.integers(0, 256, 8)
        ids = bytes(range(1, 17)) if n < 3 else bytes(rng.integers(0, 256, 16, dtype=np.uint8))
        counter = n % 16 + 1 if n < 3 else n % 16
        E2EProtection.p02(8, ids).protect(payload.raw, np.array([counter]))
        eights.append({"payload": _payload(payload.raw[0]), "data_id": ids[counter]})
        length = 8 if n < 2 else 64
        payload = FrameBlock.zeros(1)
        payload.length[:] = length
        payload.data[0, :length] = 0 if n < 2 else rng.integers(0, 256, length)
        data_id = 0x1234 if n < 2 else int(rng.integers(0, 65536))
        E2EProtection.p05(length, data_id).protect(payload.raw, np.array([n]))
        sixteens.append({"payload": _payload(payload.raw[0]), "data_id": data_id})
    return {"crc8": eights, "crc16": sixteens}


def _sequence(rng: np.random.Generator) -> Json:
    steps = np.concatenate([np.arange(16), rng.choice([1, 1, 1, 2, 0, 15, 8, 7], 80)])
    counters = np.cumsum(steps) % 16
    checker = SequenceChecker(16, COMMANDS_MISSED)
    status = checker.update(np.ones(counters.size, np.bool_), counters)
    return {"counter": counters.tolist(), "status": status.tolist(), "lost": checker.lost}


def _samples(rng: np.random.Generator) -> list[Json]:
    kind = MessageKind.DRIVE_SAMPLE
    values = np.concatenate([rng.uniform(-80.0, 80.0, (24, 2)), rng.uniform(-400.0, 400.0, (24, 2))], axis=1)
    values[:9] = [[0, 0, 0, 0], [81.915, -81.92, 409.575, -409.6], [-81.92, 81.915, -409.6, 409.575],
                  [1e6, -1e6, 1e30, -1e30], [math.inf, -math.inf, -math.inf, math.inf], [math.nan] * 4,
                  [-0.0, 1e-30, 0.001, -0.001], [0.004, -0.004, 0.02, -0.02], [82, -82, 410, -410]]
    out = []
    for n, row in enumerate(values):
        row = np.array([_clear(kind, axis, x) for axis, x in zip(_AXES, row, strict=True)])
        node, counter = n % 16, int(rng.integers(0, 2**32))
        raw = _PROTOCOL.encode(kind, node, {**dict(zip(_AXES, row, strict=True)), "sample_counter": counter & 15})
        out.append({"node": node, "counter": counter, "values": [_number(x) for x in row],
                    "frame": _payload(raw[0])})
    return out


def _blocks(rng: np.random.Generator) -> list[Json]:
    kind = MessageKind.DRIVE_SAMPLE_BLOCK
    out = []
    for n, (node, first, counter) in enumerate([(0, 0, 0), (0, 7, 1), (3, 2**32 - 3, 255), (15, 123456789, 128),
                                                (9, 2**31 - 1, 77), (1, 70_000, 5)]):
        values = np.concatenate([rng.uniform(-160.0, 160.0, (7, 2)), rng.uniform(-800.0, 800.0, (7, 2))], axis=1)
        if n == 4:
            values[:4] = [[1e9, -1e9, 1e9, -1e9], [math.nan] * 4, [163.835, -163.84, 819.175, -819.2], [0] * 4]
        values = np.column_stack([_clear(kind, f"{axis}_0", values[:, a]) for a, axis in enumerate(_AXES)])
        named = {f"{axis}_{j}": values[j, a] for a, axis in enumerate(_AXES) for j in range(BLOCK_SAMPLES)}
        raw = _PROTOCOL.encode(kind, node, {**named, "first_sample": first, "sample_count": BLOCK_SAMPLES}, counter)
        out.append({"node": node, "first": first, "e2e_counter": counter,
                    "values": [[_number(x) for x in row] for row in values], "frame": _payload(raw[0])})
    return out


def _background(rng: np.random.Generator) -> Json:
    timing, status, reference = [], [], []
    for n, rate in enumerate([5000.0, 10_000.0, 20_000.0, 2500.0, 16_000.0, 12_500.0, 100.0, 1e6]):
        counter = int(rng.integers(0, 2**32)) if n else 2**32 - 1
        raw = _PROTOCOL.encode(MessageKind.DRIVE_TIMING, n, {"sample_counter": counter, "sample_rate": rate})
        timing.append({"node": n, "counter": counter, "rate": rate, "frame": _payload(raw[0])})
    for n, (v_dc, temperature) in enumerate([(540.0, 40.0), (0.0, -128.0), (1e6, 500.0), (-5.0, -500.0),
                                             (311.23, 24.7), (48.0, math.nan)]):
        mode, faults, encoder = n % 5, int(rng.integers(0, 256)), n % 2
        waveform, rejected = n % 4, int(rng.integers(0, 256))
        v_dc, temperature = (float(_clear(MessageKind.DRIVE_STATUS, *x)) for x in
                             (("v_dc", v_dc), ("temperature", temperature)))
        raw = _PROTOCOL.encode(MessageKind.DRIVE_STATUS, n, {
            "mode": mode, "active_waveform": waveform, "encoder_available": encoder, "faults": faults,
            "v_dc": v_dc, "temperature": temperature, "protocol_version": 1, "rejected_commands": rejected})
        status.append({"node": n, "mode": mode, "waveform": waveform, "encoder": encoder, "faults": faults,
                       "v_dc": _number(v_dc), "temperature": _number(temperature), "rejected": rejected,
                       "frame": _payload(raw[0])})
    kind = MessageKind.DRIVE_REFERENCE
    angles = [0.0, 1.0, -1.0, math.pi, 6.2831, 6.28314, 6.28318, 6.2832, -1e-6, 9.0, -700.0, math.nan, 1e12]
    for n, angle in enumerate(angles):
        # beyond some turns single precision keeps less of the angle than the wire has room for
        theta = _clear(kind, "theta_e", round(angle / 0.01) * 0.01 if abs(angle) > 7.0 else angle)
        omega = float(_clear(kind, "omega_e", rng.uniform(-9000.0, 9000.0)))
        sample = int(rng.integers(0, 2**32))
        turned = 0.0 if not abs(angle) < 1e6 else _PROTOCOL.angle(kind, "theta_e", theta)
        raw = _PROTOCOL.encode(kind, n, {"theta_e": turned, "omega_e": omega, "sample_counter": sample})
        exact = abs(angle) <= 7.0 or not abs(angle) < 1e6
        reference.append({"node": n, "theta": _number(float(theta)), "omega": _number(omega), "sample": sample,
                          "theta_codes_apart": 0 if exact else 1, "frame": _payload(raw[0])})
    return {"timing": timing, "status": status, "reference": reference}


def _estimates(rng: np.random.Generator) -> list[Json]:
    kind = MessageKind.POSITION_ESTIMATE
    signals = _PROTOCOL.codecs[kind].signals
    checkers = {node: SequenceChecker(16, COMMANDS_MISSED) for node in (0, 6)}
    counters = dict.fromkeys(checkers, 0)
    out = []
    for n in range(60):
        node = (0, 6)[n % 2]
        counters[node] += int(rng.choice([1, 1, 1, 2, 0, 15, 9])) if n > 6 else 1
        latest = (2**32 - 20 + 13 * n) % 2**32
        named = latest - int(rng.integers(0, 100))
        raw = _PROTOCOL.encode(kind, node, {
            "theta_e": rng.uniform(0.0, 6.28), "omega_e": rng.uniform(-8000.0, 8000.0),
            "sigma_theta": 127.5 if n % 10 == 9 else rng.uniform(0.0, 120.0), "sample_counter": named & 1023,
            **{name: float(rng.integers(0, 2)) for name in ("valid", "locked", "polarity_known", "injecting")}},
            counters[node])
        if n % 9 == 8:
            raw[0, 8 + n % 8] ^= 1 << (n % 7)
        values, intact, found = _PROTOCOL.decode(kind, node, raw)
        (status,) = checkers[node].update(intact, found).tolist()
        row = dict(zip(signals, values[:, 0].tolist(), strict=True))
        out.append({"node": node, "latest": latest, "frame": _payload(raw[0]), "status": status,
                    "named": named % 2**32, **{name: row[name] for name in ("theta_e", "omega_e", "sigma_theta")},
                    **{name: int(row[name]) for name in ("valid", "locked", "polarity_known", "injecting")}})
    return out


def _extrapolations(rng: np.random.Generator) -> list[Json]:
    out = []
    for n in range(40):
        theta, omega = _single(rng.uniform(0.0, 6.28)), _single(rng.uniform(-8000.0, 8000.0))
        elapsed = _single((0.0, 1e-4, 1e-3, 0.05)[n % 4] * rng.uniform())
        out.append({"theta": _number(theta), "omega": _number(omega), "elapsed": _number(elapsed),
                    "expected": float((theta + omega * elapsed) % math.tau)})
    return out


class _Script:
    """A simulated drive that is sent commands, and what it then puts out, sample by sample."""

    def __init__(self, node: int, rate: float, limit: float, ramp: float) -> None:
        parameters = DriveParameters(sample_rate=rate, injection_limit=limit, injection_ramp=ramp, substeps=1,
                                     current_bandwidth=rate / 50.0, speed_bandwidth=rate / 500.0)
        self.node, self.rate, self.limit, self.ramp = node, rate, limit, ramp
        self._drive = DriveNode(_PROTOCOL, node, DriveSimulation(M2, parameters, profile.torque_pulses()),
                                DriveNodeSettings())
        self._events: list[Json] = []
        self._at = 0
        self._parts: list[Any] = []

    def command(self, counter: int, *, made_for: int | None = None, sent_to: int | None = None,
                flip: int | None = None, extended: bool = False, length: int = 8, **values: float) -> None:
        """Send a command before the next sample.

        made_for, sent_to: node whose data identifiers and whose identifier it has, if not this one.
        flip: a bit of the payload to turn over.
        """
        signals = {"waveform": 1.0, "amplitude": 5.0, "frequency": 400.0, "axis_angle": 0.0, "time_to_live": 40.0}
        raw = _PROTOCOL.encode(MessageKind.INJECTION_COMMAND, self.node if made_for is None else made_for,
                               {**signals, **values}, counter)
        can_id = 0x220 + (self.node if sent_to is None else sent_to)
        raw.view(np.uint32)[:, 0] = can_id | (CAN_EFF_FLAG if extended else 0)
        if flip is not None:
            raw[0, 8 + flip // 8] ^= 1 << flip % 8
        raw[0, 4] = length
        self._events.append({"at": self._at, "id": can_id, "extended": int(extended), "frame": _payload(raw[0])})
        self._drive.receive(FrameBlock(raw, np.zeros(1, np.int64)))

    def run(self, n: int) -> None:
        self._at += n
        self._parts.append(self._drive.step(n).samples)

    def result(self) -> Json:
        total, rejected = self._at, self._drive.rejected
        self.run(2)  # a voltage shows in the samples two periods after it was decided

        def all_of(name: str) -> Any:
            return np.concatenate([getattr(part, name) for part in self._parts])

        return {"node": self.node, "rate": self.rate, "limit": self.limit, "ramp": self.ramp, "rejected": rejected,
                "events": self._events, "waveform": all_of("injection_waveform")[:total].astype(int).tolist(),
                "amplitude": np.round(all_of("injection_amplitude")[:total], 7).tolist(),
                "v_alpha": np.round(all_of("v_inj_alpha")[2:], 7).tolist(),
                "v_beta": np.round(all_of("v_inj_beta")[2:], 7).tolist()}


def _probing(rng: np.random.Generator) -> list[Json]:
    runs_out = _Script(0, 5000.0, 30.0, 1037.0)
    runs_out.command(0, axis_angle=0.7, time_to_live=20.0)
    runs_out.run(130)
    runs_out.command(1, amplitude=8.0, frequency=2500.0, time_to_live=10.0)
    runs_out.run(60)
    runs_out.command(2, time_to_live=0.0)
    runs_out.run(10)

    switches = _Script(4, 10_000.0, 30.0, 2500.0)
    orders: list[dict[str, Any]] = [
        {"waveform": 2.0, "amplitude": 6.0, "axis_angle": 1.1}, {"waveform": 2.0, "amplitude": 3.0},
        {"waveform": 3.0, "amplitude": 7.0, "frequency": 250.0, "axis_angle": 4.0},
        {"waveform": 3.0, "amplitude": 7.0, "frequency": 1900.0, "axis_angle": 5.9},
        {"waveform": 1.0, "amplitude": 2.0}, {"waveform": 1.0, "amplitude": 0.0},
        {"waveform": 1.0, "amplitude": 2.0}, {"waveform": 0.0, "amplitude": 100.0, "frequency": 0.0}]
    for counter, values in enumerate(orders):
        switches.command(counter, **values)
        switches.run(60)

    forged = _Script(15, 20_000.0, 12.0, 9000.0)
    forged.command(3, amplitude=204.75, frequency=1.0)
    forged.run(40)
    forged.command(4, waveform=5.0)
    forged.command(5, frequency=0.0)
    forged.command(6, amplitude=20.0, flip=21)
    forged.command(6, amplitude=1.0, frequency=900.0)
    forged.run(20)
    forged.command(6, amplitude=9.0)
    forged.command(4, amplitude=9.0)
    forged.command(5, made_for=14, amplitude=9.0)
    forged.command(5, made_for=14, sent_to=14, waveform=0.0)
    forged.command(5, extended=True, amplitude=9.0)
    forged.command(5, length=7, amplitude=9.0)
    forged.run(20)
    forged.command(5, waveform=3.0, amplitude=9.0, frequency=4095.0)
    forged.run(60)

    wild = _Script(7, 16_000.0, 25.0, 7013.0)
    counter = 0
    for _ in range(45):
        counter += int(rng.choice([1, 1, 1, 1, 3, 0, 14]))
        wild.command(counter, waveform=float(rng.integers(0, 5)), amplitude=rng.uniform(0.0, 40.0),
                     frequency=float(rng.integers(0, 4096)), axis_angle=rng.uniform(0.0, 6.28),
                     time_to_live=rng.uniform(0.0, 4.0),
                     flip=int(rng.integers(0, 64)) if rng.uniform() < 0.1 else None)
        wild.run(int(rng.integers(1, 40)))
    return [script.result() for script in (runs_out, switches, forged, wild)]


def build() -> Json:
    """The document, made anew from the package."""
    rng = np.random.default_rng(20240229)
    return {**_crcs(rng), "sequence": _sequence(rng), "samples": _samples(rng), "blocks": _blocks(rng),
            **_background(rng), "estimates": _estimates(rng), "extrapolations": _extrapolations(rng),
            "probing": _probing(rng)}


def to_text(document: Json) -> str:
    """JSON with one vector a line; lists of numbers stay on one line."""
    parts = []
    for name, section in document.items():
        if isinstance(section, list):
            body = ",\n".join(json.dumps(row) for row in section)
            parts.append(f'"{name}": [\n{body}\n]')
        else:
            parts.append(f'"{name}": {json.dumps(section)}')
    return "{\n" + ",\n".join(parts) + "\n}\n"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="tools.firmware_vectors", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tables", action="store_true", help="write only the C tables, from the file as it is")
    chosen = parser.parse_args(arguments)
    if not chosen.tables:
        VECTORS.parent.mkdir(parents=True, exist_ok=True)
        VECTORS.write_text(to_text(build()), "utf-8")
        print(VECTORS)
    TABLES.write_text(tables(json.loads(VECTORS.read_text("utf-8"))), "utf-8")
    print(TABLES)
    return 0


if __name__ == "__main__":
    sys.exit(main())
