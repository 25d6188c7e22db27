"""Broken observers are found out: the claims hold for the observer as it is, and for none of its mutants.

A mutant is a copy of the package in which one expression of the observer or of the regression is changed.  It runs
in a process of its own, uncompiled, on the same samples and under the same assertions (tests/claims.py) as
the original, which goes through the same machinery as a control.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ipmsm_can.drive.profile import Profile, constant, paper_ramp, torque_pulses
from ipmsm_can.drive.simulation import DriveParameters, DriveSimulation
from ipmsm_can.injection.waveform import ROTATING
from ipmsm_can.motor import M1, M2, Motor
from tests.claims import CLAIMS, CURRENT_NOISE, INJECTION, RATE, run_claim, verdicts

Floats = NDArray[np.float64]
Tried = dict[str, Future[dict[str, str]]]

_ROOT = Path(__file__).resolve().parents[1]
_GES = "estimation/observers/ges.py"
_REGRESSION = "estimation/regression.py"

# Compiling takes longer than these few samples do in plain Python.  numba reads a field of a record as an
# attribute; in NumPy that takes a record array.
_UNCOMPILED = """
import numpy as np

def kernel(function):
    def plain(*arguments):
        return function(*(a.view(np.recarray) if isinstance(a, np.ndarray) and a.dtype.names else a
                          for a in arguments))
    return plain
"""


@dataclass(frozen=True)
class Mutant:
    """A change of one file of the package, (as it is, as it becomes) pairs, and the claims that must notice."""

    file: str
    changes: tuple[tuple[str, str], ...]
    caught_by: frozenset[str]


MUTANTS = {
    "drops d": Mutant(_GES, (
        ("ell_alpha = p.ell * p.alpha\n", "ell_alpha = 0.0 * p.ell * p.alpha\n"),
    ), frozenset({"standstill"})),
    "flips the sign of l": Mutant(_GES, (
        ("ell_alpha = p.ell * p.alpha\n", "ell_alpha = -p.ell * p.alpha\n"),
    ), frozenset({"standstill"})),
    "drops the 1/alpha term of y": Mutant(_REGRESSION, (
        ("(om1_a * om1_a + om1_b * om1_b + f_product) / alpha", "f_product / alpha"),
    ), frozenset({"ramp", "pulses"})),
    "swaps Omega_1 and Omega_2 in y": Mutant(_REGRESSION, (
        ("om1_a = fe_a - L_q * h_a\n", "om1_a = fe_a - L_q * h_a - L_0 * h_a\n"),
        ("om1_b = fe_b - L_q * h_b\n", "om1_b = fe_b - L_q * h_b - L_0 * h_b\n"),
        ("om2_a = om1_a - L_0 * h_a\n", "om2_a = om1_a + L_0 * h_a\n"),
        ("om2_b = om1_b - L_0 * h_b\n", "om2_b = om1_b + L_0 * h_b\n"),
    ), frozenset({"pulses"})),
    "drops the exact correction step": Mutant(_GES, (
        ("if z > 1e-12:", "if z > math.inf:"),
    ), frozenset({"pulses"})),
}
AS_IT_IS = Mutant(_GES, (), frozenset())


def _drive(motor: Motor, profile: Profile, theta_0: float = 0.0, inject: bool = False) -> Floats:
    """(5, N): currents, voltages, true angle of a simulated drive with noisy current sensors."""
    parameters = DriveParameters(sample_rate=RATE, current_noise=CURRENT_NOISE, rotor_locked=inject)
    drive = DriveSimulation(motor, parameters, profile, theta_0, seed=7)
    parts = []
    if inject:
        parts.append(drive.run(int(0.05 * RATE)))
        drive.command_injection(ROTATING, *INJECTION, 0.0, drive.samples_in_profile)
    parts.append(drive.run(drive.samples_in_profile - drive.next_sample))
    return np.concatenate([[p.i_alpha, p.i_beta, p.v_alpha, p.v_beta, p.theta_e] for p in parts], axis=1)


@pytest.fixture(scope="module")
def samples() -> dict[str, Floats]:
    return {
        "ramp": _drive(M1, paper_ramp(), 0.3),
        "pulses": _drive(M2, torque_pulses(), 0.3),
        "standstill": _drive(M1, constant(0.0, 0.0, 1.3), 0.7, inject=True),
    }


def _broken_copy(mutant: Mutant, folder: Path) -> None:
    shutil.copytree(_ROOT / "ipmsm_can", folder / "ipmsm_can", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(_ROOT / "dbc", folder / "dbc")
    path = folder / "ipmsm_can" / mutant.file
    source = path.read_text()
    for as_it_is, as_it_becomes in mutant.changes:
        assert source.count(as_it_is) == 1, f"{as_it_is!r} stands {source.count(as_it_is)} times in {path}"
        source = source.replace(as_it_is, as_it_becomes)
    path.write_text(source)
    (folder / "ipmsm_can" / "_jit.py").write_text(_UNCOMPILED)


def _verdicts_of(mutant: Mutant, folder: Path, data: Path) -> dict[str, str]:
    _broken_copy(mutant, folder)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(_ROOT)])}
    done = subprocess.run([sys.executable, "-m", "tests.claims", str(data)], cwd=folder, env=environment,
                          capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, str] = json.loads(done.stdout)
    return found


@pytest.fixture(scope="module")
def tried(samples: dict[str, Floats], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tried]:
    """Every mutant's verdicts; they run side by side."""
    data = tmp_path_factory.mktemp("samples") / "samples.npz"
    np.savez(data, **samples)  # type: ignore[arg-type]
    mutants = {"as it is": AS_IT_IS, **MUTANTS}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield {name: pool.submit(_verdicts_of, mutant, tmp_path_factory.mktemp("mutant"), data)
               for name, mutant in mutants.items()}


@pytest.mark.parametrize("name", CLAIMS)
def test_claim_holds(samples: dict[str, Floats], name: str) -> None:
    claim = CLAIMS[name]
    claim.check(run_claim(claim, samples[name]))


def test_the_copy_as_it_is_passes(samples: dict[str, Floats], tried: Tried) -> None:
    """Otherwise a mutant might fail only because it is a copy, or not compiled."""
    assert tried["as it is"].result() == dict.fromkeys(CLAIMS, "") == verdicts(samples)


@pytest.mark.parametrize("name", MUTANTS)
def test_mutant_is_caught(tried: Tried, name: str) -> None:
    found = tried[name].result()
    caught = {claim for claim, problem in found.items() if problem}
    assert caught >= MUTANTS[name].caught_by, found
