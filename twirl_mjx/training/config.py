"""Configuration of a training run: frozen dataclasses, checked when built.

Defaults are the paper's numbers; see ``presets.make_config`` and ``config_json``.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, get_args

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.replay.config import AUTO, Phi, ReplayConfig
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training.learners import DROQ, LEARNERS, settings_of
from twirl_mjx.worlds.config import WorldConfig, world_fields

Variant = Literal["scratch", "twirl", "twirl+weights", "weights", "zero-shot"]
Keep = Literal["best", "last"]
Guidance = Literal["none", "best-of"]
VARIANTS: tuple[Variant, ...] = ("scratch", "twirl", "twirl+weights", "weights", "zero-shot")
INT32_MAX = 2**31 - 1
"""Transitions and critic updates are counted on the device, in int32."""


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """Evaluation during training: deterministic policy, its own seeds."""

    every: int = 10_000
    """Environment transitions between evaluations; rounded up to whole epochs."""
    episodes: int = 16
    """Episodes per evaluation."""
    final_episodes: int = 100
    """Episodes of the evaluation that closes a run."""
    episode_length: int = 400
    """Control steps of an evaluation episode, and of those that record a source (20 s)."""
    seed: int = 1_000_003
    """Seed of evaluation during training; the final one uses ``seed + 1``."""
    keep: Keep = "best"
    """The policy of a run is that of its best evaluation, by the return, or of its last."""

    def __post_init__(self) -> None:
        """Check every number.

        Raises:
            ValueError: A value is out of range.
        """
        check_choice("eval.keep", self.keep, get_args(Keep))
        check_range("eval.every", self.every, 1, 10**12)
        check_range("eval.episodes", self.episodes, 1, 1_000_000)
        check_range("eval.final_episodes", self.final_episodes, 1, 1_000_000)
        check_range("eval.episode_length", self.episode_length, 1, 1_000_000)
        check_range("eval.seed", self.seed, 0, 2**32 - 2)


@dataclasses.dataclass(frozen=True)
class TrainConfig(WorldConfig):
    """One training run: the worlds it trains in, and everything else."""

    variant: Variant = "twirl"
    """scratch, twirl, twirl+weights, weights or zero-shot."""
    source: str = "auto"
    """auto (shipped policy, else train it), train, trot, bound, zero, random, clip, a run, a policy
    file (.npz, .onnx), recorded data (.npz) or file.py:function of your own."""
    guide: Guidance = "none"
    """Let the source act too, where the critic values its action higher (best-of)."""
    source_contract: str = ""
    """How a foreign source meets the robot: go1_joystick, legged_gym_48, legged_gym_45, ... or a
    JSON file (docs/sources.md); by default what the file itself says."""
    source_command: str = ""
    """What a foreign source is told to do: 0.5,0,0 (m/s forward, m/s left, rad/s yaw) or
    towards-goal:0.5; by default the constants of its contract."""
    allow_clipping: bool = False
    """Record a source although more than 20 % of its joint targets lie outside the action box."""
    source_options: Any = None
    """Options of the task whose policy is the default source; None where there is none."""
    seed: int = 0
    """Random seed of the run."""
    total_env_steps: int = 1_000_000
    """Environment transitions to gather."""
    warmup_env_steps: int = 1000
    """Transitions with uniformly random actions before the first update."""
    learner: str = DROQ
    """Name of the learner, or file.py:NAME of your own."""
    droq: Any = DroqConfig()
    """Settings of the learner, under its own name on the command line."""
    replay: ReplayConfig = ReplayConfig()
    """The mixed replay."""
    eval: EvalConfig = EvalConfig()
    """Evaluation during training."""
    epoch_env_steps: int = 2000
    """Transitions per compiled epoch, after which Python logs; rounded to whole vector steps."""
    checkpoint_minutes: float = 5.0
    """Wall time between checkpoints of the full training state."""
    refill: bool = False
    """Where checkpoints/replay was left behind, or is damaged: gather as much anew with the policy,
    and resume. Not bit for bit then."""

    def __post_init__(self) -> None:
        """Check names, ranges and divisibility.

        Raises:
            ValueError: With the numbers and the nearest valid choice.
        """
        super().__post_init__()
        for reference in self.uses:
            LEARNERS.admit_if_fits(reference)
        self._set("learner", LEARNERS.admit(self.learner))
        if reference := LEARNERS.reference(self.learner):
            self._set("uses", tuple(sorted({*self.uses, reference})))
        settings = settings_of(self.learner)
        if type(self.droq) is not settings:
            if self.droq != DroqConfig():
                raise ValueError(
                    f"learner {self.learner} has settings of {settings.__name__}, not"
                    f" {type(self.droq).__name__}"
                )
            self._set("droq", settings())
        if self.task in (names := tuple(field.name for field in dataclasses.fields(self))):
            raise ValueError(
                f"task {self.task!r} has the name of a field of a run's config, where its options"
                f" would stand (taken: {', '.join(names)}; nearest: 'my_{self.task}')"
            )
        if self.source_options is None and self.task_type.source:
            self._set("source_options", TASKS.get(self.task_type.source).Options())
        check_choice("variant", self.variant, VARIANTS)
        check_choice("guide", self.guide, get_args(Guidance))
        if self.guide != "none" and self.variant not in ("twirl", "twirl+weights"):
            raise ValueError(
                f"guide {self.guide} comes on top of mixed replay, which variant {self.variant} has"
                " not (nearest: variant twirl)"
            )
        check_range("seed", self.seed, 0, 2**32 - 1)  # 2**32 would be seed 0 again
        check_range("warmup_env_steps", self.warmup_env_steps, 0, INT32_MAX)
        countable = int(INT32_MAX // max(1.0, self.droq.utd))
        check_range("epoch_env_steps", self.epoch_env_steps, 1, min(10**9, countable // 2))
        check_range("checkpoint_minutes", self.checkpoint_minutes, 0.0, 1e6)
        check_updates(self.droq.utd, self.num_envs, self.droq.updates_per_block)
        per_epoch = self.steps_per_epoch * self.num_envs
        check_range("total_env_steps", self.total_env_steps, 1, countable - per_epoch)
        check_source_rows(self.effective_phi, self.droq.batch_size)
        if self.replay.phi == AUTO and not self.uses_source_data:
            raise ValueError(
                f"replay.phi auto chooses a share of source rows, and variant {self.variant} has"
                " none (nearest: variant 'twirl')"
            )
        if self.replay.capacity < self.num_envs:
            raise ValueError(
                f"replay.capacity {self.replay.capacity} is below num_envs {self.num_envs}"
            )

    @property
    def updates_per_step(self) -> int:
        """Critic updates after each vector step, ``utd * num_envs``."""
        return round(self.droq.utd * self.num_envs)

    @property
    def blocks_per_step(self) -> int:
        """Blocks of critic updates (each with one actor update) after each vector step."""
        return self.updates_per_step // self.droq.updates_per_block

    @property
    def steps_per_epoch(self) -> int:
        """Vector steps in one compiled epoch."""
        return max(1, round(self.epoch_env_steps / self.num_envs))

    @property
    def uses_source_data(self) -> bool:
        """Whether minibatches hold source rows."""
        return self.effective_phi != 0.0

    @property
    def uses_source_weights(self) -> bool:
        """Whether the networks begin as the source's."""
        return self.variant in ("weights", "twirl+weights")

    @property
    def effective_phi(self) -> Phi:
        """Phi of this variant: 0 unless it trains on source data."""
        return self.replay.phi if self.variant in ("twirl", "twirl+weights") else 0.0

    @property
    def evaluation(self) -> WorldConfig:
        """The worlds it evaluates in: as trained in, without what is for training only."""
        return WorldConfig(
            **{
                **world_fields(self),
                "options": self.task_type.evaluation_options(self.options),
                "num_envs": self.eval.episodes,
                "episode_length": self.eval.episode_length,
            }
        )


