"""drive.toml: what it means, and that one sentence answers everything that is wrong in it."""

from __future__ import annotations

import math
import re
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipmsm_can.config import (
    OBSERVER_KINDS,
    ConfigError,
    DriveConfig,
    config_from,
    explain,
    load_config,
    load_configs,
    parse_config,
)
from ipmsm_can.config.build import drive_node_settings, drive_parameters
from ipmsm_can.config.keys import Quantity
from ipmsm_can.config.simulation import SimulationConfig
from ipmsm_can.drive.parameters import DriveNodeSettings, DriveParameters
from ipmsm_can.motor import M1, M2

M2_ONLY = '[motor]\npreset = "m2"\n'
OWN_MOTOR = '[motor]\npole_pairs = 4\npsi_m = "50 mWb"\nL_d = "1.2 mH"\nL_q = 1.9e-3\nR = "300 mohm"\n'


def sentence(text: str) -> str:
    """The message about a wrong file, without the file's name."""
    with pytest.raises(ConfigError) as caught:
        parse_config(text, source="my.toml")
    message = str(caught.value)
    assert message.startswith("my.toml: ")
    assert "\n" not in message
    return message.removeprefix("my.toml: ")


def test_defaults() -> None:
    config = parse_config(M2_ONLY)
    assert config.build_motor() == M2
    assert config.wire.model_dump() == {
        "node": 0, "dbc": None, "sample_rate": None, "max_gap": 8, "bitrate": 1_000_000,
        "data_bitrate": 5_000_000,
    }
    assert config.observer.model_dump() == {
        "kind": "riccati", "alpha": None, "gamma": None, "initial_flux": (0.0, 0.0), "epsilon": None,
        "excitation_window": 0.1, "speed_bandwidth": 100.0, "voltage_uncertainty": 0.5, "current_noise": 0.02,
        "resistance_uncertainty": 12.0, "inductance_uncertainty": 6.0,
        "saturation_uncertainty": 20.0, "adapt_voltage": True,
        "adapt_resistance": True, "voltage_delay": "auto",
    }
    assert config.estimate.model_dump() == {
        "rate": 1000.0, "flux_rate": 50.0, "status_rate": 10.0, "valid_sigma": 7.5,
    }
    assert config.injection.model_dump() == {
        "enabled": True, "waveform": "auto", "amplitude": "auto", "frequency": "auto", "sigma_target": None,
        "speed_on": None, "speed_off": None, "excitation_on": 0.0, "excitation_off": 0.0, "ramp": None,
        "current_limit": None,
        "time_to_live": 0.1, "period": 0.02, "axis": None, "polarity": True,
        "polarity_current": None, "polarity_amplitude": 30.0,
    }


def test_values_derived_from_the_motor() -> None:
    config = parse_config(M2_ONLY + "[observer]\nkind = 'ges'\n")
    assert config.gamma * (2 * 10 * 0.59) ** 2 == pytest.approx(70.0, rel=1e-14)
    assert config.epsilon == pytest.approx(0.059, rel=1e-14)
    assert config.current_limit == pytest.approx(0.15 * 6.2 / (1.5 * 3 * 0.59), rel=1e-14)
    own = parse_config(M2_ONLY + "[observer]\ngamma = 3\nepsilon = '1 mWb'\n[injection]\ncurrent_limit = 2\n")
    assert (own.gamma, own.epsilon, own.current_limit) == (3.0, 0.001, 2.0)


def test_every_default_is_allowed() -> None:
    for section in DriveConfig.sections().values():
        for name, key in section.keys().items():
            default = section.model_fields[name].default
            if default is not None:
                assert key.read(default) == default, name


def test_motors() -> None:
    assert parse_config('[motor]\npreset = "m1"').build_motor() == M1
    changed = parse_config(M2_ONLY + "R = 1.2\nL_q = '13 mH'\n").build_motor()
    assert (changed.R, changed.L_q, changed.psi_m, changed.name) == (1.2, 0.013, 0.59, "m2 with changes")
    own = parse_config(OWN_MOTOR + "rated_torque = 2\nJ = '2 kg cm^2'").build_motor()
    assert (own.pole_pairs, own.psi_m, own.L_d, own.L_q, own.R) == (4, 0.05, 0.0012, 0.0019, 0.3)
    assert (own.rated_torque, own.J, own.name) == (2.0, 2e-4, "custom")


