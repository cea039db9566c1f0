"""A share of source rows that chooses itself, beside the paper's half: adapting to two shifts.

The cells at 0.5 are those of the reduced ``shifts``, which also has phi 0: its ``weights``.
"""

SHIFTS = {name: {"shift": name} for name in ("icy", "gravity")}
PHI = {"phi0.5": {"replay.phi": 0.5}, "auto": {"replay.phi": "auto"}}

REDUCED = (
    {
        "preset": "cpu",
        "seeds": (0, 1, 2),
        "base": {
            "variant": "twirl+weights",
            "total_env_steps": 99_200,
            "warmup_env_steps": 1600,
            "droq.target_entropy": -12.0,
            "eval.every": 32_000,
            "eval.episodes": 16,
        },
        "axes": {"task": {"biped": {"task": "biped"}}, "shift": SHIFTS, "phi": PHI},
    },
)

GRID = tuple(
    block
    | {
        "preset": "paper",
        "base": {"variant": "twirl", "total_env_steps": 100_000, "eval.every": 5000},
    }
    for block in REDUCED
)

REDUCED_NOTE = (
    "with the weights of the nominal run, 99k of 100k transitions, UTD 0.5 of 20, target entropy "
    "-12 of -6, networks 2 x 128 of 2 x 256"
)

RESULTS = {
    "title": "A share of source data that chooses itself",
    "about": "Adapting with phi 0.5 and with phi auto.",
    "place": 35,
    "titles": {"phi": "share of source rows in a minibatch"},
    "baseline": {"phi": "0.5"},
}
