"""The campaign: what is drawn, how a claim is judged, that nothing recorded is lost, and that it can fail."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipmsm_can.campaign import execute, page, trial
from ipmsm_can.campaign.execute import Plan, RecordFile
from ipmsm_can.campaign.scenario import DURATION, LOSS, SPREAD, draw
from ipmsm_can.campaign.summary import summarise
from ipmsm_can.cli import main

SLICE = 24


@pytest.fixture(scope="module")
def records() -> list[dict[str, Any]]:
    """A slice of the campaign of seed 1."""
    return [trial.run(1, k, "riccati") for k in range(SLICE)]


# What is drawn


def test_a_run_follows_from_seed_and_number_alone() -> None:
    np.random.default_rng(5).random(3)
    assert draw(7, 11) == draw(7, 11)
    assert draw(7, 11) != draw(7, 12)
    assert draw(7, 11) != draw(8, 11)
    other = draw(7, 11, "ges")
    assert replace(other, kind="riccati") == draw(7, 11)


def test_the_draw_covers_what_it_promises_and_nothing_beyond() -> None:
    drawn = [draw(3, k) for k in range(600)]
    for name, most in SPREAD.items():
        off = np.array([getattr(s, f"scale_{name}") for s in drawn]) - 1.0
        assert np.abs(off).max() <= most and off.max() > 0.9 * most and off.min() < -0.9 * most
    assert {s.motor for s in drawn} == {"m1", "m2"}
    assert {s.sample_rate for s in drawn} == {2500.0, 5000.0, 10_000.0}
    assert {s.shaft for s in drawn} == {"free", "imposed", "locked"}
    assert all(s.fd for s in drawn if s.sample_rate > 5000.0), "10 kHz does not fit classical CAN"
    assert max(s.loss for s in drawn) <= LOSS and min(s.loss for s in drawn) == 0.0
    assert all(DURATION[0] <= s.duration <= DURATION[1] and 0.0 <= s.begins < s.duration for s in drawn)
    soft = np.array([s.saturation for s in drawn])
    assert 0.0 in soft and soft[soft > 0.0].min() >= 0.1 and 0.18 < soft.max() <= 0.2
    assert any(s.burst and s.burst_length > 50 for s in drawn)
    assert any(a * b < 0.0 for s in drawn for (_, a), (_, b) in zip(s.speed, s.speed[1:], strict=False))
    assert len({s.theta_0 for s in drawn}) == len(drawn)


def test_a_scenario_is_told_to_the_companion_wrong_and_to_the_machine_right() -> None:
    s = draw(1, 0)
    told = s.config().build_motor()
    for name in SPREAD:
        assert getattr(told, name) == pytest.approx(getattr(s.machine, name) * getattr(s, f"scale_{name}"))
    assert json.loads(json.dumps(s.as_dict()))["scale_R"] == s.scale_R


# How a claim is judged


def _course(**changes: Any) -> trial.Course:
    n = 1000
    at = np.arange(n)
    flags = np.ones(n, np.bool_)
    base: dict[str, Any] = {
        "scenario": replace(draw(1, 0), sample_rate=1000.0, duration=1.0, begins=0.0), "time": at / 1000.0,
        "theta": np.zeros(n), "speed": np.zeros(n), "said_at": at[::5], "said_error": np.full(n // 5, 1.0),
        "said_sigma": np.full(n // 5, 2.0), "said_valid": flags[::5], "said_locked": flags[::5], "at": at,
        "error": np.full(n, 1.0), "sigma": np.full(n, 2.0), "valid": flags, "locked": flags, "not_finite": 0,
        "lost_locks": 0, "lost_frames": 0}
    return trial.Course(**{**base, **changes})


def test_an_error_counts_only_while_the_angle_is_called_valid() -> None:
    error = np.full(1000, 1.0)
    error[400:420] = -90.0
    valid = np.ones(1000, np.bool_)
    assert trial.score(_course(error=error))["wrong"]
    valid[400:420] = False
    found = trial.score(_course(error=error, valid=valid))
    assert not found["wrong"] and found["worst"] == 1.0 and found["valid_lost"] == 1
    assert found["time_valid"] == pytest.approx(0.98)


def test_a_wrong_claim_is_told_with_its_time_and_length() -> None:
    error = np.full(1000, 1.0)
    error[400:420], error[700:705] = 15.01, 20.0
    found = trial.score(_course(error=error))
    assert found["wrong_at"] == 0.4 and found["wrong_longest"] == pytest.approx(0.02)
    assert found["samples_wrong"] == 25 and found["worst"] == 20.0
    assert not trial.score(_course(error=np.full(1000, 14.99)))["wrong"]


def test_what_only_the_wire_said_wrong_is_wrong() -> None:
    said = np.full(200, 1.0)
    said[17] = 40.0
    found = trial.score(_course(said_error=said))
    assert found["wrong"] and found["estimates_wrong"] == 1 and found["worst_said"] == 40.0


def test_the_share_within_two_sigma_and_the_histograms_agree() -> None:
    rng = np.random.default_rng(4)
    error = rng.standard_normal(1000) * 2.0
    found = trial.score(_course(error=error))
    assert found["within_2_sigma"] == np.mean(np.abs(error) < 4.0)
    assert sum(found["error_counts"]) == sum(found["ratio_counts"]) == 1000
    below = np.array(trial.ERROR_BINS[1:]) <= 2.0
    edge = np.array(trial.ERROR_BINS[1:])[below].max()
    assert np.array(found["error_counts"])[below].sum() == (np.abs(error) < edge).sum()


def test_the_wire_and_the_estimate_behind_it_say_the_same() -> None:
    c = trial.simulate(replace(draw(1, 1), loss=0.0, burst=0.0, duplication=0.0, reordering=0.0, begins=0.0,
                               duration=0.5))
    place = {int(a): k for k, a in enumerate(c.at)}
    rows = np.array([place[int(a)] for a in c.said_at])
    assert c.said_at.size > 300
    assert np.abs(np.remainder(c.said_error - c.error[rows] + 180.0, 360.0) - 180.0).max() < 0.012  # half a step
    assert np.array_equal(c.said_valid, c.valid[rows])


# The slice


def test_no_run_of_the_slice_is_valid_and_wrong(records: list[dict[str, Any]]) -> None:
    assert [r["number"] for r in records if r["wrong"] or r["exception"] or r["not_finite"]] == []
    assert sum(r["samples_valid"] for r in records) > 0.5 * sum(r["samples"] for r in records)


def test_a_run_gives_the_same_record_again(records: list[dict[str, Any]]) -> None:
    assert json.dumps(trial.run(1, 3, "riccati")) == json.dumps(records[3])


def test_an_observer_that_is_wrong_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    s = draw(1, 15)
    honest = trial.simulate
    assert not trial.score(honest(s))["wrong"]
    monkeypatch.setattr(trial, "draw", lambda seed, number, kind: s)
    monkeypatch.setattr(trial, "simulate", lambda scenario: _turned(honest(scenario)))
    assert trial.run(1, 15, "riccati")["wrong"]


def _turned(course: trial.Course) -> trial.Course:
    return replace(course, error=course.error + 30.0)


def test_an_exception_is_a_finding_and_not_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(scenario: object) -> trial.Course:
        raise ZeroDivisionError("by hand")

    monkeypatch.setattr(trial, "simulate", broken)
    assert trial.run(1, 2, "riccati")["exception"] == "ZeroDivisionError: by hand"


def test_the_summary_counts_what_the_records_say(records: list[dict[str, Any]]) -> None:
    summary = summarise(records, {"runs": SLICE, "seed": 1, "kind": "riccati"})
    assert summary["runs"] == SLICE and summary["wrong"] == []
    assert summary["samples_valid"] == sum(summary["error_counts"])
    claimed = [r["worst"] for r in records if r["worst"] is not None]
    assert summary["over_runs"]["worst"]["p50"] == pytest.approx(np.median(claimed))
    assert summary["worst"][0]["worst"] == max(claimed)
    html = page.build(summary, records, "ipmsm-can campaign")
    assert html.count("<svg") >= 6 and "nan" not in html.lower().replace("finance", "")
    assert "http" not in html.replace("http-equiv", "")


# Running


def _fake(seed: int, number: int, kind: str) -> dict[str, Any]:
    course = _course(error=np.full(1000, 40.0 if number == 2 else 1.0))
    return {**draw(seed, number, kind).as_dict(), "exception": None, **trial.score(course)}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs that take no time; number 2 is valid and wrong."""
    monkeypatch.setattr(trial, "run", _fake)


