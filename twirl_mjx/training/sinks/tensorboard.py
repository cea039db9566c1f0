"""TensorBoard events, on disk before ``log`` returns."""

from __future__ import annotations

import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensorboardX.proto import event_pb2, summary_pb2
from tensorboardX.record_writer import RecordWriter

from twirl_mjx.training.sinks.base import RunInfo

# protobuf makes these classes when it is imported, unseen by a type checker
events: Any = event_pb2
summaries: Any = summary_pb2

TENSORBOARD_DIR = "tensorboard"
PREFIX = "events.out.tfevents."


class TensorBoard:
    """Writes one event an epoch, without the queue and the thread of a ``SummaryWriter``."""

    def open(self, run: RunInfo) -> None:
        """Start a file; TensorBoard hides what earlier files have after the resumed checkpoint.

        A run that begins anew deletes them, as it does with the rows of ``metrics.csv``.
        """
        folder = (run.directory / TENSORBOARD_DIR).resolve()
        folder.mkdir(exist_ok=True)
        if run.resume_env_steps is None:
            for old in folder.glob(f"{PREFIX}*"):
                old.unlink()
        self._writer = RecordWriter(str(folder / next_name(folder)))
        first = 0 if run.resume_env_steps is None else run.resume_env_steps + 1
        self._write(events.Event(file_version="brain.Event:2"))
        self._write(
            events.Event(step=first, session_log=events.SessionLog(status=events.SessionLog.START))
        )
        self._writer.flush()

    def log(
        self, env_steps: int, grad_steps: int, wall_s: float, values: Mapping[str, float]
    ) -> None:
        """Append one event with every value, and force it to disk."""
        summary = summaries.Summary(
            value=[
                summaries.Summary.Value(tag=name, simple_value=value)
                for name, value in values.items()
            ]
        )
        self._write(events.Event(step=env_steps, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()

    def _write(self, event: Any) -> None:
        event.wall_time = time.time()
        self._writer.write(event.SerializeToString())


def next_name(folder: Path) -> str:
    """Return a file name that sorts after every other one, whatever the clock says.

    TensorBoard reads the files of a folder by name, and only what it has read can be superseded.
    """
    stamps = [path.name.removeprefix(PREFIX)[:10] for path in folder.glob(f"{PREFIX}*")]
    latest = max((int(stamp) for stamp in stamps if stamp.isdigit()), default=0)
    return f"{PREFIX}{max(int(time.time()), latest + 1):010d}.{socket.gethostname()}"
