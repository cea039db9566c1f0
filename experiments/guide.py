"""The nominal policy acting beside the learner that adapts it, where ``hurdles`` is hardest.

The cells without a guide are those of the reduced ``shifts``.
"""

SHIFTS = {name: {"shift": name} for name in ("icy", "sloped", "gravity")}
GUIDES = {"none": {"guide": "none"}, "best-of": {"guide": "best-of"}}

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
        "axes": {"task": {"hurdles": {"task": "hurdles"}}, "shift": SHIFTS, "guide": GUIDES},
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
    "title": "The nominal policy acts while it is adapted",
    "about": "Adapting with the better of two actions, the nominal policy's and the learner's.",
    "place": 45,
    "titles": {"guide": "who acts beside the learner"},
    "baseline": {"guide": "none"},
}
