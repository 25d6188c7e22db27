"""The observer step against the same equations in C, in plain Python and in NumPy, on the same samples."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.drive import profile
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.estimation import regression
from ipmsm_can.estimation.filters import filter_coefficients
from ipmsm_can.estimation.observers import common, ges, kinds
from ipmsm_can.estimation.observers.dispatch import observer_block
from ipmsm_can.motor import M2

Floats = NDArray[np.float64]
RATE, ALPHA, GAMMA, EPSILON, PROBING = 5000.0, 10.0, 0.5, 0.059, 400.0


def samples(n: int) -> Floats:
    """float64 (4, n) of a drive at 1000 rpm with torque pulses."""
    s = DriveSimulation(M2, DriveParameters(sample_rate=RATE), profile.torque_pulses()).run(n)
    return np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])


def probed_samples(n: int) -> Floats:
    """float64 (4, n) of a drive at 20 rpm that injects 6 V, rotating: every kind has something to do."""
    parameters = DriveParameters(sample_rate=RATE, current_noise=0.02)
    drive = DriveSimulation(M2, parameters, profile.constant(20 * profile.RPM))
    drive.command_injection(1, 6.0, PROBING, 0.0, n)
    s = drive.run(n)
    return np.ascontiguousarray([s.i_alpha, s.i_beta, s.v_alpha, s.v_beta])


def compiled(block: Floats) -> Callable[[], Floats]:
    """Our kernels on the block."""
    rp = regression.parameters(M2, ALPHA, RATE)
    op = common.parameters(kinds.GES, M2, ALPHA, GAMMA, EPSILON, RATE)
    n = block.shape[1]
    regressed, out = np.empty((regression.ROWS, n)), np.empty((common.ROWS, n))

    def run() -> Floats:
        regression.regression_block(block, rp, np.zeros(1, regression.STATE), regressed)
        ges.ges_block(block, regressed, op, np.zeros(1, common.STATE), out)
        return out

    return run


def of_kind(name: str, block: Floats) -> Callable[[], Floats]:
    """Regression and observer of that kind on the block, chosen as on the bus."""
    kind = kinds.KINDS[name]
    motor = common.assumed_motor(kind, M2)
    rp = regression.parameters(motor, ALPHA, RATE)
    op = common.parameters(kind, motor, ALPHA, GAMMA, EPSILON, RATE, PROBING)
    n = block.shape[1]
    regressed, out = np.empty((regression.ROWS, n)), np.empty((common.ROWS, n))

    def run() -> Floats:
        regression.regression_block(block, rp, np.zeros(1, regression.STATE), regressed)
        observer_block(block, regressed, op, np.zeros(1, common.STATE), out)
        return out

    return run


def single_calls(block: Floats, n: int) -> Callable[[], None]:
    """Our kernels, one sample a call."""
    rp = regression.parameters(M2, ALPHA, RATE)
    op = common.parameters(kinds.GES, M2, ALPHA, GAMMA, EPSILON, RATE)
    rs, os_ = np.zeros(1, regression.STATE), np.zeros(1, common.STATE)
    regressed, out = np.empty((regression.ROWS, 1)), np.empty((common.ROWS, 1))
    parts = [np.ascontiguousarray(block[:, k:k + 1]) for k in range(n)]

    def run() -> None:
        for part in parts:
            regression.regression_block(part, rp, rs, regressed)
            ges.ges_block(part, regressed, op, os_, out)

    return run


class _Parameters(ctypes.Structure):
    _fields_ = [(name, ctypes.c_double) for name in (
        "T_s", "R", "L_q", "L_0", "ell", "alpha", "decay", "previous", "present", "gamma", "epsilon")]


def in_c(block: Floats) -> Callable[[], Floats] | None:
    """tools/bench/observer.c with cc -O2; None where there is no compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    folder = tempfile.TemporaryDirectory()
    library = Path(folder.name) / "observer.so"
    source = Path(__file__).with_name("observer.c")
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(source), "-lm"], check=True)
    observe: Any = ctypes.CDLL(str(library)).observe
    f = filter_coefficients(ALPHA, 1.0 / RATE)
    p = _Parameters(1.0 / RATE, M2.R, M2.L_q, M2.L_0, M2.ell, ALPHA, f.decay, f.previous, f.present, GAMMA,
                    EPSILON)
    n = block.shape[1]
    out = np.empty((common.ROWS, n))

    def run() -> Floats:
        state = np.zeros(16)
        observe(block.ctypes.data_as(ctypes.c_void_p), ctypes.c_size_t(n), ctypes.byref(p),
                state.ctypes.data_as(ctypes.c_void_p), out.ctypes.data_as(ctypes.c_void_p))
        return out

    run.folder = folder  # type: ignore[attr-defined]
    return run


