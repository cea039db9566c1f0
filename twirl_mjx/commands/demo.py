"""``twirl demo``."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

from twirl_mjx import files
from twirl_mjx.assets import asset_path
from twirl_mjx.checks import check_range
from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.render import FILM_SECONDS, RenderOptions, config_of, film, record


@dataclasses.dataclass(frozen=True)
class DemoOptions:
    """Evaluate and film the shipped policies; downloads nothing, trains nothing."""

    episodes: int = 16
    """Episodes per policy."""
    seed: int = 3_000_017
    """Seed of the episodes."""
    out: Path = Path("runs/demo")
    """Folder of the films and replays."""
    film: bool = True
    """Also film one episode of each, and write it as a page that replays it."""
    seconds: float = 10.0
    """Longest film."""
    overwrite: bool = False
    """Replace films, strips and pages that this command did not write."""


def main(argv: list[str], set_up: Callable[[bool], None]) -> int:
    """Show every policy in ``assets/policies``.

    Args:
        argv: Options.
        set_up: Gets whether anything is drawn, before the simulation is imported.
    """
    options = parse(DemoOptions, argv, "twirl demo")
    check_range("episodes", options.episodes, 1, 100_000)
    check_range("seconds", options.seconds, *FILM_SECONDS)
    check_range("seed", options.seed, 0, 2**32 - 1)
    folder = asset_path("policies")
    set_up(options.film)
    from twirl_mjx.tasks.registry import TASKS

    shipped = [folder / f"{task}.npz" for task in TASKS.names()]
    found = [path for path in shipped if path.is_file()]
    if not found:
        raise FileNotFoundError(f"no policy in {folder}: train one with `twirl train`")
    for path in found if options.film else ():
        for ending in (".mp4", ".png", ".html"):
            files.check_ours(options.out / f"{path.stem}{ending}", overwrite=options.overwrite)
    for path in found:
        _show(path, options)
    if options.film:
        say(f"open {options.out}/*.html in a browser to turn, stop and slow what was filmed")
        say("`twirl view` lets you push the robot and move its goal")
    return 0


def _show(path: Path, options: DemoOptions) -> None:
    import jax

    from twirl_mjx.evaluation.rollout import evaluate_policy
    from twirl_mjx.policies.resolve import resolve_policy
    from twirl_mjx.tasks.measures import episode_means
    from twirl_mjx.worlds.make import make_env

    began = time.monotonic()
    then = ", then filming one and writing its replay" * options.film
    say(f"{path.stem}: evaluating {options.episodes} episodes{then}")
    config = config_of(str(path), None)
    env = make_env(config, num_envs=options.episodes)
    evaluate = evaluate_policy(env, resolve_policy(str(path), config).policy)
    values = evaluate(jax.random.key(options.seed))
    means = ", ".join(f"{name} {value:.3g}" for name, value in episode_means(values).items())
    say(f"{path.stem}: {means}")
    if options.film:
        from twirl_mjx.commands.view import write_recording

        wanted = RenderOptions(
            str(path), seed=options.seed, seconds=options.seconds, overwrite=options.overwrite
        )
        recording = record(config, wanted)
        film(config, recording, options.out / path.stem, wanted)
        page = options.out / f"{path.stem}.html"
        write_recording(page, config, recording, title=path.stem, overwrite=options.overwrite)
    say(f"{path.stem}: {time.monotonic() - began:.0f} s")
