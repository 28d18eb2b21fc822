"""What a training run is: frozen dataclasses, checked by pydantic wherever they are built.

`simreal.config_files` reads them from YAML. The text under each field is what `simreal train --help` prints.
"""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveInt,
    TypeAdapter,
    model_validator,
)
from pydantic.dataclasses import dataclass

SETTINGS = ConfigDict(extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)


def _ordered(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError(f"low {limits[0]:g} is above high {limits[1]:g}")
    return limits


Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Range = Annotated[tuple[float, float], AfterValidator(_ordered)]


@dataclass(frozen=True, config=SETTINGS)
class NetworkConfig:
    """Policy and value networks: two multi-layer perceptrons; the policy's may remember."""

    policy_layers: tuple[PositiveInt, ...] = (128, 128)
    """Units of each hidden layer of the policy."""
    value_layers: tuple[PositiveInt, ...] = (128, 128)
    """Units of each hidden layer of the critic, which also sees the clean state and the world's draws."""
    activation: Literal["elu", "relu", "swish", "tanh"] = "elu"
    """Activation between hidden layers."""
    initial_noise: Positive = 0.7
    """Standard deviation of the untrained policy's actions, as a share of half the action range."""
    output_scale: Positive = 0.01
    """Factor on the initial weights of the policy's last layer; small: the first mean action is near 0."""
    history: PositiveInt = 1
    """Observations that the policy sees at a time: the newest and those just before it."""
    recurrent: NonNegativeInt = 0
    """Units of a recurrent layer (GRU) before the policy's; trained through the time of an unroll."""


@dataclass(frozen=True, config=SETTINGS)
class LearnerConfig:
    """Proximal policy optimisation (Schulman et al. 2017)."""

    unroll_length: PositiveInt = 24
    """Control steps of every world between two updates."""
    epochs: PositiveInt = 4
    """Passes over the collected steps in each update."""
    minibatches: PositiveInt = 4
    """Gradient steps in each pass; divides `worlds`."""
    learning_rate: Positive = 1e-3
    """Adam's step size at the start."""
    adaptive_kl: Positive | None = 0.01
    """Divergence of new from old policy that the learning rate is steered to; null keeps the rate fixed."""
    min_learning_rate: Positive = 1e-5
    """Lowest rate that the steering may reach."""
    max_learning_rate: Positive = 2e-3
    """Highest rate that the steering may reach."""
    decay_steps: Annotated[int, Field(gt=0, lt=2**32)] | None = None
    """Environment steps over which the rate, or the highest that the steering may reach, falls linearly to
    `min_learning_rate`; null: it does not fall."""
    discount: Fraction = 0.99
    """Weight of a reward one control step later."""
    gae_lambda: Fraction = 0.95
    """Mixing factor of the generalised advantage estimate (Schulman et al. 2016)."""
    clip: Positive = 0.2
    """Largest change of an action's probability ratio that still earns."""
    clip_value: Positive | None = 0.2
    """Largest change of a value estimate in one update; null does not clip it."""
    entropy_cost: NonNegative = 0.01
    """Weight of the policy's entropy in the loss: keeps it exploring."""
    value_cost: NonNegative = 0.5
    """Weight of the critic's error in the loss."""
    max_gradient_norm: Positive | None = 1.0
    """Global norm that a gradient is scaled down to; null leaves it."""
    reward_scale: Positive = 1.0
    """Factor on the reward that the learner sees; reported returns are not scaled."""
    normalize_observations: bool = True
    """Whether the networks see observations less their running mean, over their running deviation."""
    observation_clip: Positive = 10.0
    """Bound of a normalised observation, so that a world unlike any in training cannot blow it up."""
    iterations_per_epoch: PositiveInt = 10
    """Updates between two rows of metrics; also how long Ctrl-C may wait."""

    @model_validator(mode="after")
    def _rates_are_ordered(self) -> LearnerConfig:
        if self.min_learning_rate > self.max_learning_rate:
            raise ValueError(
                f"min_learning_rate {self.min_learning_rate:g} is above "
                f"max_learning_rate {self.max_learning_rate:g}"
            )
        if self.decay_steps is not None and self.min_learning_rate > self.learning_rate:
            raise ValueError(
                f"min_learning_rate {self.min_learning_rate:g}, to which the rate falls, is above "
                f"learning_rate {self.learning_rate:g}"
            )
        return self


@dataclass(frozen=True, config=SETTINGS)
class RolloutConfig:
    """How the parallel worlds are stepped."""

    reset_capacity: PositiveInt | None = None
    """Worlds reset in one pass, more in a loop; null derives it from `worlds` and the episode length."""
    reserve: PositiveInt | None = None
    """Fresh starts kept ready for worlds whose episode ends; null keeps one for each. Raise it where many
    episodes are shorter than an unroll: without one, a world waits for the next update."""
    stagger: bool = True
    """Whether the first episodes start at different ages, so that ends do not come all at once."""
    greedy_worlds: NonNegativeInt = 32
    """Extra worlds in which the mean action is taken: they give the success rate, and teach nothing."""
    quarantine_files: NonNegativeInt = 1000
    """Most worlds whose physics blew up that are written to RUN/quarantine, to be replayed; 0 writes none."""


@dataclass(frozen=True, config=SETTINGS)
class CheckpointConfig:
    """When the whole state of the run is saved."""

    every_seconds: Positive = 60.0
    """Wall time between two checkpoints, s; the last state is always saved."""
    keep: PositiveInt = 3
    """Newest checkpoints that stay on disk."""
    keep_every: PositiveInt | None = None
    """Environment steps of which one checkpoint in each such stretch stays for good; null: none."""
    keep_best: bool = True
    """Whether the checkpoint with the highest success rate stays."""


@dataclass(frozen=True, config=SETTINGS)
class EvaluationConfig:
    """What `simreal evaluate` measures unless it is told otherwise."""

    worlds: PositiveInt = 256
    """Worlds in each set, one episode in each."""
    seed: NonNegativeInt = 0
    """Seed of the worlds and of their noise; the same for every policy that is compared."""
    factor_points: NonNegativeInt = 9
    """Values of each factor on its curve; 0 draws no curves."""
    factor_worlds: PositiveInt = 64
    """Worlds at each of these values."""
    heat_map: bool = True
    """Whether success is also mapped over the two factors that matter most."""
    video: bool = True
    """Whether the report shows an episode; needs OpenGL, and goes on without."""


@dataclass(frozen=True, config=SETTINGS)
class RunConfig:
    """One training run in full: equal configurations on one machine are the same run, bit for bit."""

    environment: str
    """Name of the environment; `simreal list` shows them."""
    engine: Literal["auto", "mujoco", "mjx"] = "auto"
    """Physics engine; auto takes mujoco on a CPU and mjx on an accelerator."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of everything random in the run."""
    worlds: PositiveInt = 512
    """Worlds that are stepped in parallel and learnt from."""
    steps: Annotated[int, Field(gt=0, lt=2**32)] = 3_000_000
    """Environment steps after which training ends."""
    target_success: Annotated[float, Field(gt=0, le=1)] | None = None
    """Success rate of the mean action at which training ends before that; null trains through all steps."""
    randomization: Literal["train", "nominal"] = "train"
    """Whether every episode draws its world from the training ranges or is the nominal world."""
    randomizer: dict[str, Range] = field(default_factory=dict)
    """Training ranges that differ from the environment's own, factor: [low, high]."""
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    @model_validator(mode="after")
    def _minibatches_divide_the_worlds(self) -> RunConfig:
        if self.worlds % self.learner.minibatches:
            raise ValueError(
                f"learner.minibatches {self.learner.minibatches} does not divide worlds {self.worlds}"
            )
        return self

    def to_dict(self) -> dict[str, Any]:
        """Every setting as dicts, lists, numbers and strings; equal configurations give equal JSON."""
        return RUN_CONFIG.dump_python(self, mode="json")


RUN_CONFIG = TypeAdapter(RunConfig)