@given(psi_m=st.sampled_from([1e-6, 10.0]), inductance=st.sampled_from([1e-7, 1.0]),
       R=st.sampled_from([0, 1000.0]), pole_pairs=st.sampled_from([1, 100]),
       alpha=st.sampled_from([1e-3, 1e5]))
def test_the_ends_of_the_ranges_make_a_motor_and_finite_gains(
    psi_m: float, inductance: float, R: float, pole_pairs: int, alpha: float
) -> None:
    config = config_from({
        "motor": {"pole_pairs": pole_pairs, "psi_m": psi_m, "L_d": inductance, "L_q": inductance, "R": R,
                  "rated_torque": 1e-3},
        "observer": {"alpha": alpha},
    })
    assert config.build_motor().psi_m == psi_m
    assert all(math.isfinite(x) and x > 0 for x in (config.gamma, config.epsilon, config.current_limit))


def test_a_limit_is_not_derived_from_somebody_elses_torque() -> None:
    assert sentence(OWN_MOTOR).startswith("injection.current_limit is missing; allowed is a number of A peak")
    assert "motor.rated_torque" in sentence(OWN_MOTOR)
    assert parse_config(OWN_MOTOR + "[injection]\nenabled = false").build_motor().pole_pairs == 4
    assert parse_config(OWN_MOTOR + "[injection]\ncurrent_limit = '1 A'").current_limit == 1.0


def test_shaft_speeds_need_the_motor() -> None:
    config = parse_config(M2_ONLY + "[injection]\nspeed_on = '100 rpm'\nspeed_off = '12 Hz'\n")
    assert config.injection.speed_on == pytest.approx(100 / 60 * 2 * math.pi * 3, rel=1e-14)
    assert config.injection.speed_off == pytest.approx(12 * 2 * math.pi, rel=1e-14)
    six = parse_config("[motor]\npreset = 'm1'\n[injection]\nspeed_on = '10 rpm'\n")
    assert six.injection.speed_on == pytest.approx(10 / 60 * 2 * math.pi * 6, rel=1e-14)
    # With a wrong motor the message is about the motor, not about the speed that cannot be known.
    assert sentence("[motor]\npreset = 'm3'\n[injection]\nspeed_on = '10 rpm'") == (
        'motor.preset is "m3"; allowed is "m1" or "m2"')


