"""Configurations: what is read, what is overridden, and what is refused in one line."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import yaml

from simreal.config import LearnerConfig, RunConfig
from simreal.config_files import (
    build_config,
    find_config,
    load_config,
    shipped_configs,
    split_overrides,
    to_yaml,
)
from simreal.config_keys import config_keys
from simreal.errors import UserError


def written(folder: Path, text: str) -> Path:
    path = folder / "run.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["arm_reach", "cartpole_swingup", "go2_walk"])
def test_shipped_configurations_load_and_survive_a_round_trip(name: str, tmp_path: Path) -> None:
    config = load_config(name)
    assert config.environment == name
    assert load_config(written(tmp_path, to_yaml(config))) == config


def test_a_resolved_file_writes_out_every_leaf() -> None:
    resolved = yaml.safe_load(to_yaml(RunConfig(environment="x")))
    for name in config_keys():
        value = resolved
        for part in name.split("."):
            value = value[part]


def test_equal_configurations_have_equal_json() -> None:
    one = build_config({"environment": "x", "randomizer": {"mass": [1, 2]}}, "here")
    two = build_config({"randomizer": {"mass": (1.0, 2.0)}, "environment": "x"}, "there")
    assert json.dumps(one.to_dict()) == json.dumps(two.to_dict())
    assert one == two


def test_a_learner_configuration_is_a_static_argument() -> None:
    assert hash(LearnerConfig()) == hash(LearnerConfig())
    with pytest.raises(dataclasses.FrozenInstanceError):
        LearnerConfig().clip = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("text", "rate"), [("3e-4", 3e-4), ("1E3", 1e3), ("0.5", 0.5), ("1", 1.0), (".5e-1", 0.05)]
)
def test_numbers_are_read_as_they_are_written(text: str, rate: float, tmp_path: Path) -> None:
    path = written(tmp_path, f"environment: x\nlearner:\n  reward_scale: {text}\n")
    assert load_config(path).learner.reward_scale == rate


def test_every_leaf_can_be_overridden() -> None:
    line = (
        "arm_reach --learner.learning_rate 3e-4 --out there --seed=7 --rollout.stagger false "
        "--learner.adaptive_kl null --network.policy_layers [32,16] --randomizer.link_mass [0.5,2] "
        "--randomizer.delay [0,0.02] --steps 2e6"
    )
    overrides, rest = split_overrides(line.split(), own=("--out",))
    assert rest == ["arm_reach", "--out", "there"]
    config = load_config("arm_reach", overrides)
    assert config.learner.learning_rate == 3e-4
    assert config.seed == 7
    assert config.steps == 2_000_000
    assert config.rollout.stagger is False
    assert config.learner.adaptive_kl is None
    assert config.network.policy_layers == (32, 16)
    assert config.randomizer == {"link_mass": (0.5, 2.0), "delay": (0.0, 0.02)}
    assert config.learner.discount == load_config("arm_reach").learner.discount


START = "environment: x\n"
FILES = {
    "unknown leaf": (
        START + "learner:\n  lerning_rate: 1",
        "learner.lerning_rate",
        "'learner.learning_rate'",
    ),
    "unknown section": (START + "lerner:\n  clip: 1", "lerner", "'learner'"),
    "wrong section": (START + "clip: 1", "clip", "'learner.clip'"),
    "far from any": (START + "learner:\n  zzz: 1", "learner.zzz", "valid: unroll_length"),
    "word for a number": (START + "learner:\n  clip: wide", "learner.clip", "'wide'"),
    "yes for a number": (START + "learner:\n  clip: yes", "learner.clip", "must be a float"),
    "part of a world": (START + "worlds: 2.5", "worlds", "2.5"),
    "nothing for a number": (START + "seed:", "seed", "None"),
    "number for a section": (START + "learner: 3", "learner", "section"),
    "number in a list": (START + "network:\n  policy_layers: [64, big]", "network.policy_layers[1]", "'big'"),
    "below its limit": (START + "learner:\n  clip: -1", "learner.clip", "greater than 0"),
    "infinite": (START + "learner:\n  clip: .inf", "learner.clip", "finite"),
    "no such engine": (START + "engine: warp", "engine", "'mjx'"),
    "low above high": (START + "randomizer:\n  mass: [2, 1]", "randomizer.mass", "low 2 is above high 1"),
    "half a range": (START + "randomizer:\n  mass: [2]", "randomizer.mass", "missing"),
    "indivisible": (START + "worlds: 10\nlearner:\n  minibatches: 4", "minibatches 4", "worlds 10"),
    "no environment": ("seed: 1", "environment", "missing"),
    "empty": ("", "empty", "environment"),
    "a list": ("- 1\n- 2", "mapping", "list"),
    "cut in a list": (START + "network:\n  policy_layers: [64, 6", "run.yaml:3", "not valid YAML"),
    "cut in a string": ('environment: "arm_re', "run.yaml:1", "not valid YAML"),
    "cut in a key": (START + "learner:\n  clip: 0.2\n  adap", "run.yaml:4", "not valid YAML"),
    "a key twice": (START + "seed: 1\nseed: 2", "run.yaml:3", "'seed' stands twice"),
}


@pytest.mark.parametrize("case", FILES)
def test_a_bad_file_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    text, place, hint = FILES[case]
    with pytest.raises(UserError) as caught:
        load_config(written(tmp_path, text))
    message = str(caught.value)
    assert "\n" not in message
    assert "run.yaml" in message
    assert place in message
    assert hint in message


ARGUMENTS = {
    "unknown": (["--learner.lerning_rate", "1"], "--learner.lerning_rate", "'--learner.learning_rate'"),
    "unknown, with =": (["--lerner.clip=1"], "--lerner.clip", "'--learner.clip'"),
    "like an option": (["--resumee"], "--resumee", "'--resume'"),
    "no value": (["--seed"], "--seed", "needs a value"),
    "wrong type": (["--learner.clip", "wide"], "--learner.clip", "'wide'"),
    "cut list": (["--network.policy_layers", "[64"], "--network.policy_layers", "'[64'"),
    "leaf as section": (["--seed.x=1"], "--seed.x", "unknown option"),
    "low above high": (["--randomizer.mass", "[2, 1]"], "--randomizer.mass", "low 2"),
}


@pytest.mark.parametrize("case", ARGUMENTS)
def test_a_bad_override_is_refused_in_one_line(case: str) -> None:
    arguments, place, hint = ARGUMENTS[case]
    with pytest.raises(UserError) as caught:
        load_config("arm_reach", split_overrides(arguments, own=("--resume",))[0])
    message = str(caught.value)
    assert "\n" not in message
    assert place in message
    assert hint in message


def test_a_missing_configuration_names_the_nearest() -> None:
    with pytest.raises(UserError, match="did you mean 'arm_reach'"):
        find_config("arm_reech")
    with pytest.raises(UserError, match=r"no configuration file 'gone.yaml'"):
        find_config("gone.yaml")
    assert set(shipped_configs()) == {"arm_reach", "cartpole_swingup", "go2_walk"}
