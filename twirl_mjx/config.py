"""Configuration as frozen dataclasses, checked when built, long before anything is compiled.

Defaults are the paper's numbers; see ``presets.make_config`` and ``config_json``.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

from twirl_mjx.checks import check_choice, check_range, check_updates
from twirl_mjx.droq.config import DroqConfig

Variant = Literal["scratch", "twirl", "twirl+weights", "weights", "zero-shot"]
VARIANTS: tuple[Variant, ...] = ("scratch", "twirl", "twirl+weights", "weights", "zero-shot")
TASKS = ("stand", "biped", "imitate", "hurdles")
SHIFTS = ("none", "bumpy", "icy", "weakened", "sloped", "gravity")
SOURCE_OF = {"biped": "stand", "hurdles": "imitate"}
"""Task whose trained policy is the default source of another task."""
INT32_MAX = 2**31 - 1
"""Transitions and critic updates are counted on the device, in int32."""
SCRIPTED_SOURCES = ("trot", "bound", "zero", "random", "clip")
"""Sources nobody trained, by name; ``clip`` plays the actions planned for ``imitate.clip``."""


@dataclasses.dataclass(frozen=True)
class ReplayConfig:
    """The mixed replay (paper Alg. 1)."""

    phi: float = 0.5
    """Share of every minibatch drawn from source data; exactly round(phi * batch_size) rows."""
    capacity: int = 1_000_000
    """Transitions the online ring holds."""
    source_size: int = 50_000
    """Transitions of the source policy collected in the target task."""
    source_noise: bool = True
    """Collect with the exploration noise of a learned source, so that its data vary in action."""

    def __post_init__(self) -> None:
        """Check every number, or raise ValueError."""
        check_range("replay.phi", self.phi, 0.0, 1.0)
        check_range("replay.capacity", self.capacity, 1, 100_000_000)
        check_range("replay.source_size", self.source_size, 1, 100_000_000)


@dataclasses.dataclass(frozen=True)
class StandConfig:
    """Task ``stand``: get up on the hind legs."""

    height_of: Literal["root", "front_feet"] = "root"
    """Which height r_height rewards: the root's or the front feet's mean (README, decision 7)."""
    risen_fraction: float = 0.0
    """Share of episodes started part-way up on the hind legs, at pitch U(0, 83 deg)."""

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ValueError: A value is out of range.
        """
        check_choice("stand.height_of", self.height_of, ("root", "front_feet"))
        check_range("stand.risen_fraction", self.risen_fraction, 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class BipedConfig:
    """Task ``biped``: walk to a goal on the hind legs."""

    goal_mean_radius: float = 1.5
    """m, mean of the exponential distribution of the goal's distance."""
    goal_min_radius: float = 0.3
    """m, the drawn distance is clipped from below."""
    goal_max_radius: float = 5.0
    """m, the drawn distance is clipped from above."""
    fixed_goal: tuple[float, float] = (1.5, 0.0)
    """m, the goal when the course is fixed (dynamics shifts); on the hill in ``sloped``."""
    distance_reward: Literal["nearer", "speed"] = "nearer"
    """Pay 0.5 for being nearer than a step before (the paper's), or by the speed of approach."""
    distance_weight: float = 1.0
    """Factor on the distance term; above 1 in an easier task whose policy is a source."""

    def __post_init__(self) -> None:
        """Check every option, or raise ValueError."""
        check_choice("biped.distance_reward", self.distance_reward, ("nearer", "speed"))
        check_range("biped.distance_weight", self.distance_weight, 0.0, 100.0)
        check_range("biped.goal_mean_radius", self.goal_mean_radius, 0.0, 100.0)
        check_range("biped.goal_max_radius", self.goal_max_radius, 0.0, 100.0)
        check_range("biped.goal_min_radius", self.goal_min_radius, 0.0, self.goal_max_radius)
        for coordinate in self.fixed_goal:
            check_range("biped.fixed_goal", coordinate, -100.0, 100.0)


@dataclasses.dataclass(frozen=True)
class ImitateConfig:
    """Task ``imitate``: track a leap clip."""

    clip: str = "leap"
    """``leap`` (ours) or the path of a clip file."""
    standing_fraction: float = 0.0
    """Share of episodes started at rest on four feet, as the episodes of ``hurdles`` are."""
    max_root_error: float = 1.0
    """m, an episode ends beyond this distance from the reference root."""
    max_root_angle: float = 1.5707963
    """rad, an episode ends beyond this rotation from the reference root."""

    def __post_init__(self) -> None:
        """Check every number, or raise ValueError."""
        check_range("imitate.standing_fraction", self.standing_fraction, 0.0, 1.0)
        check_range("imitate.max_root_error", self.max_root_error, 1e-3, 1e3)
        check_range("imitate.max_root_angle", self.max_root_angle, 1e-3, 3.1416)


@dataclasses.dataclass(frozen=True)
class HurdlesConfig:
    """Task ``hurdles``: jump over randomly spaced hurdles."""

    min_gap: float = 1.6
    """m, smallest distance between neighbouring hurdles, and to the first."""
    max_gap: float = 2.6
    """m, largest distance."""
    fixed_gap: float = 2.1
    """m, distance when the course is fixed (dynamics shifts)."""
    hurdle_bonus: Literal["count", "event", "clean"] = "count"
    """Pay the number of hurdles passed so far at every step, or 1 when one is passed, or the
    number passed in a single flight so far at every step."""

    def __post_init__(self) -> None:
        """Check the options (the task has a stricter check of the gaps), or raise ValueError."""
        check_choice("hurdles.hurdle_bonus", self.hurdle_bonus, ("count", "event", "clean"))
        for name in ("min_gap", "max_gap", "fixed_gap"):
            check_range(f"hurdles.{name}", getattr(self, name), 0.0, 1000.0)


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """The worlds."""

    num_envs: int = 16
    """Worlds stepped together."""
    episode_length: int = 400
    """Control steps of an episode (20 s at 20 Hz)."""
    train_episode_length: int | None = None
    """Control steps before truncation while training; ``episode_length`` when not given."""
    engine: Literal["auto", "mjx", "native"] = "auto"
    """Physics engine; auto is mjx on an accelerator and native (C MuJoCo threads) on a CPU."""
    course: Literal["auto", "random", "fixed"] = "auto"
    """Goals and hurdles; auto is random without a shift, fixed under one (README, decision 11)."""

    def __post_init__(self) -> None:
        """Check every number.

        Raises:
            ValueError: A value is out of range.
        """
        check_range("env.num_envs", self.num_envs, 1, 1_000_000)
        check_range("env.episode_length", self.episode_length, 1, 1_000_000)
        if self.train_episode_length is not None:
            check_range("env.train_episode_length", self.train_episode_length, 1, 1_000_000)
        check_choice("env.engine", self.engine, ("auto", "mjx", "native"))
        check_choice("env.course", self.course, ("auto", "random", "fixed"))


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """Evaluation during training: deterministic policy, its own seeds."""

    every: int = 10_000
    """Environment transitions between evaluations; rounded up to whole epochs."""
    episodes: int = 16
    """Episodes per evaluation."""
    final_episodes: int = 100
    """Episodes of the evaluation that closes a run."""
    seed: int = 1_000_003
    """Seed of evaluation during training; the final one uses ``seed + 1``."""

    def __post_init__(self) -> None:
        """Check every number.

        Raises:
            ValueError: A value is out of range.
        """
        check_range("eval.every", self.every, 1, 10**12)
        check_range("eval.episodes", self.episodes, 1, 1_000_000)
        check_range("eval.final_episodes", self.final_episodes, 1, 1_000_000)
        check_range("eval.seed", self.seed, 0, 2**32 - 2)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """One training run."""

    task: str = "biped"
    """stand, biped, imitate or hurdles."""
    shift: str = "none"
    """Dynamics shift: none, bumpy, icy, weakened, sloped or gravity."""
    shift_strength: float = 1.0
    """0 is nominal, 1 the paper's value."""
    variant: Variant = "twirl"
    """scratch, twirl, twirl+weights, weights or zero-shot."""
    source: str = "auto"
    """auto (shipped policy, else train it), train, trot, bound, zero, random, clip, or a file."""
    seed: int = 0
    """Random seed of the run."""
    total_env_steps: int = 1_000_000
    """Environment transitions to gather."""
    warmup_env_steps: int = 1000
    """Transitions with uniformly random actions before the first update."""
    env: EnvConfig = EnvConfig()
    """The worlds."""
    droq: DroqConfig = DroqConfig()  # noqa: RUF009 (frozen)
    """The learner."""
    replay: ReplayConfig = ReplayConfig()
    """The mixed replay."""
    eval: EvalConfig = EvalConfig()
    """Evaluation during training."""
    stand: StandConfig = StandConfig()
    """Options of task stand."""
    biped: BipedConfig = BipedConfig()
    """Options of task biped."""
    imitate: ImitateConfig = ImitateConfig()
    """Options of task imitate."""
    hurdles: HurdlesConfig = HurdlesConfig()
    """Options of task hurdles."""
    epoch_env_steps: int = 2000
    """Transitions per compiled epoch, after which Python logs; rounded to whole vector steps."""
    checkpoint_minutes: float = 5.0
    """Wall time between checkpoints of the full training state."""

    def __post_init__(self) -> None:
        """Check names, ranges and divisibility.

        Raises:
            ValueError: With the numbers and the nearest valid choice.
        """
        check_choice("task", self.task, TASKS)
        check_choice("shift", self.shift, SHIFTS)
        check_choice("variant", self.variant, VARIANTS)
        check_range("shift_strength", self.shift_strength, 0.0, 2.0)
        check_range("seed", self.seed, 0, 2**32 - 1)  # 2**32 would be seed 0 again
        check_range("warmup_env_steps", self.warmup_env_steps, 0, INT32_MAX)
        countable = int(INT32_MAX // max(1.0, self.droq.utd))
        check_range("epoch_env_steps", self.epoch_env_steps, 1, min(10**9, countable // 2))
        check_range("checkpoint_minutes", self.checkpoint_minutes, 0.0, 1e6)
        check_updates(self.droq.utd, self.env.num_envs, self.droq.updates_per_block)
        per_epoch = self.steps_per_epoch * self.env.num_envs
        check_range("total_env_steps", self.total_env_steps, 1, countable - per_epoch)
        if self.replay.capacity < self.env.num_envs:
            raise ValueError(
                f"replay.capacity {self.replay.capacity} is below env.num_envs {self.env.num_envs}"
            )

    @property
    def updates_per_step(self) -> int:
        """Critic updates after each vector step, ``utd * num_envs``."""
        return round(self.droq.utd * self.env.num_envs)

    @property
    def blocks_per_step(self) -> int:
        """Blocks of critic updates (each with one actor update) after each vector step."""
        return self.updates_per_step // self.droq.updates_per_block

    @property
    def steps_per_epoch(self) -> int:
        """Vector steps in one compiled epoch."""
        return max(1, round(self.epoch_env_steps / self.env.num_envs))

    @property
    def uses_source_data(self) -> bool:
        """Whether minibatches hold source rows."""
        return self.variant in ("twirl", "twirl+weights") and self.effective_phi > 0.0

    @property
    def uses_source_weights(self) -> bool:
        """Whether the networks begin as the source's."""
        return self.variant in ("weights", "twirl+weights")

    @property
    def effective_phi(self) -> float:
        """Phi of this variant: 0 unless it trains on source data."""
        return self.replay.phi if self.variant in ("twirl", "twirl+weights") else 0.0

    @property
    def fixed_course(self) -> bool:
        """Whether goals and hurdles are fixed."""
        if self.env.course == "auto":
            return self.shift != "none"
        return self.env.course == "fixed"
