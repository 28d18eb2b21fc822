"""The command line: what it prints, its exit codes, and one line for whatever is wrong with the input."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import simreal
from simreal.cli import main
from simreal.config_files import load_config
from simreal.policy import Policy, PolicyInterface
from simreal.runs import Run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of arm_reach with a policy that knows nothing."""
    folder = tmp_path_factory.mktemp("runs") / "arm"
    config = load_config("arm_reach", {"evaluation.worlds": 4, "evaluation.factor_points": 0})
    made = Run.create(folder, config)
    env = simreal.make("arm_reach")
    sizes = (env.observation_size, 8, env.action_size)
    random = np.random.default_rng(0)
    weights = {"mean": np.zeros(sizes[0], np.float32), "std": np.ones(sizes[0], np.float32)}
    for layer in range(2):
        weights[f"kernel_{layer}"] = random.normal(size=sizes[layer : layer + 2]).astype(np.float32)
        weights[f"bias_{layer}"] = np.zeros(sizes[layer + 1], np.float32)
    interface = PolicyInterface(
        environment="arm_reach",
        control_dt=0.02,
        observations=env.observations,
        actions=("shoulder", "elbow"),
        action_units=("N m", "N m"),
        control_limits=((-40, 40), (-20, 20)),
        control_offset=(0, 0),
        control_scale=(40, 20),
        activation="elu",
        observation_clip=10.0,
    )
    Policy(interface, weights).save(made.policy)
    return folder


BAD_YAML = {
    "unknown environment": ("environment: arm_reech", "arm_reach"),
    "unknown key": ("environment: arm_reach\nlearner:\n  lerning_rate: 1", "learner.learning_rate"),
    "truncated": ("environment: arm_reach\nnetwork:\n  policy_layers: [64, 6", "not valid YAML"),
}

BAD_TRAINING = {
    "missing configuration": (["gone"], "arm_reach"),
    "missing file": (["gone.yaml"], "gone.yaml"),
    "unknown factor": (["arm_reach", "--randomizer.link_mas", "[0.5, 2]"], "link_mass"),
    "unknown option": (["arm_reach", "--learner.lerning_rate", "1"], "--learner.learning_rate"),
    "low above high": (["arm_reach", "--randomizer.link_mass", "[2, 1]"], "low 2 is above high 1"),
    "negative mass": (["arm_reach", "--randomizer.link_mass", "[-1, 1]"], "link_mass"),
    "delay beyond the buffer": (["arm_reach", "--randomizer.motor_delay", "[0, 5]"], "motor_delay"),
    "unknown engine": (["arm_reach", "--engine", "warp"], "'mujoco'"),
    "no configuration": ([], "CONFIG"),
    "resume without a folder": (["--resume"], "CONFIG"),
    "resume what is not there": (["--resume", "--out", "gone"], "no run in 'gone'"),
    "one argument too many": (["arm_reach", "go2_walk"], "go2_walk"),
    "nothing to resume": (["arm_reach", "--resume", "--out", "gone"], "no run in 'gone'"),
    "nothing to start from": (["arm_reach", "--from", "gone"], "no run in 'gone'"),
}

BAD_EVALUATION = {
    "unknown set": (["--sets", "held_outt"], "held_out"),
    "no set": (["--sets", ","], "--sets"),
    "unreadable requirement": (["--require", "held_out.success>"], "--require"),
    "unknown metric": (["--require", "held_out.sucess>=0.9"], "success"),
    "requirement of an unknown set": (["--require", "held_outt.success>=0.9"], "held_out"),
    "unreadable range": (["--range", "link_mass=1"], "FACTOR=LOW:HIGH"),
    "range of an unknown factor": (["--range", "link_mas=1:2"], "link_mass"),
    "range with low above high": (["--range", "link_mass=2:1"], "low 2 is above high 1"),
    "range of negative masses": (["--range", "link_mass=-2:1"], "link_mass"),
    "comparison with nothing": (["--against", "gone"], "no run in 'gone'"),
    "no worlds": (["--worlds", "0"], "--worlds"),
    "half a world": (["--worlds", "0.5"], "--worlds"),
    "unknown engine": (["--engine", "warp"], "mujoco"),
    "unknown option": (["--jsn"], "--jsn"),
}


