"""Exit statuses of ``twirl``; a sweep reads from them how a run ended.

A ``RuntimeError`` may carry one in its attribute ``exit_status``; without it the command FAILED.
"""

FAILED = 1
UNUSABLE = 2
"""Unusable arguments or files: trying again gives the same."""
NO_SPACE = 74
"""A disk is full: no fault of what was asked for; free space, then the same command goes on."""
BUSY = 75
"""Another process works in the run directory: temporary, and no fault of the run (sysexits.h)."""
STOPPED = 130
"""Stopped by a signal after saving; the same command resumes."""
UNREAD = 141
"""Nobody reads the output any more."""
