"""What an error means to a person: one line, and the right exit status."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from twirl_mjx import cli, exits, faults
from twirl_mjx.policies.function import HostPolicy
from twirl_mjx.training.pipeline import StoppedError
from twirl_mjx.training.rundir import RunBusyError


def system_error(number: int) -> OSError:
    return OSError(number, os.strerror(number), "/some/file")


@pytest.mark.parametrize(
    ("number", "status"),
    [
        (errno.ENOSPC, exits.NO_SPACE),
        (errno.EDQUOT, exits.NO_SPACE),
        (errno.EROFS, exits.UNUSABLE),
        (errno.ELOOP, exits.UNUSABLE),
        (errno.ENAMETOOLONG, exits.UNUSABLE),
        (errno.EEXIST, exits.UNUSABLE),
        (errno.ENOENT, exits.UNUSABLE),
        (errno.EACCES, exits.UNUSABLE),
        (errno.EISDIR, exits.UNUSABLE),
        (errno.EIO, exits.FAILED),
        (errno.EMFILE, exits.FAILED),
    ],
)
def test_system_errors_name_the_file(number: int, status: int) -> None:
    text, found = faults.explain(system_error(number))
    assert found == status
    assert text.startswith(f"/some/file: {os.strerror(number)}")
    assert "\n" not in text


@pytest.mark.parametrize(
    ("error", "text", "status"),
    [
        (ValueError("wrong (nearest: 1)"), "wrong (nearest: 1)", exits.UNUSABLE),
        (FileNotFoundError("no run at x"), "no run at x", exits.UNUSABLE),
        (RuntimeError("the encoder failed"), "the encoder failed", exits.FAILED),
        (RunBusyError("in use"), "in use", exits.BUSY),
        (StoppedError("stopped"), "stopped", exits.STOPPED),
        (KeyboardInterrupt(), "interrupted", exits.STOPPED),
        (MemoryError("Unable to allocate 4 TiB"), "not enough memory: Unable", exits.FAILED),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating"), "not enough", exits.FAILED),
        (
            RuntimeError("video: a.mp4: No space left on device\nConversion failed"),
            "video: a.mp4: No space left on device: free space",
            exits.NO_SPACE,
        ),
        (KeyError("x"), "a fault of this program: KeyError: 'x' (no place; TWIRL_DEBUG=1", 1),
        (NotImplementedError("n\nm"), "a fault of this program: NotImplementedError: n (", 1),
        (StopIteration(), "a fault of this program: StopIteration: no message", 1),
    ],
)
def test_each_kind_of_error(error: BaseException, text: str, status: int) -> None:
    fault = faults.explain(error)
    assert fault.text.startswith(text)
    assert fault.status == status


def test_a_full_disk_is_found_behind_other_errors() -> None:
    try:
        try:
            raise system_error(errno.ENOSPC)
        except OSError as error:
            raise ValueError("the checkpoint failed") from error
    except ValueError as error:
        fault = faults.explain(error)
    assert fault.status == exits.NO_SPACE
    assert fault.text.startswith("/some/file: No space left on device: free space")


@pytest.mark.timeout(20)
def test_errors_that_cause_one_another_are_explained() -> None:
    """A clip's refusal was its own cause, and the command that read it never ended."""
    first, second = ValueError("first"), ValueError("second")
    first.__cause__, second.__cause__ = second, first
    assert faults.explain(first) == ("first", exits.UNUSABLE)


def test_a_full_disk_of_others_is_short_and_says_what_is_saved() -> None:
    error = ValueError(
        'RESOURCE_EXHAUSTED: Error writing "env.data/0.0" in database at "/runs/a/": Failed'
        ' writing: "/runs/a/d/0c99": Failed to write 3823 bytes: No space left on device [code 28]'
    )
    error.add_note("For simplicity, some frames were removed")
    error.add_note("saved: the checkpoint at 32 transitions")
    assert faults.explain(error) == (
        "/runs/a/d/0c99: No space left on device: free space, then run the same command again;"
        " saved: the checkpoint at 32 transitions",
        exits.NO_SPACE,
    )


def refusing(text: str) -> Any:
    def act(obs: Any) -> Any:
        raise ValueError(text)

    return act


def interrupted(obs: Any) -> Any:
    raise KeyboardInterrupt


def failing(obs: Any) -> Any:
    return {}["action"]


@pytest.mark.parametrize(
    ("function", "text", "status"),
    [
        (refusing("the graph: NaN"), "the graph: NaN", exits.UNUSABLE),
        (refusing("two\nlines"), "two\nlines", exits.UNUSABLE),
        (interrupted, "interrupted", exits.STOPPED),
        (failing, "KeyError: 'action'", exits.FAILED),
    ],
)
def test_errors_raised_in_host_code_that_jax_has_called(
    function: Any, text: str, status: int
) -> None:
    policy = HostPolicy(function)
    with pytest.raises(Exception, match="Traceback") as error:
        jax.jit(policy.on_observation)(jnp.zeros((2, 3)), jax.random.key(0)).block_until_ready()
    assert faults.explain(error.value) == (text, status)


# ---- the command line


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let ``twirl bench`` be a function."""

    def use(function: Any) -> None:
        monkeypatch.setattr(cli, "_import_command", lambda name: SimpleNamespace(main=function))

    monkeypatch.setenv("MUJOCO_GL", "disable")
    monkeypatch.delenv("TWIRL_DEBUG", raising=False)
    return use


def test_an_unexpected_error_is_one_line(
    command: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command(lambda argv: {}["x"])
    assert cli.main(["bench"]) == exits.FAILED
    err = capsys.readouterr().err
    assert err.startswith("twirl bench: a fault of this program: KeyError: 'x' (test_explain.py:")
    assert err.count("\n") == 1
    monkeypatch.setenv("TWIRL_DEBUG", "1")
    assert cli.main(["bench"]) == exits.FAILED
    err = capsys.readouterr().err
    assert "Traceback (most recent call last)" in err
    assert err.splitlines()[-1].startswith("twirl bench: a fault of this program")


def test_errors_of_threads_and_host_code_print_no_traceback(
    command: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    def fail_in_thread() -> None:
        raise system_error(errno.ENOSPC)

    def run(argv: list[str]) -> int:
        thread = threading.Thread(target=fail_in_thread)
        thread.start()
        thread.join()
        act = HostPolicy(refusing("the graph: NaN")).on_observation
        jax.jit(act)(jnp.zeros((2, 3)), jax.random.key(0)).block_until_ready()
        return 0

    before = threading.excepthook
    command(run)
    assert cli.main(["bench"]) == exits.UNUSABLE
    assert threading.excepthook is before
    assert capfd.readouterr().err.splitlines() == [
        "twirl bench: in the background: /some/file: No space left on device: free space, then run"
        " the same command again",
        "twirl bench: the graph: NaN",
    ]


def test_only_one_place_maps_errors() -> None:
    package = Path(cli.__file__).parent
    users = [p.name for p in package.rglob("*.py") if "print_exception" in p.read_text()]
    assert users == ["cli.py"]
