"""How many updates: UTD in {1, 5, 10, 20}, adapting to the dynamics shifts.

One actor update per transition at every UTD, as in the paper's algorithm: a block of critic updates
between two actor updates is as long as the UTD.
"""

TASKS = {"biped": {"task": "biped"}, "hurdles": {"task": "hurdles"}}
SHIFTS = {name: {"shift": name} for name in ("bumpy", "icy", "weakened", "sloped", "gravity")}
UTD = {f"utd{u}": {"droq.utd": float(u), "droq.updates_per_block": u} for u in (1, 5, 10, 20)}

GRID = (
    {
        "preset": "paper",
        "seeds": (0, 1, 2),
        "base": {"variant": "twirl", "total_env_steps": 100_000, "eval.every": 5000},
        "axes": {"task": TASKS, "shift": SHIFTS, "utd": UTD},
    },
)

REDUCED = (
    {
        "preset": "cpu",
        "seeds": (0, 1),
        "base": {
            "variant": "twirl+weights",
            "total_env_steps": 12_800,
            "warmup_env_steps": 1600,
            "epoch_env_steps": 640,
            "droq.target_entropy": -12.0,
            "eval.every": 3200,
            "eval.episodes": 16,
        },
        "nominal": {"seed": 0},
        "axes": {
            "task": {"biped": {"task": "biped"}},
            "shift": {"icy": SHIFTS["icy"]},
            "utd": UTD,
        },
    },
)

REDUCED_NOTE = (
    "biped on ice only (of 2 tasks x 5 shifts), with the weights of the nominal run, 13k of 100k "
    "transitions, target entropy -12 of -6, networks 2 x 128 of 2 x 256, 2 of 3 seeds that share "
    "one nominal run"
)

RESULTS = {
    "title": "How many updates per transition (UTD)",
    "about": "Adapting with more or fewer critic updates per transition.",
    "place": 40,
    "titles": {"utd": "critic updates per transition"},
    "baseline": {"utd": "1"},
}