def in_python(block: Floats) -> Callable[[], Floats]:
    """The same functions uncompiled, on Python lists of floats instead of arrays."""
    rp = {k: float(regression.parameters(M2, ALPHA, RATE)[k][0]) for k in regression.PARAMETERS.names or ()}
    ours = common.parameters(kinds.GES, M2, ALPHA, GAMMA, EPSILON, RATE)
    op = {k: float(ours[k][0]) for k in common.PARAMETERS.names or ()}
    rows = [r.tolist() for r in block]

    def run() -> Floats:
        from types import SimpleNamespace

        regressed = _Table(regression.ROWS, block.shape[1])
        out = _Table(common.ROWS, block.shape[1])
        given = _Table.of(rows)
        zero = dict.fromkeys((*(regression.STATE.names or ()), *(common.STATE.names or ())), 0.0)
        _plain(regression.regression_block)(given, [SimpleNamespace(**rp)], [SimpleNamespace(**zero)], regressed)
        _plain(ges.ges_block)(given, regressed, [SimpleNamespace(**op)], [SimpleNamespace(**zero)], out)
        return np.array(out.rows)

    return run


def _plain(kernel: Any) -> Any:
    """The Python function behind a kernel, with the helpers it calls uncompiled too."""
    import types

    function = kernel.py_func
    names = {k: getattr(v, "py_func", v) for k, v in function.__globals__.items()}
    return types.FunctionType(function.__code__, names)


class _Table:
    """Rows of Python floats that index like an array."""

    def __init__(self, n_rows: int, n: int) -> None:
        self.rows: list[list[float]] = [[0.0] * n for _ in range(n_rows)]
        self.shape = (n_rows, n)

    @classmethod
    def of(cls, rows: list[list[float]]) -> _Table:
        table = cls(0, 0)
        table.rows, table.shape = rows, (len(rows), len(rows[0]))
        return table

    def __getitem__(self, at: tuple[int, int]) -> float:
        return self.rows[at[0]][at[1]]

    def __setitem__(self, at: tuple[int, int], value: float) -> None:
        self.rows[at[0]][at[1]] = value


def in_numpy(block: Floats) -> Callable[[], Floats]:
    """The equations with NumPy 2-vectors, as a first script would have them."""
    f = filter_coefficients(ALPHA, 1.0 / RATE)
    L_q, L_0, ell, T_s = M2.L_q, M2.L_0, M2.ell, 1.0 / RATE

    def sigma(i: Floats, x: Floats) -> float:
        size = np.linalg.norm(x)
        return float(i @ x / size) if size >= EPSILON else 0.0

    def run() -> Floats:
        i_old = block[:2, 0].copy()
        f_e, f_i = np.zeros(2), i_old.copy()
        product_old: Any = 0.0
        f_p: Any = 0.0
        lam, kick = np.zeros(2), np.zeros(2)
        y = s = f_s = 0.0
        out = []
        for k in range(block.shape[1]):
            i, v = block[:2, k], block[2:, k]
            if k:
                e = v - 0.5 * M2.R * (i_old + i)
                f_e = f.decay * f_e + (1.0 - f.decay) * e
                f_i = f.decay * f_i + f.previous * i_old + f.present * i
                lam = lam + kick + T_s * e
            i_old = i
            h = ALPHA * (i - f_i)
            om1 = f_e - L_q * h
            om2 = om1 - L_0 * h
            product = om2 @ om1
            f_p = f.decay * f_p + f.previous * product_old + f.present * product
            product_old = product
            y = L_0 * (f_i @ om1) + (om1 @ om1 + f_p) / ALPHA
            phi = om1 + om2
            x = lam - L_q * i
            s_new = sigma(i, x)
            f_open = f.decay * f_s + f.previous * s if k else (1.0 - f.present) * s_new
            size2 = phi @ phi
            z = 0.5 * GAMMA * T_s * size2
            shrink = np.expm1(-z) if z > 1e-12 else -z
            gain = -shrink / size2 if z > 1e-12 else 0.5 * GAMMA * T_s
            residual = y - phi @ x
            innovation = residual + ell * ALPHA * (s_new - (f_open + f.present * s_new))
            s = sigma(i, x + gain * innovation * phi)
            f_s = f_open + f.present * s
            c = gain * (residual + ell * ALPHA * (s - f_s))
            lam = lam + c * phi
            kick = c * (1.0 + shrink) * phi
            out.append(lam)
        return np.array(out).T

    return run
