"""The training loop: killed, interrupted, resumed, refused, and ended in time."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simreal.checkpoints import Checkpoints
from simreal.config import CheckpointConfig, RunConfig
from simreal.errors import UserError
from simreal.keeping import holds_target
from simreal.runs import Run
from simreal.training import train
from tests.toy_learner import STEPS_PER_EPOCH, ToyLearner

TOY = Path(__file__).parent / "toy_learner.py"
CONFIG = RunConfig(environment="toy", steps=1000, checkpoint=CheckpointConfig(every_seconds=1e-6, keep=3))


def train_toy(out: Path, config: RunConfig = CONFIG, **options: Any) -> Path:
    return train(config, out, build=ToyLearner, **options)  # type: ignore[arg-type]


def start_toy(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(TOY), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=TOY.parents[1],
    )


def policy_bytes(run: Path) -> bytes:
    with np.load(run / "policy" / "weights.npz") as weights:
        return weights["weights"].tobytes()


def without_times(run: Path) -> list[dict[str, Any]]:
    rows = Run(run).metrics()
    return [{k: v for k, v in row.items() if k not in ("steps_per_second", "wall_seconds")} for row in rows]


def test_a_run_folder_holds_what_the_design_page_promises(tmp_path: Path) -> None:
    run = Run(train_toy(tmp_path / "run"))
    assert run.config() == CONFIG
    manifest = run.manifest()
    assert {"versions", "commit", "device", "engine", "seed", "randomizer", "cpu_affinity"} <= set(manifest)
    rows = run.metrics()
    assert [row["step"] for row in rows] == list(range(STEPS_PER_EPOCH, 1001, STEPS_PER_EPOCH))
    assert {"step", "episode_return", "success_rate", "steps_per_second", "wall_seconds"} <= set(rows[0])
    assert rows[0]["episode_return"] is None, "a return before any episode ended is null, which is JSON"
    assert sorted(int(path.name) for path in run.checkpoints.iterdir()) == [800, 900, 1000]
    assert run.policy.is_dir()
    assert any(run.events.iterdir())


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_bits(tmp_path: Path) -> None:
    whole = train_toy(tmp_path / "whole")
    broken = tmp_path / "broken"
    for kill_at in (100, 300, 800):
        process = start_toy(broken, "--kill-at", str(kill_at), *(["--resume"] if broken.exists() else []))
        process.communicate(timeout=120)
        assert process.returncode == -signal.SIGKILL
    with (broken / "metrics.jsonl").open("a") as file:
        file.write('{"step": 900, "episode_return": 1.0}\n{"step": 10')  # written after the last checkpoint
    train_toy(broken, resume=True)
    assert policy_bytes(broken) == policy_bytes(whole)
    assert without_times(broken) == without_times(whole)
    resumed = [session["step"] for session in Run(broken).manifest()["resumed"]]
    # One interval is repeated, and what was trained while the next checkpoint was being written.
    assert resumed[0] == 0
    assert resumed[1] in (100, 200)
    assert resumed[2] in (600, 700)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_saves_and_says_so_in_one_line(number: int, tmp_path: Path) -> None:
    whole = train_toy(tmp_path / "whole")
    out = tmp_path / "run"
    process = start_toy(out, "--pause", "0.3")
    deadline = time.monotonic() + 60
    while not Run(out).metrics() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert len(errors.splitlines()) == 1
    assert "--resume" in errors
    last = Run(out).metrics()[-1]["step"]
    assert last < 1000
    assert f"step {last:,} is saved" in errors
    assert (out / "policy").is_dir()
    train_toy(out, resume=True)
    assert policy_bytes(out) == policy_bytes(whole)


def test_a_finished_run_is_not_trained_further_unless_asked(tmp_path: Path) -> None:
    out = train_toy(tmp_path / "run")
    before = policy_bytes(out)
    train_toy(out, resume=True)
    assert policy_bytes(out) == before
    longer = RunConfig(environment="toy", steps=1200)
    train_toy(out, longer, resume=True)
    assert Run(out).metrics()[-1]["step"] == 1200
    assert Run(out).config() == longer


def test_a_run_is_never_overwritten(tmp_path: Path) -> None:
    out = train_toy(tmp_path / "run")
    before = sorted(out.rglob("*"))
    with pytest.raises(UserError, match="--resume goes on with the run in it, --out starts one elsewhere"):
        train_toy(out)
    assert sorted(out.rglob("*")) == before


def test_resuming_needs_a_run_and_the_same_configuration(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no run in"):
        train_toy(tmp_path / "gone", resume=True)
    out = train_toy(tmp_path / "run")
    with pytest.raises(UserError, match=f"did you mean '{out}'"):
        train_toy(tmp_path / "runn", resume=True)
    with pytest.raises(UserError, match="seed is 1 here and 0 in"):
        train_toy(out, RunConfig(environment="toy", steps=1000, seed=1), resume=True)


class FadingToy(ToyLearner):
    """Its success rises up to step 500, and falls again."""

    def epoch(self, state: Any, watch: Any = None) -> tuple[Any, dict[str, float]]:
        state, metrics = super().epoch(state, watch)
        return state, metrics | {"success_rate": 1 - abs(float(state.steps) - 500) / 1000}


def test_what_was_best_stays_beside_the_last(tmp_path: Path) -> None:
    kept = CheckpointConfig(every_seconds=1e-6, keep=1, keep_every=400)
    config = RunConfig(environment="toy", steps=1000, checkpoint=kept)
    run = Run(train(config, tmp_path / "run", build=FadingToy))  # type: ignore[arg-type]
    # Over three epochs the mean is highest up to step 600; then one of each 400 steps, and the last.
    assert Checkpoints(run.checkpoints).steps() == [100, 400, 600, 800, 1000]
    assert Checkpoints(run.checkpoints).best() == 600
    short = train_toy(tmp_path / "short", RunConfig(environment="toy", steps=600))
    assert (run.best_policy / "weights.npz").read_bytes() == (short / "policy" / "weights.npz").read_bytes()
    assert (run.policy / "weights.npz").read_bytes() != (short / "policy" / "weights.npz").read_bytes()


def test_training_ends_when_success_is_held(tmp_path: Path) -> None:
    config = RunConfig(environment="toy", steps=1000, target_success=0.5)
    run = Run(train_toy(tmp_path / "run", config))
    assert [row["success_rate"] for row in run.metrics()][-3:] == pytest.approx([0.5, 0.6, 0.7])


@pytest.mark.parametrize(
    ("rates", "held"),
    [
        ([0.9, 0.9, 0.9], True),
        ([0.9, 0.9], False),
        ([0.9, 0.8, 0.9], False),
        ([None, 0.9, 0.9], False),
        ([float("nan"), 0.9, 0.9], False),
        ([0.1, 0.9, 0.95, 1.0], True),
    ],
)
def test_a_target_must_be_held_for_three_epochs(rates: list[float | None], held: bool) -> None:
    assert holds_target([{"success_rate": rate} for rate in rates], 0.9) is held
    assert not holds_target([{"success_rate": rate} for rate in rates], None)


@pytest.mark.slow
def test_parameters_that_are_not_finite_never_reach_a_checkpoint(tmp_path: Path) -> None:
    out = tmp_path / "run"
    process = start_toy(out, "--poison-at", "500")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert len(errors.splitlines()) == 1
    assert "no longer finite after step 400" in errors
    assert "the checkpoint at step 400 is intact" in errors
    assert np.isfinite(np.frombuffer(policy_bytes(out), np.float32)).all()
    assert sorted(int(path.name) for path in (out / "checkpoints").iterdir()) == [200, 300, 400]


def test_a_run_can_start_from_the_policy_of_another(tmp_path: Path) -> None:
    first = train_toy(tmp_path / "first")
    config = RunConfig(environment="toy", steps=100, seed=5)
    second = train_toy(tmp_path / "second", config, from_run=first)
    fresh = train_toy(tmp_path / "fresh", config)
    weights, from_nothing = (np.frombuffer(policy_bytes(run), np.float32) for run in (second, fresh))
    start = np.frombuffer(policy_bytes(first), np.float32)
    np.testing.assert_allclose(weights - from_nothing, 0.9 * start, rtol=1e-5)
    assert Run(second).manifest()["from"] == {"run": str(first), "step": 1000}
    assert [row["step"] for row in Run(second).metrics()] == [100]


def test_rows_are_json_to_the_letter(tmp_path: Path) -> None:
    run = Run(train_toy(tmp_path / "run"))

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    for line in run.metrics_file.read_text().splitlines():
        json.loads(line, parse_constant=refuse)