def of_program(config: TrainConfig) -> TrainConfig:
    """Return a config without what the runs of one program may differ in.

    That is the seed, phi, and where the source is, which each run has for itself.
    """
    replay = dataclasses.replace(config.replay, phi=0.0)
    return dataclasses.replace(config, seed=0, source="auto", replay=replay)


def check_source_rows(phi: Phi, batch_size: int) -> None:
    """Check that a minibatch holds a row of each side that ``phi`` asks for.

    Raises:
        ValueError: ``phi`` rounds to none, or to all; the message has the nearest that does not.
    """
    if isinstance(phi, str):
        if batch_size < 2:
            raise ValueError(
                f"replay.phi {phi} needs a row of each side in a minibatch, and droq.batch_size is"
                f" {batch_size} (nearest: 2)"
            )
        return
    rows = round(phi * batch_size)
    if phi in (0.0, 1.0) or 0 < rows < batch_size:
        return
    if batch_size == 1:
        nearest, what = (0.0, "source") if not rows else (1.0, "online")
    else:
        nearest, what = (1 / batch_size, "source") if not rows else (1 - 1 / batch_size, "online")
    raise ValueError(
        f"replay.phi {phi:g} of droq.batch_size {batch_size} rounds to no {what} row (nearest:"
        f" {nearest:g})"
    )


def check_updates(utd: float, num_envs: int, updates_per_block: int) -> None:
    """Check that UTD gives whole blocks of critic updates per vector step, rounding apart.

    Raises:
        ValueError: With the numbers, and the nearest ``utd`` that divides.
    """
    updates = utd * num_envs
    blocks = max(1, round(updates / updates_per_block))
    if abs(updates - blocks * updates_per_block) > 1e-5 * updates:
        raise ValueError(
            f"droq.utd {utd:g} x num_envs {num_envs} = {updates:g} critic updates per"
            f" vector step, which is not a whole number of blocks of droq.updates_per_block"
            f" {updates_per_block} (nearest: utd {blocks * updates_per_block / num_envs:g})"
        )