def _numbers(path: Path) -> list[int]:
    return [json.loads(line)["number"] for line in path.read_text().splitlines()[1:]]


def test_a_wrong_run_makes_exit_code_one_and_is_named(quick: None, tmp_path: Path,
                                                      capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["campaign", "--workers", "1", "--out", str(tmp_path)]
    assert main([*arguments, "--runs", "2"]) == 0
    assert "0 of 2 runs" in capsys.readouterr().out
    assert main([*arguments, "--runs", "4", "--resume"]) == 1
    said = capsys.readouterr().out
    assert "valid and wrong: run 2 (ipmsm-can campaign --seed 1 --kind riccati --only 2)" in said
    assert json.loads((tmp_path / "summary.json").read_text())["wrong"] == [2]
    assert "40.00" in (tmp_path / "campaign.html").read_text()


def test_a_killed_campaign_goes_on_where_it_was(quick: None, tmp_path: Path) -> None:
    path = tmp_path / "runs.jsonl"
    plan = Plan(6, 1, "riccati")
    file = RecordFile(path, plan, resume=False)
    whole = execute.execute(plan, file, 1)
    file.close()
    text = path.read_text()
    # Killed while the line of run 3 was being written.
    cut = text.splitlines(keepends=True)
    path.write_text("".join(cut[:4]) + cut[4][:40])
    file = RecordFile(path, plan, resume=True)
    seen: list[int] = []
    again = execute.execute(plan, file, 1, progress=lambda r: seen.append(r["number"]))
    file.close()
    assert seen == [3, 4, 5] and _numbers(path) == [0, 1, 2, 3, 4, 5]
    assert json.dumps(again) == json.dumps(whole) and path.read_text() == text


def test_records_are_on_the_disk_as_they_come(quick: None, tmp_path: Path) -> None:
    plan = Plan(4, 1, "riccati")
    file = RecordFile(tmp_path / "runs.jsonl", plan, resume=False)
    lengths: list[int] = []
    execute.execute(plan, file, 1, progress=lambda r: lengths.append(len(_numbers(tmp_path / "runs.jsonl"))))
    file.close()
    assert lengths == [1, 2, 3, 4]


def test_only_draws_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["campaign", "--only", "3", "--out", str(tmp_path)]) == 0
    html = (tmp_path / "run-3.html").read_text()
    assert "Run 3 of seed 1" in html and html.count("<svg viewBox") >= 4
    assert "run-3.html" in capsys.readouterr().out