def assert_one_line(arguments: list[str], hint: str, capfd: pytest.CaptureFixture[str]) -> None:
    capfd.readouterr()
    assert main(arguments) == 2
    out, errors = capfd.readouterr()
    assert len(errors.splitlines()) == 1, errors
    assert errors.startswith("simreal: ")
    assert hint in errors
    assert out == ""


@pytest.mark.parametrize("case", BAD_YAML)
def test_a_bad_file_is_one_line(case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text, hint = BAD_YAML[case]
    (tmp_path / "run.yaml").write_text(text)
    assert_one_line(["train", str(tmp_path / "run.yaml"), "--out", str(tmp_path / "out")], hint, capfd)
    assert not (tmp_path / "out").exists(), "nothing is left behind by a run that never started"


@pytest.mark.parametrize("case", BAD_TRAINING)
def test_bad_arguments_of_train_are_one_line(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments, hint = BAD_TRAINING[case]
    assert_one_line(["train", *arguments], hint, capfd)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("case", BAD_EVALUATION)
def test_bad_arguments_of_evaluate_are_one_line(
    case: str, run: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments, hint = BAD_EVALUATION[case]
    assert_one_line(["evaluate", str(run), *arguments], hint, capfd)
    assert not (run / "transfer.json").exists()


def test_a_missing_or_damaged_run_is_one_line(
    run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert_one_line(["evaluate", str(run.parent / "arn")], f"did you mean '{run}'", capfd)
    broken = Path(shutil.copytree(run, tmp_path / "broken"))
    (broken / "policy" / "weights.npz").write_bytes((run / "policy" / "weights.npz").read_bytes()[:100])
    assert_one_line(["evaluate", str(broken)], "damaged", capfd)
    shutil.rmtree(broken / "policy")
    assert_one_line(["evaluate", str(broken)], "no policy", capfd)


def test_unknown_commands_and_the_missing_sweep_are_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    assert_one_line(["trian", "arm_reach"], "train", capfd)
    assert_one_line([], "COMMAND", capfd)
    assert_one_line(["sweep", "x.yaml"], "not in version 0.1", capfd)
    assert_one_line(["list", "arm_reech"], "arm_reach", capfd)


def test_list_names_environments_and_configurations(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    out = capfd.readouterr().out
    for name in ("arm_reach", "cartpole_swingup", "go2_walk"):
        assert out.count(f"\n  {name} ") == 2
    assert main(["list", "arm_reach"]) == 0
    out = capfd.readouterr().out
    assert "link_mass" in out
    assert "held_out" in out


def test_the_help_of_train_explains_every_key(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["train", "--help"])
    assert ended.value.code == 0
    out = capfd.readouterr().out
    assert "--learner.learning_rate float (0.001)" in out
    assert "--target_success float or null (null)" in out
    assert "Adam's step size" in out


def test_help_does_not_wait_for_jax() -> None:
    script = """
import sys
from simreal.cli import main
try:
    main(["list", "--help"])
finally:
    print("jax" in sys.modules)
"""
    seconds = []
    for _ in range(3):
        before = os.times()
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
        after = os.times()
        assert done.stdout.strip().endswith("False"), "jax was imported"
        # Processor time, which other programs on the machine do not lengthen.
        seconds.append(
            after.children_user + after.children_system - before.children_user - before.children_system
        )
    assert min(seconds) < 0.5


@pytest.mark.slow
def test_evaluate_writes_its_files_and_gates(run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arguments = ["evaluate", str(run), "--sets", "nominal,train", "--range", "link_mass=1.2:1.6", "--json"]
    assert main([*arguments, "--require", "train.success>=0", "--require", "range.success<=1"]) == 0
    content = json.loads(capfd.readouterr().out)
    assert set(content["sets"]) == {"nominal", "train", "range"}
    assert json.loads((run / "transfer.json").read_text()) == content
    assert (run / "report.html").is_file()
    assert content["sets"]["range"]["worlds"] == 4

    assert main([*arguments, "--require", "train.success>1"]) == 3
    errors = capfd.readouterr().err
    assert errors.splitlines()[-1].startswith("simreal: train.success>1 does not hold")

    arguments.remove("--json")
    assert main(arguments) == 0
    assert "link_mass" not in capfd.readouterr().err
