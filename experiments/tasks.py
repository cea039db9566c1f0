"""TWiRL, learning from scratch and the bare source policy, on both tasks.

Learning from scratch gets three times the transitions on the hurdles, as in the paper. Zero-shot
is the source policy in the target task: nothing in it depends on the seed, so it has one. The
reduced form only shows that the whole way works: it is a smoke run, and no result.
"""

TWIRL_AND_SCRATCH = {"twirl": {"variant": "twirl"}, "scratch": {"variant": "scratch"}}
ZERO_SHOT = {"zero-shot": {"variant": "zero-shot"}}
BIPED = {"biped": {"task": "biped"}}
HURDLES = {"hurdles": {"task": "hurdles"}}

GRID = (
    {
        "preset": "paper",
        "seeds": (0, 1, 2),
        "axes": {"task": BIPED, "variant": TWIRL_AND_SCRATCH},
    },
    {
        "preset": "paper",
        "seeds": (0, 1, 2),
        "axes": {
            "task": HURDLES,
            "variant": {
                "twirl": {"variant": "twirl"},
                "scratch": {"variant": "scratch", "total_env_steps": 3_000_000},
            },
        },
    },
    {"preset": "paper", "seeds": (0,), "axes": {"task": BIPED | HURDLES, "variant": ZERO_SHOT}},
)

SMALL = {
    "total_env_steps": 19_200,
    "warmup_env_steps": 3200,
    "epoch_env_steps": 3200,
    "droq.utd": 1.0,
    "replay.source_size": 20_000,
    "eval.every": 3200,
    "eval.episodes": 16,
    "eval.final_episodes": 32,
}

REDUCED = (
    {
        "preset": "cpu",
        "seeds": (0, 1),
        "smoke": True,
        "base": SMALL,
        "axes": {"task": BIPED | HURDLES, "variant": TWIRL_AND_SCRATCH},
    },
    {
        "preset": "cpu",
        "seeds": (0,),
        "smoke": True,
        "base": SMALL,
        "axes": {"task": BIPED | HURDLES, "variant": ZERO_SHOT},
    },
)

REDUCED_NOTE = (
    "19k of 1M transitions (scratch on hurdles: of 3M), UTD 1 of 20, networks 2 x 128 of 2 x 256, "
    "2 of 3 seeds, 32 of 100 final episodes"
)

RESULTS = {
    "title": "TWiRL, learning from scratch and the source policy",
    "about": "Learning a task from scratch and with TWiRL; zero-shot is the source it starts from.",
    "place": 10,
    "baseline": {"variant": "scratch"},
}
