"""Become another program, on one core, that dies with the process which started it.

Run as a script, before anything else is imported: ``launch.py PARENT CORE PROGRAM [ARGUMENT ...]``.
Doing this here and not between fork and exec of the parent keeps a parent with threads safe.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1
"""Linux ``prctl``: the signal a process gets when its parent ends (kept across exec)."""


def main(argv: list[str]) -> None:
    """Fate-share with the parent, pin to a core (``-`` for none) and exec the program.

    Args:
        argv: Process id of the parent, core, program and its arguments.
    """
    parent, core, *program = argv
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(parent):
        sys.exit("the process that started this run has ended")
    if core != "-":
        os.sched_setaffinity(0, {int(core)})
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    os.execv(program[0], program)


if __name__ == "__main__":
    main(sys.argv[1:])