WRONG = [
    # the motor
    ("", 'the section [motor] is missing; allowed is [motor] with preset = "m1" or "m2"'),
    ("[wire]\nnode = 1", "the section [motor] is missing"),
    ("[motor]\n", "motor.pole_pairs is missing; allowed is a whole number, from 1 to 100, or take preset ="),
    ("[motor]\npole_pairs = 3\npsi_m = 0.1\nL_d = 1e-3\nR = 1",
     "motor.L_q is missing; allowed is a number of H"),
    ("motor = 'm2'", 'motor is "m2"; allowed is a table with the keys preset, pole_pairs'),
    ("[[motor]]\npreset = 'm2'", "motor is an array of tables; allowed is a table"),
    (M2_ONLY + "L_d = 7.6", "motor.L_d is 7.6; allowed is a number of H, or a string of number and unit "
                            "(nH, uH, mH, H), from 1e-07 to 1"),
    (M2_ONLY + "L_d = '7.6 mOhm'", 'motor.L_d is "7.6 mOhm"; allowed is a number of H'),
    (M2_ONLY + "R = nan", "motor.R is nan; allowed is a number of ohm"),
    (M2_ONLY + "pole_pairs = 2.5", "motor.pole_pairs is 2.5; allowed is a whole number, from 1 to 100"),
    (M2_ONLY + "psi_m = true", "motor.psi_m is true; allowed is a number of Wb"),
    # keys and sections
    (M2_ONLY + "[observer]\ngama = 3", "observer.gama is not a known key; did you mean observer.gamma? ("),
    (M2_ONLY + "[observer]\nspeed_on = 3",
     "observer.speed_on is not a known key; did you mean injection.speed_on? ("),
    (M2_ONLY + "l_D = 1", "motor.l_D is not a known key; did you mean motor.L_d? ("),
    (M2_ONLY + "[wire]\nxyzzy = 1", "wire.xyzzy is not a known key; [wire] allows node, dbc, sample_rate"),
    (M2_ONLY + "[obsever]\nalpha = 3",
     "obsever is not a known section; did you mean observer? (allowed sections are"),
    (M2_ONLY + "[xyzzy]\n",
     "xyzzy is not a known section; allowed sections are motor, wire, observer, estimate"),
    ("speed_on = 1\n" + M2_ONLY, "speed_on is not a known key; did you mean injection.speed_on? ("),
    # values
    (M2_ONLY + "[wire]\nnode = 16", "wire.node is 16; allowed is a whole number, from 0 to 15"),
    (M2_ONLY + "[wire]\nnode = 0x" + 9000 * "F", "wire.node is a number of more than 30 digits; allowed is"),
    (M2_ONLY + "[wire]\nsample_rate = '10 kH'", 'wire.sample_rate is "10 kH"; allowed is a number of Hz'),
    (M2_ONLY + "[wire]\nsample_rate = 1979-05-27",
     "wire.sample_rate is 1979-05-27; allowed is a number of Hz"),
    (M2_ONLY + "[wire]\nmax_gap = '" + 500 * "x" + "'", 'wire.max_gap is "xxxxx'),
    (M2_ONLY + "[wire]\ndbc = 'no-such.dbc'",
     'wire.dbc is "no-such.dbc"; allowed is the path of a file that exists'),
    (M2_ONLY + "[observer]\nkind = 'luenberger'",
     'observer.kind is "luenberger"; allowed is "ges", "riccati", "spmsm_'),
    (M2_ONLY + "[observer]\ninitial_flux = [1]",
     "observer.initial_flux is [1]; allowed is an array of 2 values"),
    (M2_ONLY + "[observer]\ncurrent_noise = 0", "observer.current_noise is 0; allowed is a number of A rms"),
    (M2_ONLY + "[estimate]\nrate = '30 kHz'", 'estimate.rate is "30 kHz"; allowed is a number of Hz'),
    (M2_ONLY + "[injection]\nenabled = 1", "injection.enabled is 1; allowed is true or false"),
    (M2_ONLY + "[injection]\nwaveform = 'off'",
     'injection.waveform is "off"; allowed is "auto", "rotating" or "pulsating"'),
    (M2_ONLY + "[injection]\nspeed_on = '-6 rpm'",
     'injection.speed_on is "-6 rpm"; allowed is a number of rad/s elec'),
    (M2_ONLY + "[injection]\ntime_to_live = 1", "injection.time_to_live is 1; allowed is a number of s"),
    # keys that do not fit together; a default is named as such
    (M2_ONLY + "[injection]\nspeed_on = 40\nspeed_off = 40",
     "injection.speed_off is 40; allowed is a speed above injection.speed_on, 40 rad/s electrical"),
    (M2_ONLY + "[injection]\nspeed_on = '200 rpm'\nspeed_off = 60",
     "injection.speed_off is 60; allowed is a speed above injection.speed_on, 62.8319 rad/s "),
    (M2_ONLY + "[injection]\nexcitation_on = 2",
     "injection.excitation_off is 0 by default; allowed is a value above injection.excitation_on, 2 V^2 s"),
    (M2_ONLY + "[injection]\nperiod = '50 ms'",
     'injection.period is "50 ms"; allowed is a time below half of injection.time_to_live, 0.1 s'),
    (M2_ONLY + "[observer]\nepsilon = 0.59",
     "observer.epsilon is 0.59; allowed is a flux below the motor's psi_m, 0.59 Wb"),
    (M2_ONLY + "[wire]\nsample_rate = 800\n[injection]\nfrequency = 400",
     "injection.frequency is 400; allowed is a frequency below half of wire.sample_rate, 800 Hz"),
    (M2_ONLY + "[wire]\nsample_rate = 800\n[observer]\nkind = 'injection_demodulation'",
     'injection.frequency is "auto" by default; allowed is a frequency from 0 Hz to below half of the sample rate'),
    (M2_ONLY + "[wire]\ndata_bitrate = 500000",
     "wire.data_bitrate is 500000; allowed is wire.bitrate (1000000 bit/s) or more"),
    # several at once
    (M2_ONLY + "[wire]\nnode = 16\nmax_gap = 65",
     "wire.node is 16; allowed is a whole number, from 0 to 15 (and 1 more problem)"),
    (M2_ONLY + "[wire]\nnode = 16\nmax_gap = 65\nbitrate = 1",
     "wire.node is 16; allowed is a whole number, from 0 to 15 (and 2 more problems)"),
    ("[moter]\npreset = 'm2'", "moter is not a known section; did you mean motor?"),
    # broken TOML
    ("[motor]\npreset = m2", "line 2, column 10: not valid TOML: invalid value"),
    ("[motor", "line 1: not valid TOML: expected ']'"),
    ("[motor]\npreset = 'm2'\npreset = 'm1'\n",
     "line 3, column 14: not valid TOML: cannot overwrite a value"),
    ("[motor]\nR = " + 5000 * "1", "not valid TOML: "),
    ("a = " + 100_000 * "[", "brackets are nested too deeply"),
]


