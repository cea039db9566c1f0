"""The command line: ``twirl COMMAND [options]``. The only module that touches the environment."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any

from twirl_mjx import __version__, exits, faults, machine
from twirl_mjx.cache import LEAST_COMPILE_S, cache_folder
from twirl_mjx.checks import nearest
from twirl_mjx.commands.waiting import waiting
from twirl_mjx.sim.gl import probe_gl

COMMANDS = {
    "train": "train a task: source policy, its experience, TWiRL; resumes",
    "collect": "record a source policy in a target task as a dataset",
    "evaluate": "evaluate policies across all six dynamics conditions",
    "render": "film a policy as mp4 and a strip of frames, headless",
    "export": "write a policy as an ONNX file",
    "clip": "make, show or check a reference clip",
    "sweep": "run what is missing of an experiment grid",
    "figures": "rebuild all figures from the committed tables",
    "report": "write the results as one HTML page",
    "bench": "measure learner, worlds and start-up on this machine",
    "rehearse": "run a policy in an independent simulator with latency and noise",
    "view": "watch a policy in a browser and touch it, or write a replay page",
    "demo": "render and evaluate the shipped policies; trains nothing",
    "runs": "list, show, compare and prune runs",
    "curriculum": "train the chain of tasks one after another",
}
"""Command name to its one-line description; each lives in ``twirl_mjx.commands.<name>``."""
DRAWING = ("render", "demo", "clip", "rehearse")
"""Commands that may draw the robot; they say so to :func:`set_up` once they know."""


def _usage() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {about}" for name, about in COMMANDS.items())
    return (
        "usage: twirl COMMAND [options]\n\ncommands:\n"
        f"{rows}\n\n`twirl COMMAND --help` lists the options of a command, `twirl --version` says"
        " which this is.\n"
    )


def _set_environment(joins_cluster: bool = False) -> None:
    """Choose the compilation cache, and who may reach Ray, before anything heavy is imported.

    By environment variables, which child processes inherit. Settings of jax and Ray themselves win.
    """
    if (folder := cache_folder(os.environ)) is not None:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(LEAST_COMPILE_S))
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    # else tyro's type checker looks through all installed packages, 0.05 s
    os.environ.setdefault("TYPEGUARD_DISABLE_PLUGIN_AUTOLOAD", "1")
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where HOME cannot be written
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report to its makers
    if not joins_cluster:  # Ray's processes then listen to this machine alone, on Linux too
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")


def set_up(draws: bool) -> None:
    """Choose the GL backend, which MuJoCo reads when it is imported.

    Args:
        draws: Whether anything will be drawn; if not, no backend is looked for.

    Raises:
        RenderError: Something will be drawn and no backend works.
    """
    if "MUJOCO_GL" not in os.environ:
        with waiting("looking for a way to draw without a display"):
            os.environ["MUJOCO_GL"] = probe_gl(os.environ) if draws else "disable"


def _import_command(name: str) -> Any:
    with waiting("starting"):
        return importlib.import_module(f"twirl_mjx.commands.{name}")


def _show_one_line_each(name: str) -> Callable[[], None]:
    """Show what fails in threads and finalizers as one line, too, without tracebacks in logs.

    Of finalizers only system errors are shown: what they could not write is lost.

    Returns:
        What undoes it.
    """

    def in_thread(args: threading.ExceptHookArgs) -> None:
        if args.exc_value is not None and not isinstance(args.exc_value, SystemExit):
            _complain(name, f"in the background: {faults.explain(args.exc_value).text}")

    def in_finalizer(args: Any) -> None:
        if isinstance(args.exc_value, OSError):
            _complain(name, f"while closing: {faults.explain(args.exc_value).text}")

    def is_new(record: logging.LogRecord) -> bool:  # what is logged with a traceback is raised, too
        return not record.exc_info

    loggers = [logging.getLogger(n) for n in ("absl", "jax._src.callback")]
    old = threading.excepthook, sys.unraisablehook
    threading.excepthook, sys.unraisablehook = in_thread, in_finalizer
    for logger in loggers:
        logger.addFilter(is_new)

    def undo() -> None:
        threading.excepthook, sys.unraisablehook = old
        for logger in loggers:
            logger.removeFilter(is_new)

    return undo


def _complain(name: str, text: str) -> None:
    print(f"twirl {name}: {text}", file=sys.stderr)


def main(argv: list[str] | None = None) -> int:
    """Run one command; an error is one line on stderr, with ``TWIRL_DEBUG=1`` its traceback too.

    Returns:
        Exit status: 0 done, else one of ``exits``.
    """
    if not machine.is_supported():
        print(f"twirl: {machine.UNSUPPORTED}", file=sys.stderr)
        return exits.UNUSABLE
    owns_process = argv is None
    argv = list(sys.argv[1:] if argv is None else argv)
    if not argv or argv[0] in ("-h", "--help"):
        print(_usage(), end="")
        return 0 if argv else exits.UNUSABLE
    name, *rest = argv
    if name == "--version":
        print(f"twirl {__version__}")
        return 0
    if name not in COMMANDS:
        close = nearest(name, COMMANDS)
        print(f"twirl: unknown command {name!r} (nearest: {close!r})\n", file=sys.stderr)
        print(_usage(), end="", file=sys.stderr)
        return exits.UNUSABLE
    debug = os.environ.get("TWIRL_DEBUG", "") not in ("", "0")
    undo = (lambda: None) if debug else _show_one_line_each(name)
    try:
        _set_environment(any(word.partition("=")[0] == "--address" for word in rest))
        if name in DRAWING:  # these parse their options before they import the simulation
            return _import_command(name).main(rest, set_up)
        os.environ.setdefault("MUJOCO_GL", "disable")
        return _import_command(name).main(rest)
    except BrokenPipeError:  # the reader of our output, `| head` say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return exits.UNREAD
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exception(error)
        fault = faults.explain(error)
        _complain(name, fault.text)
        return fault.status
    finally:
        if not owns_process:  # else it holds while the interpreter ends
            undo()


if __name__ == "__main__":
    sys.exit(main())
