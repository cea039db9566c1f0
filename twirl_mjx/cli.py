"""The command line: ``twirl COMMAND [options]``. The only module that touches the environment."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import io
import os
import sys
from pathlib import Path

from twirl_mjx.deploy.gl import probe_gl

COMMANDS = {
    "train": "train a task: source policy, its experience, TWiRL; resumes",
    "collect": "record a source policy in a target task as a dataset",
    "evaluate": "evaluate policies across all six dynamics conditions",
    "render": "film a policy as mp4 and a strip of frames, headless",
    "export": "write a policy as an ONNX file",
    "clip": "make, show or check a leap clip",
    "sweep": "run what is missing of an experiment grid",
    "figures": "rebuild all figures from the committed tables",
    "report": "write the results as one HTML page",
    "bench": "measure learner, worlds and start-up on this machine",
    "rehearse": "run a policy in an independent simulator with latency and noise",
    "demo": "render and evaluate the shipped policies; trains nothing",
    "curriculum": "train the chain of tasks one after another",
}
"""Command name to its one-line description; each lives in ``twirl_mjx.commands.<name>``."""
DRAWING = ("render", "demo", "clip")
"""Commands that draw the robot."""


def _usage() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {about}" for name, about in COMMANDS.items())
    return (
        "usage: twirl COMMAND [options]\n\ncommands:\n"
        f"{rows}\n\n`twirl COMMAND --help` lists the options of a command.\n"
    )


def _set_environment(command: str) -> None:
    """Choose the compilation cache and the GL backend before anything heavy is imported.

    ``TWIRL_CACHE_DIR`` places jax's persistent compilation cache (``~/.cache/twirl_mjx/jax`` by
    default); ``TWIRL_CACHE_DIR=off`` switches it off. Settings of jax itself win.
    """
    cache = os.environ.get("TWIRL_CACHE_DIR", str(Path.home() / ".cache" / "twirl_mjx" / "jax"))
    if cache != "off":
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", cache)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    if "MUJOCO_GL" not in os.environ:
        os.environ["MUJOCO_GL"] = probe_gl(os.environ) if command in DRAWING else "disable"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report to its makers


def _import_command(name: str) -> object:
    """Import a command; what libraries print while they are imported is kept off stdout."""
    with contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module(f"twirl_mjx.commands.{name}")


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Returns:
        Exit status: 0 done; 1 it failed; 2 unusable arguments; 130 stopped by a signal after
        saving; 141 nobody reads the output.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    if not argv or argv[0] in ("-h", "--help"):
        print(_usage(), end="")
        return 0 if argv else 2
    name, *rest = argv
    if name not in COMMANDS:
        nearest = difflib.get_close_matches(name, COMMANDS, 1, 0.0)[0]
        print(f"twirl: unknown command {name!r} (nearest: {nearest!r})\n", file=sys.stderr)
        print(_usage(), end="", file=sys.stderr)
        return 2
    try:
        _set_environment(name)
        command = _import_command(name)
        return command.main(rest)  # type: ignore[attr-defined]
    except (ValueError, FileNotFoundError) as error:
        print(f"twirl {name}: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(f"twirl {name}: {error}", file=sys.stderr)
        return 130 if type(error).__name__ == "StoppedError" else 1
    except BrokenPipeError:  # the reader of our output, `| head` say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        print(f"twirl {name}: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