@pytest.mark.parametrize(("text", "expected"), WRONG, ids=[expected[:50] for _, expected in WRONG])
def test_one_sentence(text: str, expected: str) -> None:
    message = sentence(text)
    assert message.startswith(expected)
    assert len(message) < 420


def test_what_fits_together_just_so() -> None:
    assert parse_config(M2_ONLY + "[injection]\nspeed_on = 0\nspeed_off = 0.1").injection.speed_off == 0.1
    both = "[injection]\nexcitation_on = 2\nexcitation_off = 3"
    assert parse_config(M2_ONLY + both).injection.excitation_on == 2
    assert parse_config(M2_ONLY + "[wire]\nsample_rate = 801").wire.sample_rate == 801.0
    silent = "[wire]\nsample_rate = 500\n[injection]\nenabled = false"
    assert parse_config(M2_ONLY + silent).injection.enabled is False


_VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=10), st.dates(),
              st.sampled_from(["m2", "7 mH", "60 rpm", "ges", "1 kHz", "0.2 s", "1 A"])),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=2),
    max_leaves=4,
)


@st.composite
def _files(draw: st.DrawFn) -> dict[str, object]:
    data: dict[str, object] = {"motor": {"preset": "m2"}}
    for name, section in DriveConfig.sections().items():
        keys = st.sampled_from(list(section.model_fields)) | st.text(max_size=6)
        table = draw(st.dictionaries(keys, _VALUES, max_size=2))
        data[name] = {"preset": "m2", **table} if name == "motor" else table
    if draw(st.booleans()):
        data[draw(st.text(max_size=6) | st.sampled_from(list(data)))] = draw(_VALUES)
    return data


@given(data=_files())
def test_any_file_gives_a_configuration_or_one_sentence(data: dict[str, object]) -> None:
    try:
        config = config_from(data)
    except ConfigError as error:
        assert str(error).startswith("drive.toml: ")
        assert "allow" in str(error)
    else:
        assert config.injection.period < config.injection.time_to_live / 2
        assert config.gamma > 0


def test_explain_loads_and_is_the_default() -> None:
    assert parse_config(explain()) == parse_config(M2_ONLY)


