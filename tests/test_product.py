"""The product from end to end, as a user meets it: train, look at what was written, evaluate, gate."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import simreal


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "simreal.cli", *arguments],
        check=False,
        capture_output=True,
        text=True,
        timeout=600,
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """arm_reach with half the demo's steps."""
    out = tmp_path_factory.mktemp("product") / "run"
    smaller = ["--steps", "1300000", "--evaluation.factor_points", "2", "--evaluation.factor_worlds", "8"]
    done = command("train", "arm_reach", "--out", str(out), *smaller)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.slow
def test_training_learns_and_writes_the_run_folder(run: Path) -> None:
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert {"step", "episode_return", "success_rate", "steps_per_second", "wall_seconds"} <= rows[-1].keys()
    assert rows[-1]["episode_return"] > 100
    assert rows[-1]["success_rate"] > 0.8
    for name in ("config.yaml", "manifest.json", "checkpoints", "policy/policy.json", "policy/weights.npz"):
        assert (run / name).exists(), name
    manifest = json.loads((run / "manifest.json").read_text())
    assert manifest["engine"] == "mujoco"
    assert manifest["seed"] == 0


@pytest.mark.slow
def test_evaluation_measures_reports_and_gates(run: Path) -> None:
    asked = ["--require", "train.success>=0.85", "--require", "held_out.success<0.99"]
    done = command("evaluate", str(run), "--worlds", "128", "--against", str(run), *asked)
    assert done.returncode == 0, done.stderr
    assert "held_out" in done.stdout
    assert "train" in done.stdout
    transfer = json.loads((run / "transfer.json").read_text())
    assert transfer["schema"] == 1
    assert transfer["engine"] == "mujoco"
    sets = transfer["sets"]
    assert {"nominal", "train", "held_out", "worn_motor", "heavy_tool", "laggy_bus"} == set(sets)
    low, high = sets["train"]["success"]["ci95"]
    assert low <= sets["train"]["success"]["rate"] <= high
    assert sets["train"]["success"]["rate"] >= 0.85
    assert set(transfer["factors"]) == set(simreal.make("arm_reach").randomizer.bound)
    page = (run / "report.html").read_text()
    assert len(page) > 100_000
    assert "<script" not in page
    assert "run (train)" in page  # the comparison, here with itself
    assert (run / "plots" / "heat_map.png").exists()
    assert (run / "plots" / "training.png").exists()

    refused = command(
        "evaluate", str(run), "--sets", "train", "--worlds", "32", "--require", "train.success>1"
    )
    assert refused.returncode in (2, 3)
    assert "Traceback" not in refused.stderr
    gated = command(
        "evaluate", str(run), "--sets", "train", "--worlds", "32", "--require", "train.return>=1000"
    )
    assert gated.returncode == 3
    assert "train.return" in gated.stderr + gated.stdout


@pytest.mark.slow
def test_the_policy_runs_on_the_robots_numpy_and_in_jax(run: Path) -> None:
    policy = simreal.load_policy(run)
    env = simreal.make("arm_reach")
    assert list(policy.interface.actions) == ["shoulder", "elbow"]
    assert [name for name, _ in policy.interface.observations] == [name for name, _ in env.observations]
    assert policy.interface.control_scale == pytest.approx([40.0, 20.0])
    obs = np.asarray(env.reset(jax.random.PRNGKey(0)).obs)
    memory = policy.initial_state()
    action, memory = policy(obs, memory, None)
    assert isinstance(action, np.ndarray)
    assert action.shape == (2,)
    assert memory == ()
    again, _ = jax.jit(policy)(jax.numpy.asarray(obs), (), None)
    np.testing.assert_allclose(again, action, atol=1e-5)
