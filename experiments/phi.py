"""How much source data: phi in {0, 0.25, 0.5, 0.75}, adapting to the dynamics shifts.

The paper runs its ablations as adaptation with 100k transitions, in several target environments.
"""

TASKS = {"biped": {"task": "biped"}, "hurdles": {"task": "hurdles"}}
SHIFTS = {name: {"shift": name} for name in ("bumpy", "icy", "weakened", "sloped", "gravity")}
PHI = {f"phi{phi:g}": {"replay.phi": phi} for phi in (0.0, 0.25, 0.5, 0.75)}

GRID = (
    {
        "preset": "paper",
        "seeds": (0, 1, 2),
        "base": {"variant": "twirl", "total_env_steps": 100_000, "eval.every": 5000},
        "axes": {"task": TASKS, "shift": SHIFTS, "phi": PHI},
    },
)

REDUCED = (
    {
        "preset": "cpu",
        "seeds": (0, 1, 2),
        "base": {  # at phi 0.5 and seed 0 the cells of the reduced ``shifts``
            "variant": "twirl+weights",
            "total_env_steps": 99_200,
            "warmup_env_steps": 1600,
            "droq.target_entropy": -12.0,
            "eval.every": 32_000,
            "eval.episodes": 16,
        },
        "nominal": {"seed": 0},
        "axes": {
            "task": {"biped": {"task": "biped"}},
            "shift": {name: SHIFTS[name] for name in ("icy", "gravity")},
            "phi": PHI,
        },
    },
)

REDUCED_NOTE = (
    "biped on ice and under low gravity only (of 2 tasks x 5 shifts), with the weights of the "
    "nominal run, 99k of 100k transitions, UTD 0.5 of 20, target entropy -12 of -6, networks "
    "2 x 128 of 2 x 256, 3 seeds that share one nominal run"
)

RESULTS = {
    "title": "How much source data (phi)",
    "about": "Adapting with a share phi of source rows in every minibatch.",
    "place": 30,
    "titles": {"phi": "share of source rows in a minibatch"},
    "baseline": {"phi": "0"},
}
