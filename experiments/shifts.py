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

SHORT = {
    "total_env_steps": 99_200,
    "warmup_env_steps": 1600,
    "droq.target_entropy": -12.0,
    "eval.every": 32_000,
    "eval.episodes": 16,
}

WARM = {name: TRAINED[name] for name in ("twirl+weights", "weights")}

REDUCED = (
    {
        "preset": "cpu",
        "seeds": (0, 1, 2),
        "base": SHORT,
        "axes": {"task": TASKS, "shift": SHIFTS, "variant": WARM | ZERO_SHOT},
    },
)

REDUCED_NOTE = (
    "99k of 100k transitions, UTD 0.5 of 20, target entropy -12 of -6, networks 2 x 128 of 2 x 256,"
    " without plain twirl"
)

RESULTS = {
    "title": "Adapting to changed dynamics",
    "about": "Adapting a finished policy to a shift; weights: its networks without its data.",
    "place": 20,
    "baseline": {"variant": "weights"},
}
