"""Adaptation to the five dynamics shifts: 2 tasks x 5 shifts x 4 variants, 100k transitions.

Every cell starts from a finished nominal run of its task; ``nominal`` says which.
"""

TASKS = {"biped": {"task": "biped"}, "hurdles": {"task": "hurdles"}}
SHIFTS = {name: {"shift": name} for name in ("bumpy", "icy", "weakened", "sloped", "gravity")}
TRAINED = {name: {"variant": name} for name in ("twirl", "twirl+weights", "weights")}
ZERO_SHOT = {"zero-shot": {"variant": "zero-shot"}}

GRID = (
    {
        "preset": "paper",
        "seeds": (0, 1, 2),
        "base": {"total_env_steps": 100_000, "eval.every": 5000},
        "axes": {"task": TASKS, "shift": SHIFTS, "variant": TRAINED | ZERO_SHOT},
    },
)

SMALL = {
    "total_env_steps": 6400,
    "warmup_env_steps": 800,
    "epoch_env_steps": 1600,
    "env.num_envs": 32,
    "droq.utd": 1.0,
    "eval.every": 3200,
    "eval.episodes": 16,
    "eval.final_episodes": 32,
}

REDUCED = (
    {
        "preset": "cpu",
        "seeds": (0, 1),
        "base": SMALL,
        "nominal": {"seed": 0},
        "axes": {"task": TASKS, "shift": SHIFTS, "variant": TRAINED},
    },
    {
        "preset": "cpu",
        "seeds": (0,),
        "base": SMALL,
        "nominal": {"seed": 0},
        "axes": {"task": TASKS, "shift": SHIFTS, "variant": ZERO_SHOT},
    },
)

REDUCED_NOTE = (
    "6.4k of 100k transitions, UTD 1 of 20, networks 2 x 128 of 2 x 256, 2 of 3 seeds that share "
    "one nominal run, 32 of 100 final episodes"
)