def test_two_schedulers_give_the_same_bits(records: list[dict[str, Any]], tmp_path: Path) -> None:
    distributed: Any = pytest.importorskip("distributed")
    plan = Plan(6, 1, "riccati")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
                                  host="127.0.0.1") as cluster:
        file = RecordFile(tmp_path / "cluster.jsonl", plan, resume=False)
        far = execute.execute(plan, file, 1, scheduler=cluster.scheduler_address)
        file.close()
    file = RecordFile(tmp_path / "here.jsonl", plan, resume=False)
    here = execute.execute(plan, file, 2)
    file.close()
    assert json.dumps(far) == json.dumps(here) == json.dumps(records[:6])
    assert sorted(_numbers(tmp_path / "cluster.jsonl")) == list(range(6))


# Bad input


@pytest.mark.parametrize(("arguments", "words"), [
    (["--runs", "0"], "--runs is 0; allowed is 1 to 10000000"),
    (["--seed", "-1"], "--seed is -1; allowed is 0 to 2^63 - 1"),
    (["--workers", "0"], "--workers is 0; allowed is 1 to 64"),
    (["--workers", "2", "--scheduler", "tcp://x:1"], "--workers and --scheduler are both given"),
    (["--only", "-3"], "--only is -3; allowed is the number of a run, 0 or more"),
])
def test_bad_arguments_get_one_sentence(arguments: list[str], words: str, tmp_path: Path,
                                        capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["campaign", "--out", str(tmp_path), *arguments]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1


def test_records_that_are_there_are_not_overwritten(quick: None, tmp_path: Path,
                                                    capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["campaign", "--workers", "1", "--runs", "2", "--out", str(tmp_path)]
    assert main(arguments) == 0
    before = (tmp_path / "runs.jsonl").read_bytes()
    assert main(arguments) == 2
    assert "is there already; --resume continues it" in capsys.readouterr().err
    assert main([*arguments, "--resume", "--seed", "2"]) == 2
    assert "holds the campaign seed 1, kind riccati" in capsys.readouterr().err
    (tmp_path / "other.txt").write_text("x")
    assert main(["campaign", "--out", str(tmp_path / "other.txt")]) == 2
    assert (tmp_path / "runs.jsonl").read_bytes() == before
    (tmp_path / "runs.jsonl").write_text("hello\n")
    assert main([*arguments, "--resume"]) == 2
    assert "is not a file of a campaign's records" in capsys.readouterr().err


def test_a_missing_package_and_a_missing_scheduler_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                             capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["campaign", "--runs", "2", "--scheduler", "nowhere", "--out"]
    pytest.importorskip("distributed")
    assert main([*arguments, str(tmp_path / "a")]) == 2
    assert "--scheduler is 'nowhere', where no Dask scheduler answers" in capsys.readouterr().err

    def missing(name: str) -> object:
        raise ImportError(name)

    monkeypatch.setattr(execute, "import_module", missing)
    assert main([*arguments, str(tmp_path / "b")]) == 2
    assert "pip install 'ipmsm_can[dask]'" in capsys.readouterr().err
