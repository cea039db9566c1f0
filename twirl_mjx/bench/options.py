"""What every part of ``twirl bench`` is asked; imports nothing that simulates or learns."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.droq.config import FORM_NAMES, DroqConfig, settings_of
from twirl_mjx.machine import usable_cores
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import PRESETS, make_config
from twirl_mjx.worlds.config import WorldConfig

DEFAULT_TASK = "stand"
"""Task of measurements that name none: the cheapest."""
COMPARED: dict[str, dict[str, Any]] = {
    "plain": {"fast": False},
    "fast": {"fast": True},
    "bfloat16": {"fast": True, "matmul_dtype": "bfloat16"},
}
"""Settings of the learner (``DroqConfig``); every form is compared with the first one."""
QUARTERS = 4
"""Parts of the run whose mean returns are compared."""
PROGRAMS = ("block", "update", "epoch", "worlds")
"""What ``gpu-compile`` compiles."""
CARDS: dict[str, Mapping[str, Any]] = {
    "h100": {
        "name": "NVIDIA H100 80GB HBM3",
        "memory_bandwidth": 3_350_000_000_000,
        "device_memory_size": 80 * 10**9,
    },
    "h200": {
        "name": "NVIDIA H200",
        "memory_bandwidth": 4_800_000_000_000,
        "device_memory_size": 141 * 10**9,
    },
}
"""Card -> name, bytes/s and bytes of memory (NVIDIA data sheets)."""


@dataclasses.dataclass(frozen=True)
class LearnerBench:
    """Measure critic updates per second; the defaults are the paper's sizes on ``biped``."""

    json: bool = False
    """Print one JSON document on stdout, and nothing else."""
    seconds: float = 60.0
    """Length of all measurements together in s, without compilation."""
    rounds: int = 2
    """Times that everything is measured in turn."""
    obs: int = 101
    """Length of an observation."""
    action: int = 12
    """Length of an action."""
    batch: int = 256
    """Rows of a minibatch."""
    utd: int = 20
    """Critic updates per update of the actor."""
    hidden: int = 256
    """Units of each of the two hidden layers."""
    seeds: int | None = None
    """Learners in one program (a vmap axis); as many as CPUs by default, at least 2."""
    workers: int | None = None
    """Learners in processes pinned to one CPU each; as many as CPUs by default, 0 for none."""
    form: Literal["auto", "plain", "fast", "accelerator", "kernels"] = "auto"
    """Form of the update: the plain flax/optax one, fast (CPUs), accelerator (GPUs and TPUs),
    kernels (GPUs); auto is the one of the machine."""
    matmul_dtype: Literal["float32", "bfloat16"] = "float32"
    """Precision of matrix products (SBX always uses float32)."""
    sbx: bool = True
    """Measure SBX's DroQ too, if its environment ``.venv-bench`` exists."""

    def __post_init__(self) -> None:
        """Check every number.

        Raises:
            ValueError: A value is out of range.
        """
        check_range("seconds", self.seconds, 0.1, 3600.0)
        for name in ("rounds", "obs", "action", "batch", "utd", "hidden"):
            check_range(name, getattr(self, name), 1, 1_000_000)
        check_choice("form", self.form, ("auto", *FORM_NAMES))
        check_range("seeds", self.num_seeds, 1, 1000)
        check_range("workers", self.num_workers, 0, len(usable_cores()))

    @property
    def num_seeds(self) -> int:
        """Learners on the batch axis."""
        return max(2, len(usable_cores())) if self.seeds is None else self.seeds

    @property
    def num_workers(self) -> int:
        """Pinned learners."""
        return len(usable_cores()) if self.workers is None else self.workers

    @property
    def droq(self) -> DroqConfig:
        """Settings of the learner."""
        return DroqConfig(
            hidden_sizes=(self.hidden, self.hidden),
            batch_size=self.batch,
            utd=float(self.utd),
            updates_per_block=self.utd,
            matmul_dtype=self.matmul_dtype,
            **settings_of(self.form),
        )


