"""A run that is killed and resumed ends with the same bits as one that was left alone."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from simreal.checkpoints import Checkpoints
from simreal.runs import Run

STEPS = 64_000
OPTIONS = (
    "--worlds 16 --rollout.greedy_worlds 4 --learner.unroll_length 8 --learner.iterations_per_epoch 1 "
    "--learner.epochs 1 --network.policy_layers [16] --network.value_layers [16] "
    f"--checkpoint.every_seconds 0.2 --steps {STEPS}"
)
"""500 epochs of 128 steps: episodes end in them, so that worlds are drawn anew between the checkpoints."""


def start(engine: str, out: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "simreal.cli", "train", "cartpole_swingup", "--engine", engine]
    return subprocess.Popen(
        [*command, "--out", str(out), *OPTIONS.split(), *more],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> None:
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors


def kill_after_a_checkpoint(process: subprocess.Popen[str], out: Path, sessions: int, seconds: float) -> None:
    """SIGKILL `seconds` after the process has saved something new.

    Args:
        process: a run.
        out: its folder.
        sessions: how often it was resumed, with this process.
        seconds: from the first new checkpoint on.
    """
    deadline = time.monotonic() + 300
    run, before = Run(out), set(Checkpoints(Run(out).checkpoints).steps())
    while len(run.manifest().get("resumed", [])) < sessions or not (
        set(Checkpoints(run.checkpoints).steps()) - before
    ):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.005)
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL, "the run was over before it could be killed"


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_three_kills_do_not_change_a_bit(
    engine: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIMREAL_CACHE", str(tmp_path / "cache"))
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    finish(start(engine, whole))
    # Soon after: a fast machine is through with the whole run in a second or two.
    moments = np.random.default_rng().uniform(0.0, 0.1, 3)
    print("kills", moments, "s after a checkpoint")
    for i, seconds in enumerate(moments):
        process = start(engine, broken, *(["--resume"] if i else []))
        kill_after_a_checkpoint(process, broken, i, seconds)
    finish(start(engine, broken, "--resume"))

    assert Run(broken).manifest()["cpu_affinity"] == Run(whole).manifest()["cpu_affinity"]
    assert len(Run(broken).manifest()["resumed"]) == 3
    states = [Checkpoints(Run(run).checkpoints).raw() for run in (whole, broken)]
    assert states[0].keys() == states[1].keys()
    for name, leaf in states[0].items():
        assert leaf.tobytes() == states[1][name].tobytes(), name
    rows = [
        [
            (row["step"], row["episode_return"], row["success_rate"], row["value_loss"])
            for row in Run(run).metrics()
        ]
        for run in (whole, broken)
    ]
    assert rows[0] == rows[1]
    assert any(episode_return is not None for _, episode_return, _, _ in rows[0]), "no episode ever ended"
