"""Made-up traffic of other people's drives: frames by cantools, which shares nothing with the codec under test."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cantools.database
import numpy as np

from ipmsm_can.frames import CAN_EFF_FLAG, CANFD_FDF, FrameBlock
from ipmsm_can.mapping import InverterMap, MappedBlock, mapped, parse_map

T0 = 1_700_000_000_000_000_000
Floats = np.ndarray


@dataclass(frozen=True)
class Truth:
    """A motor that turns evenly: dq currents and voltages that change slowly, at any time [s]."""

    hertz: float = 12.0
    psi_m: float = 0.59
    r: float = 1.059
    l_d: float = 7.6e-3
    l_q: float = 12.9e-3

    def omega(self, t: Floats) -> Floats:
        return np.full(t.shape, 2 * math.pi * self.hertz)

    def theta(self, t: Floats) -> Floats:
        return np.asarray(0.4 + 2 * math.pi * self.hertz * t)

    def i_dq(self, t: Floats) -> Floats:
        return np.asarray(-1.5 + 0.2 * t + 1j * (6.0 + 0.5 * t))

    def v_dq(self, t: Floats) -> Floats:
        i, w = self.i_dq(t), self.omega(t)
        v_d, v_q = self.r * i.real - w * self.l_q * i.imag, self.r * i.imag + w * (self.l_d * i.real + self.psi_m)
        return np.asarray(v_d + 1j * v_q)

    def i(self, t: Floats) -> Floats:
        return np.asarray(self.i_dq(t) * np.exp(1j * self.theta(t)))

    def v(self, t: Floats) -> Floats:
        return np.asarray(self.v_dq(t) * np.exp(1j * self.theta(t)))

    def phases(self, vector: Floats) -> list[Floats]:
        """a, b, c of a vector, by projection on the phases' axes."""
        return [(vector * np.exp(-2j * math.pi * k / 3)).real for k in range(3)]


def frames(dbc: Path | str, sent: Mapping[str, tuple[Floats, Mapping[str, object]]], shift: int = 0) -> FrameBlock:
    """Frames in order of time.  sent: message -> (times [s], signal -> values (N,) or one for all);
    shift: added to every identifier."""
    database = (cantools.database.load_file(dbc) if isinstance(dbc, Path) else
                cantools.database.load_string(dbc, "dbc"))
    assert isinstance(database, cantools.database.can.Database)
    parts = []
    for name, (times, signals) in sent.items():
        message = database.get_message_by_name(name)
        rows = FrameBlock(np.zeros((len(times), 72), np.uint8), T0 + np.rint(1e9 * times).astype(np.int64))
        for k in range(len(times)):
            values: dict[str, Any] = {
                s: (float(v[k]) if isinstance(v, np.ndarray) else v) for s, v in signals.items()}
            rest = {s.name: 0 for s in message.signals if s.name not in values}
            data = message.encode({**rest, **values}, strict=False)
            rows.data[k, :len(data)] = list(data)
            rows.length[k] = len(data)
        rows.can_id[:] = (message.frame_id + shift) | (CAN_EFF_FLAG if message.is_extended_frame else 0)
        rows.flags[:] = CANFD_FDF if message.is_fd else 0
        parts.append(rows)
    block = FrameBlock.concat(parts)
    return block.take(np.argsort(block.t_ns, kind="stable"))


def run(block: FrameBlock, inverter: InverterMap, edges: list[int] | None = None, **how: object) -> MappedBlock:
    """The whole of it in one MappedBlock; edges: where to cut the frames."""
    cuts = [0, *sorted(edges or []), len(block)]
    parts = list(mapped([block.take(slice(a, b)) for a, b in pairwise(cuts)], inverter, **how))  # type: ignore[arg-type]
    names = MappedBlock.__dataclass_fields__
    return MappedBlock(**{n: np.concatenate([getattr(p, n) for p in parts], axis=-1) for n in names})


def same(a: MappedBlock, b: MappedBlock) -> None:
    """The same bits, NaN included."""
    for name in MappedBlock.__dataclass_fields__:
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=name not in ("t_ns", "sample", "gap",
                                                                                        "quality")), name


def dbc_text(messages: Mapping[int, tuple[str, list[str]]]) -> str:
    """A DBC: identifier -> (name, lines after SG_)."""
    body = "\n".join(f"BO_ {i} {name}: 8 X\n" + "\n".join(f" SG_ {s} X" for s in signals) + "\n"
                     for i, (name, signals) in messages.items())
    return f'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: X\n\n{body}'


def make_map(folder: Path, dbc: str, body: str, general: str = "") -> InverterMap:
    """A map of this text beside this DBC."""
    (folder / "x.dbc").write_text(dbc)
    return parse_map(f'[map]\ntitle = "x"\ndbc = "x.dbc"\n{general}\n{body}', "x.toml", folder)