def test_explain_names_every_key_once_with_unit_range_and_default() -> None:
    text = explain()
    words = " ".join(line.removeprefix("# ") for line in text.splitlines())
    for name, section in DriveConfig.sections().items():
        assert text.count(f"\n[{name}]\n") == 1
        part = text.split(f"\n[{name}]\n")[1].split("\n[")[0]
        for field, key in section.keys().items():
            assert len(re.findall(rf"^(?:# )?{field} = ", part, re.MULTILINE)) == 1, field
            assert key.doc.endswith("."), field
            assert f"{key.doc} Allowed: {key.allowed}. Default: " in words, field
            assert key.default or section.model_fields[field].default is not None, field
            if isinstance(key, Quantity) and key.unit.label:
                assert key.unit.label in key.allowed, field


def test_the_examples_of_explain_load_too(tmp_path: Path) -> None:
    text = re.sub(r"^# (\w+ = )", r"\1", explain(), flags=re.MULTILINE)
    names = {f"{s}.{k}" for s, table in tomllib.loads(text).items() for k in table}
    assert names == {f"{s}.{k}" for s, model in DriveConfig.sections().items() for k in model.model_fields}
    (tmp_path / "ipmsm_can.dbc").touch()
    (tmp_path / "drive.toml").write_text(text, encoding="utf-8")
    config = load_config(tmp_path / "drive.toml")
    assert config.wire.sample_rate == 10e3
    assert config.wire.dbc == tmp_path / "ipmsm_can.dbc"
    assert (config.build_motor().L_d, config.current_limit) == (7.6e-3, 0.35)


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "drive.toml"
    with pytest.raises(ConfigError, match=r"drive\.toml: there is no such file; .*--explain"):
        load_config(path)
    with pytest.raises(ConfigError, match=r"cannot be read: Is a directory"):
        load_config(tmp_path)
    path.write_bytes(b"[motor]\n# \xff\n")
    with pytest.raises(ConfigError, match="byte 10 is not UTF-8"):
        load_config(path)
    path.write_bytes(b"\xef\xbb\xbf" + M2_ONLY.replace("\n", "\r\n").encode())  # as Windows editors write it
    assert load_config(str(path)).build_motor() == M2


