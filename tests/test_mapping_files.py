"""Map files: what is wrong in one is said in one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from ipmsm_can.mapping import MapError, load_map, make_plan, shipped_maps
from ipmsm_can.wire.dbc import DbcError
from tests.mapping_traffic import dbc_text, make_map

DBC = dbc_text({1: ("Currents", ['i_alpha : 0|16@1- (0.1,0) [0|0] "A"', 'i_beta : 16|16@1- (0.1,0) [0|0] "A"']),
                2: ("Other", ['count : 0|8@1+ (1,0) [0|255] ""'])})
GOOD = '[current]\nform = "alpha_beta"\nmeasure = "peak"\nalpha = "Currents.i_alpha"\nbeta = "Currents.i_beta"\n'


@pytest.mark.parametrize(("body", "told"), [
    (GOOD.replace("Currents.i_beta", "Currents.i_bta"), "no signal 'i_bta'; did you mean i_beta?"),
    (GOOD.replace("Currents.i_beta", "Curents.i_beta"), "no message 'Curents'; did you mean Currents?"),
    (GOOD.replace('measure = "peak"\n', ""), 'current.measure is missing; allowed is "peak" or "rms"'),
    (GOOD.replace('"peak"', '"effective"'), 'current.measure is "effective"; allowed is "peak" or "rms"'),
    (GOOD.replace('beta = "Currents.i_beta"', ""), "current.beta is missing; allowed is"),
    (GOOD + 'd = "Currents.i_beta"\n',
     'current.d is "Currents.i_beta"; allowed is nothing for form = "alpha_beta"'),
    (GOOD.replace('"Currents.i_beta"', '"i_beta"'), 'current.beta is "i_beta"; allowed is "Message.signal"'),
    (GOOD.replace('"Currents.i_beta"', '{ signal = "Currents.i_beta", sign = 2 }'), "current.beta is a table"),
    (GOOD.replace('"Currents.i_beta"', '{ signal = "Currents.i_beta", gian = 2 }'), "current.beta is a table"),
    (GOOD + "[curent]\n", "curent is not a known key; did you mean current?"),
    (GOOD + '[timing]\ncounter = "Other.count"\n',
     "timing.counter is Other.count; allowed is a signal of the message"),
    ("", "current is missing; allowed is a table"),
    (GOOD + '[voltage]\nform = "duty"\nmeasure = "peak"\nper = "phase"\na = "Other.count"\nb = "Other.count"\n'
     'c = "Other.count"\n', "dc_voltage is missing"),
    (GOOD + '[voltage]\nform = "line_line"\nmeasure = "peak"\nper = "phase"\nab = "Other.count"\n'
     'bc = "Other.count"\n', 'voltage.per is "phase"; allowed is "line" for form = "line_line"'),
    (GOOD + "[timing\n", "not valid TOML"),
    (GOOD + '[angle]\nsignal = "Other.count"\nunit = "deg"\nof = "shaft"\n',
     "pole pairs of the motor are not known"),
    (GOOD + '[angle]\nsignal = "Other.count"\nunit = "deg"\nof = "electrical"\ndirection = 0\n',
     "angle.direction is 0; allowed is 1 or -1"),
    ('[current]\nform = "dq"\nmeasure = "peak"\nd = { constant = 0 }\nq = { constant = 1 }\n', "only constants"),
])
def test_one_clear_sentence(tmp_path: Path, body: str, told: str) -> None:
    with pytest.raises(MapError) as caught:
        make_plan(make_map(tmp_path, DBC, body))
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_paths_nodes_and_the_dbc(tmp_path: Path) -> None:
    good = make_map(tmp_path, DBC, GOOD)
    assert [s.can_id for s in make_plan(good, node=5).sources] == [6]
    shifted = make_map(tmp_path, DBC, GOOD, "node = 3\nnode_shift = 5")
    assert [s.can_id for s in make_plan(shifted).sources] == [1 + (3 << 5)]
    with pytest.raises(MapError, match="allowed is 0x7FF at most"):
        make_plan(shifted, node=64)
    with pytest.raises(MapError, match="no such file"):
        load_map(tmp_path / "none.toml")
    with pytest.raises(MapError, match="did you mean odrive"):
        load_map("odrve")
    with pytest.raises(MapError, match=r"map\.dbc is .*; allowed is the path of a file that exists"):
        make_map(tmp_path, DBC, GOOD, 'node = 1').map.dbc.unlink()
        (tmp_path / "y.toml").write_text('[map]\ntitle = "y"\ndbc = "x.dbc"\n' + GOOD)
        load_map(tmp_path / "y.toml")
    for wrong in ("BO_ nonsense", DBC.replace("16|16@", "60|16@")):
        with pytest.raises(DbcError, match="no usable DBC"):
            make_plan(make_map(tmp_path, wrong, GOOD))


def test_either_length_of_identifier_must_tell_messages_apart(tmp_path: Path) -> None:
    both = DBC + dbc_text({0x80000001: ("Long", ['x : 0|8@1+ (1,0) [0|0] ""'])}).split("BU_: X")[1]
    body = GOOD + '[torque]\nsignal = "Long.x"\n'
    assert len(make_plan(make_map(tmp_path, both, body)).sources) == 2
    with pytest.raises(MapError, match="two messages of the map have the identifier 0x1 in both lengths"):
        make_plan(make_map(tmp_path, both, body, 'identifiers = "either length"'))


def test_shipped_maps_load_and_fit_their_dbc() -> None:
    assert list(shipped_maps()) == [
        "cascadia_pm", "cascadia_pm_dq", "ipmsm_can", "moteus", "odrive", "openinverter", "vesc"]
    for name in shipped_maps():
        assert make_plan(load_map(name), pole_pairs=4).channels