@dataclasses.dataclass(frozen=True)
class StartupBench:
    """Measure the time to the first critic updates, from the shell."""

    json: bool = False
    """Print one JSON document on stdout, and nothing else."""
    task: str = DEFAULT_TASK
    """Task, trained from scratch."""
    preset: str = "cpu"
    """Sizes: paper, cpu, massive or debug."""
    repeats: int = 2
    """Starts with a filled cache."""
    seconds: float = 300.0
    """s, longest start that is waited for."""

    def __post_init__(self) -> None:
        """Check names and numbers.

        Raises:
            ValueError: Unknown name, or a value out of range.
        """
        check_choice("task", self.task, TASKS.names())
        check_choice("preset", self.preset, PRESETS)
        check_range("repeats", self.repeats, 1, 100)
        check_range("seconds", self.seconds, 1.0, 36_000.0)


@dataclasses.dataclass(frozen=True)
class EpochBench:
    """Split the cost of a training epoch, from scratch, after the warm-up."""

    json: bool = False
    """Print one JSON document on stdout, and nothing else."""
    seconds: float = 24.0
    """Length of all measurements together in s, without compilation."""
    task: str = DEFAULT_TASK
    """Task."""
    preset: str = "cpu"
    """Sizes: paper, cpu, massive or debug."""

    def __post_init__(self) -> None:
        """Check names and numbers.

        Raises:
            ValueError: Unknown name, or a value out of range.
        """
        check_choice("task", self.task, TASKS.names())
        check_choice("preset", self.preset, PRESETS)
        check_range("seconds", self.seconds, 0.1, 3600.0)

    @property
    def config(self) -> TrainConfig:
        """The run: the preset's shapes with epochs short enough to be timed several times."""
        base = make_config(self.task, self.preset)
        worlds = base.num_envs
        steps = max(1, min(base.steps_per_epoch, 640 // max(1, base.updates_per_step)))
        return dataclasses.replace(
            base,
            variant="scratch",
            warmup_env_steps=worlds,
            epoch_env_steps=steps * worlds,
        )


@dataclasses.dataclass(frozen=True)
class WorldsBench:
    """Measure worlds with random actions, beside their bare physics."""

    json: bool = False
    """Print one JSON document on stdout, and nothing else."""
    seconds: float = 40.0
    """Length of all measurements together in s, without compilation."""
    limit: float = 270.0
    """s, no further row is started after this time; rows that are left out say so."""
    engine: Literal["both", "mjx", "native"] = "both"
    """Physics engine."""
    keep: Path | None = None
    """Write the JSON document here after every row, for a caller that may end this."""
    num_envs: tuple[int, ...] = (1, 16, 128, 1024)
    """Numbers of worlds stepped together."""
    task: str = DEFAULT_TASK
    """Task."""

    def __post_init__(self) -> None:
        """Check names and numbers.

        Raises:
            ValueError: A value is out of range.
        """
        check_choice("task", self.task, TASKS.names())
        check_range("seconds", self.seconds, 0.1, 3600.0)
        check_range("limit", self.limit, 0.0, 1e6)
        if not self.num_envs:
            raise ValueError("num_envs needs at least one number of worlds")
        for number in self.num_envs:
            check_range("num_envs", number, 1, 1_000_000)

    @property
    def engines(self) -> tuple[str, ...]:
        """Engines to measure."""
        return ("native", "mjx") if self.engine == "both" else (self.engine,)


@dataclasses.dataclass(frozen=True)
class FormsBench:
    """Train with every form of the learner and compare the returns, minutes."""

    json: bool = False
    """Print one JSON document on stdout, and nothing else."""
    task: str = DEFAULT_TASK
    """Task, trained from scratch."""
    preset: str = "cpu"
    """Sizes: paper, cpu, massive or debug."""
    seeds: int = 3
    """Seeds, one program."""
    env_steps: int = 48_000
    """Transitions of each seed, rounded down to whole epochs."""
    forms: tuple[str, ...] = tuple(COMPARED)[1:]
    """Forms to compare with the plain one; bfloat16 is slow where the hardware lacks it."""

    def __post_init__(self) -> None:
        """Check names and numbers.

        Raises:
            ValueError: Unknown name, or a value out of range.
        """
        check_choice("task", self.task, TASKS.names())
        check_choice("preset", self.preset, PRESETS)
        if not self.forms:
            raise ValueError(f"forms is empty, expected some of {', '.join(tuple(COMPARED)[1:])}")
        for form in self.forms:
            check_choice("form", form, tuple(COMPARED)[1:])
        check_range("seeds", self.seeds, 2, 1000)
        epoch = self.config("fast").steps_per_epoch * self.config("fast").num_envs
        check_range("env_steps", self.env_steps, QUARTERS * epoch, 10**9)

    def config(self, form: str) -> TrainConfig:
        """Return the run with one form of the learner."""
        base = make_config(self.task, self.preset)
        droq = dataclasses.replace(base.droq, **COMPARED[form])
        return dataclasses.replace(base, variant="scratch", droq=droq)


@dataclasses.dataclass(frozen=True)
class GpuCompileBench:
    """Compile for a GPU that is not there; count operations per loop body (minutes)."""

    json: bool = False
    """Print one JSON document on stdout, and nothing else."""
    programs: tuple[str, ...] = PROGRAMS
    """block (critic updates), update (with actor and temperature), epoch (without physics), worlds
    (MJX)."""
    forms: tuple[str, ...] = FORM_NAMES
    """Forms of the learner: plain, fast, accelerator, kernels."""
    seeds: tuple[int, ...] = (1, 8)
    """Learners in one program."""
    num_envs: int = 1024
    """Worlds of the program worlds."""
    task: str = WorldConfig.task
    """Task of epoch and worlds."""
    card: str = "h100"
    """Card to compile for: h100 or h200."""
    flags: tuple[str, ...] = ()
    """Flags of XLA, as xla_gpu_enable_command_buffer=+WHILE."""

    def __post_init__(self) -> None:
        """Check names and numbers.

        Raises:
            ValueError: Unknown name, or a value out of range.
        """
        for name, values, known in (
            ("programs", self.programs, PROGRAMS),
            ("forms", self.forms, FORM_NAMES),
            ("seeds", self.seeds, ()),
        ):
            if not values:
                raise ValueError(f"{name} needs at least one value")
            for value in values:
                if known:
                    check_choice(name, str(value), known)
                else:
                    check_range(name, float(value), 1, 1000)
        check_choice("task", self.task, TASKS.names())
        check_choice("card", self.card, tuple(CARDS))
        check_range("num_envs", self.num_envs, 1, 1_000_000)
        for flag in self.flags:
            if "=" not in flag:
                raise ValueError(f"flag {flag!r} has no value (nearest: {flag + '=true'!r})")

    @property
    def options(self) -> dict[str, Any]:
        """Flags of XLA by name."""
        pairs = (flag.removeprefix("--").split("=", 1) for flag in self.flags)
        words = {"true": True, "false": False}
        return {name: words.get(value, value) for name, value in pairs}


@dataclasses.dataclass(frozen=True)
class GpuProofBench:
    """Check and time a GPU, then train on it until the time is over; goes on where it stopped."""

    json: bool = False
    """Print one JSON document on stdout, and nothing else."""
    minutes: float = 9.0
    """Time for everything."""
    out: Path = Path("runs/gpu-proof")
    """Folder of the results; a second call goes on from what is there."""
    task: str = WorldConfig.task
    """Task of the training."""
    preset: str = "cpu"
    """Settings of the training; those of cpu reach a result soonest."""
    seeds: int = 8
    """Seeds of the training, one program; 0 for no training."""
    seconds: float = 3.0
    """Length of each timing in s."""
    tiny: bool = False
    """Small networks and few variants: to try the command itself, on any machine."""

    def __post_init__(self) -> None:
        """Check names and numbers.

        Raises:
            ValueError: Unknown name, or a value out of range.
        """
        check_choice("task", self.task, TASKS.names())
        check_choice("preset", self.preset, PRESETS)
        check_range("minutes", self.minutes, 0.1, 600.0)
        check_range("seeds", self.seeds, 0, 1000)
        check_range("seconds", self.seconds, 0.1, 600.0)


@dataclasses.dataclass(frozen=True)
class GpuTableBench:
    """Write the results of a GPU into a page."""

    json: bool = False
    """Print one JSON document on stdout, and nothing else."""
    results: Path = Path("runs/gpu-proof")
    """Folder of ``twirl bench gpu-proof``."""
    page: Path = Path("docs/accelerators.md")
    """Markdown page whose marked section is replaced."""