def test_a_dbc_path_starts_at_the_file(tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    dbc = tmp_path / "maps" / "mine.dbc"
    dbc.touch()
    path = tmp_path / "drive.toml"
    path.write_text(M2_ONLY + '[wire]\ndbc = "maps/mine.dbc"\n')
    assert load_config(path).wire.dbc == dbc
    path.write_text(M2_ONLY + f'[wire]\ndbc = "{dbc.as_posix()}"\n')
    assert load_config(path).wire.dbc == dbc
    path.write_text(M2_ONLY + '[wire]\ndbc = "maps"\n')
    with pytest.raises(ConfigError, match=r'wire\.dbc is "maps"; allowed is the path of a file'):
        load_config(path)


def test_two_drives_need_two_nodes(tmp_path: Path) -> None:
    for name, node in (("a.toml", 0), ("b.toml", 1), ("c.toml", 1)):
        (tmp_path / name).write_text(f"{M2_ONLY}[wire]\nnode = {node}\n")
    assert [c.wire.node for c in load_configs([tmp_path / "a.toml", tmp_path / "b.toml"])] == [0, 1]
    with pytest.raises(ConfigError, match=r"c\.toml: wire\.node is 1, which .*b\.toml has already; allowed"):
        load_configs([tmp_path / "a.toml", tmp_path / "b.toml", tmp_path / "c.toml"])


def test_a_configuration_is_frozen() -> None:
    config = parse_config(M2_ONLY)
    for owner, name in ((config, "wire"), (config.wire, "node"), (config.motor, "R")):
        with pytest.raises(ValueError, match="frozen"):
            setattr(owner, name, 1)


def test_the_default_gain_is_in_the_unit_of_the_observers_equation() -> None:
    psi_m = M2.psi_m
    for kind, gamma in (("ges", 70.0 / (20.0 * psi_m) ** 2), ("chonam", 70.0 / (20.0 * psi_m) ** 2),
                        ("spmsm_gradient", 35.0 / psi_m**2), ("spmsm_gradient_max", 35.0 / psi_m**2)):
        text = f'{M2_ONLY}[observer]\nkind = "{kind}"\n'
        assert parse_config(text).gamma == pytest.approx(gamma)
        assert parse_config(text + "gamma = 3\n").gamma == 3.0


def test_the_one_list_of_observers() -> None:
    for kind in OBSERVER_KINDS:
        assert parse_config(f'{M2_ONLY}[observer]\nkind = "{kind}"\n').observer.kind == kind
        assert f'"{kind}"' in explain()


def test_importing_the_configuration_is_cheap() -> None:
    heavy = "{'numba', 'scipy', 'can', 'cantools', 'numpy'}"
    code = f"import sys, ipmsm_can.config; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          cwd=Path(__file__).parents[1])
    assert done.stdout.strip() == "[]"


def test_the_simulated_drive_takes_its_defaults_from_the_drive_itself() -> None:
    config = parse_config(M2_ONLY)
    assert drive_parameters(config) == DriveParameters(sample_rate=5000.0)
    assert drive_node_settings(config) == DriveNodeSettings()
    assert set(SimulationConfig.keys()) == {
        f.name for kind in (DriveParameters, DriveNodeSettings) for f in fields(kind)}


def test_every_key_of_the_simulated_drive_arrives() -> None:
    given = {
        "sample_rate": 8000.0, "substeps": 3, "v_dc": 300.0, "current_bandwidth": 150.0, "speed_bandwidth": 7.0,
        "torque_limit": 4.0, "i_max": 3.0, "mtpa": True, "dead_time_voltage": 0.5, "dead_time_zone": 0.1,
        "current_noise": 0.03, "current_offset": (0.1, -0.2), "adc_step": 0.005, "friction": 0.001,
        "speed_imposed": True, "rotor_locked": False, "brake": True, "injection_limit": 20.0,
        "injection_ramp": 500.0,
    }
    sent = {"fd": True, "timing_rate": 20.0, "status_rate": 5.0, "reference_rate": 0.0,
            "encoder_counts": 4096}
    config = config_from({"motor": {"preset": "m2"}, "simulation": {**given, **sent}})
    assert drive_parameters(config) == DriveParameters(**given)  # type: ignore[arg-type]
    assert drive_node_settings(config) == DriveNodeSettings(**sent)  # type: ignore[arg-type]


def test_sample_rate_of_the_simulated_drive() -> None:
    def rate(text: str, fd: bool) -> float:
        return drive_parameters(parse_config(M2_ONLY + text), fd).sample_rate

    assert (rate("", False), rate("", True), rate("[simulation]\nfd = true", False)) == (5e3, 1e4, 1e4)
    assert rate("[wire]\nsample_rate = '4 kHz'", True) == 4e3
    assert rate("[wire]\nsample_rate = 4000\n[simulation]\nsample_rate = 6000", True) == 6e3


def test_a_slow_real_drive_needs_no_simulation_that_goes_with_it() -> None:
    config = parse_config(M2_ONLY + "[wire]\nsample_rate = 1000\n[injection]\nenabled = false")
    with pytest.raises(ValueError, match=r"^simulation.current_bandwidth is 200.0; allowed is 0.001 to 83.33"):
        drive_parameters(config)


@pytest.mark.parametrize(("text", "expected"), [
    ("sample_rate = 2000\ncurrent_bandwidth = 200",
     "simulation.current_bandwidth is 200; allowed is a frequency of "
     "at most simulation.sample_rate / 12, that is 166.667 Hz"),
    ("speed_bandwidth = 51", "simulation.speed_bandwidth is 51; allowed is a frequency of at most a quarter"),
    ("speed_imposed = true\nrotor_locked = true", "simulation.rotor_locked is true; allowed is false"),
    ("substeps = 0", "simulation.substeps is 0; allowed is a whole number, from 1 to 1000"),
    ("current_offset = 1", "simulation.current_offset is 1; allowed is an array of 2 values"),
    ("vdc = 1", "simulation.vdc is not a known key; did you mean simulation.v_dc?"),
])
def test_what_is_wrong_with_a_simulated_drive(text: str, expected: str) -> None:
    assert sentence(f"{M2_ONLY}[simulation]\n{text}").startswith(expected)
