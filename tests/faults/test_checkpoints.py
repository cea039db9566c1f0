"""Damaged checkpoints and power cuts: noticed, named, stepped over; nothing that counts is half."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.training import manifests, state
from twirl_mjx.training.checkpoint import Checkpoints, has_checkpoint, load_replay
from twirl_mjx.training.manifests import DamagedError
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.state import TrainState
from twirl_mjx.worlds.make import make_env

CAPACITY = 80
PER_SAVE = 32


@pytest.fixture(scope="module")
def fresh() -> TrainState:
    """The state of a small run before its first transition."""
    config = make_config("stand", "debug")
    config = dataclasses.replace(
        config, replay=dataclasses.replace(config.replay, capacity=CAPACITY)
    )
    env = make_env(config)
    return jax.jit(lambda key: state.init(config, env, key, None))(jax.random.key(0))


def after(fresh: TrainState, steps: int) -> TrainState:
    """Return a state whose every number tells how many transitions it has seen."""
    rng = np.random.default_rng(steps)
    rows = np.zeros(fresh.replay.online.rows.shape, np.float32)
    numbers = np.arange(max(0, steps - CAPACITY), steps)
    rows[numbers % CAPACITY] = numbers[:, None]
    actor = jax.tree.map(
        lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), fresh.learner.actor
    )
    online = fresh.replay.online.replace(
        rows=jnp.asarray(rows), size=jnp.int32(min(steps, CAPACITY))
    )
    return fresh.replace(
        learner=fresh.learner.replace(actor=actor),
        replay=fresh.replay.replace(online=online),
        env_steps=jnp.int32(steps),
        inserted=jnp.int32(steps),
    )


def save(run_dir: Path, fresh: TrainState, *steps: int) -> None:
    checkpoints = Checkpoints(run_dir)
    for step in steps:
        checkpoints.save(after(fresh, step), {"inserted": step, "best": 0.5})
    checkpoints.close()


def restore(run_dir: Path, fresh: TrainState) -> tuple[int, str | None]:
    """Restore, check that what comes is whole; return its step and what was said."""
    checkpoints = Checkpoints(run_dir)
    try:
        found, progress = checkpoints.restore(jax.eval_shape(lambda: fresh))
    finally:
        checkpoints.close()
    step = int(found.env_steps)
    assert progress == {"inserted": step, "best": 0.5}
    for have, want in zip(jax.tree.leaves(found), jax.tree.leaves(after(fresh, step)), strict=True):
        if jnp.issubdtype(have.dtype, jax.dtypes.prng_key):
            have, want = jax.random.key_data(have), jax.random.key_data(want)
        np.testing.assert_array_equal(np.asarray(have), np.asarray(want))
    return step, checkpoints.stepped_over


@pytest.fixture(scope="module")
def saved(fresh: TrainState, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with the checkpoints at 128 and 160 of five."""
    run_dir = tmp_path_factory.mktemp("saved") / "run"
    save(run_dir, fresh, *(PER_SAVE * n for n in range(1, 6)))
    return run_dir


def files_of(run_dir: Path, step: int) -> set[str]:
    """Return the files that a checkpoint needs, its manifest included."""
    manifest = json.loads((run_dir / "checkpoints" / "manifests" / f"{step}.json").read_text())
    return {f"manifests/{step}.json", *manifest["files"]}


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGES: dict[str, Callable[[Path], None]] = {"flip": flip, "cut": cut, "gone": Path.unlink}


def test_two_checkpoints_and_their_rows_are_kept(saved: Path, fresh: TrainState) -> None:
    assert manifests.visible(saved / "checkpoints") == [128, 160]
    rows = {name for name in files_of(saved, 128) if name.startswith("replay/")}
    assert rows == {f"replay/rows_{n:012d}_{n + 32:012d}.npy" for n in (32, 64, 96)}
    assert restore(saved, fresh) == (160, None)
    np.testing.assert_array_equal(load_replay(saved, CAPACITY)[:, 0], np.arange(80, 160))


def test_going_back_to_a_damaged_checkpoint_deletes_nothing(
    saved: Path, fresh: TrainState, tmp_path: Path
) -> None:
    """The newest that all seeds of a batch have is damaged in one: its own newer one is kept."""
    run_dir = tmp_path / "run"
    shutil.copytree(saved, run_dir)
    root = run_dir / "checkpoints"
    state_file = next(name for name in sorted(files_of(saved, 128)) if "/train_state/d/" in name)
    flip(root / state_file)
    checkpoints = Checkpoints(run_dir)
    with pytest.raises(DamagedError, match=r"128 transitions.*nothing was deleted.*alone.*160"):
        checkpoints.back_to(128)
    checkpoints.close()
    assert restore(run_dir, fresh) == (160, None)
    (root / state_file).write_bytes((saved / "checkpoints" / state_file).read_bytes())
    checkpoints = Checkpoints(run_dir)
    checkpoints.back_to(128)
    checkpoints.close()
    assert restore(run_dir, fresh) == (128, None)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_stepped_over(
    damage: str, saved: Path, fresh: TrainState, tmp_path: Path
) -> None:
    """Every file that only the newest needs is noticed; the run goes on and writes it again."""
    run_dir = tmp_path / "run"
    shutil.copytree(saved, run_dir)
    root = run_dir / "checkpoints"
    only = sorted(files_of(saved, 160) - files_of(saved, 128))
    assert {name.split("/")[0] for name in only} == {"manifests", "orbax", "replay"}
    for name in only:
        whole = (root / name).read_bytes()
        DAMAGES[damage](root / name)
        if (root / "manifests" / "160.json").exists():
            with pytest.raises(DamagedError, match=str(root / name)):
                manifests.check(root, 160)
        else:
            assert manifests.visible(root) == [128]
        (root / name).write_bytes(whole)
    state_file = next(name for name in only if "/train_state/d/" in name)
    for number, name in enumerate((only[0], state_file, only[-1])):
        run_dir = tmp_path / str(number)  # a save chooses names of its own for the state's files
        shutil.copytree(saved, run_dir)
        root = run_dir / "checkpoints"
        DAMAGES[damage](root / name)
        is_cut_short = name.startswith("manifests") and damage == "gone"
        if not is_cut_short:
            with pytest.raises(DamagedError, match=str(root / name)):
                load_replay(run_dir, CAPACITY)
        step, said = restore(run_dir, fresh)
        assert step == 128
        if not is_cut_short:
            assert str(said).startswith(str(root / name))
            assert "; going on from the checkpoint before it, at 128 transitions" in str(said)
        assert manifests.visible(root) == manifests.stored(root) == [128]
        save(run_dir, fresh, 160)
        assert restore(run_dir, fresh) == (160, None)


def test_when_none_is_whole_nothing_is_deleted(
    saved: Path, fresh: TrainState, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(saved, run_dir)
    path = run_dir / "checkpoints" / "replay" / "rows_000000000096_000000000128.npy"
    flip(path)
    before = sorted(run_dir.rglob("*"))
    with pytest.raises(DamagedError, match=rf"{path} is damaged.*no checkpoint .* is whole"):
        restore(run_dir, fresh)
    assert sorted(run_dir.rglob("*")) == before


def remove_rows(run_dir: Path) -> None:
    shutil.rmtree(run_dir / "checkpoints" / "replay")


def remove_a_file_of_rows(run_dir: Path) -> None:
    (run_dir / "checkpoints" / "replay" / "rows_000000000064_000000000096.npy").unlink()


@pytest.mark.parametrize("remove", [remove_rows, remove_a_file_of_rows])
def test_a_replay_that_is_not_whole_is_gathered_anew_when_asked(
    remove: Callable[[Path], None], saved: Path, fresh: TrainState, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(saved, run_dir)
    remove(run_dir)
    before = sorted(run_dir.rglob("*.json"))
    with pytest.raises(DamagedError, match=r"is missing.*Only its replay.*--refill"):
        restore(run_dir, fresh)
    assert sorted(run_dir.rglob("*.json")) == before
    asked = []

    def refill(state: TrainState) -> jax.Array:
        asked.append((int(state.env_steps), state.replay.online.rows.size))
        return after(fresh, 160).replay.online.rows

    checkpoints = Checkpoints(run_dir)
    found, _ = checkpoints.restore(jax.eval_shape(lambda: fresh), refill)
    checkpoints.close()
    assert asked == [(160, 0)] and checkpoints.refilled and not checkpoints.stepped_over
    np.testing.assert_array_equal(found.replay.online.rows, after(fresh, 160).replay.online.rows)
    assert restore(run_dir, fresh) == (160, None)  # stored at once: nothing is gathered twice
    save(run_dir, fresh, 192)
    flip(next((run_dir / "checkpoints" / "orbax" / "192" / "train_state" / "d").iterdir()))
    assert restore(run_dir, fresh)[0] == 160  # and a later one that is damaged is stepped over


def test_refill_goes_on_from_the_checkpoint_before_a_damaged_state(
    saved: Path, fresh: TrainState, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(saved, run_dir)
    remove_rows(run_dir)
    flip(next((run_dir / "checkpoints" / "orbax" / "160" / "train_state" / "d").iterdir()))
    checkpoints = Checkpoints(run_dir)
    found, _ = checkpoints.restore(
        jax.eval_shape(lambda: fresh), lambda _: after(fresh, 128).replay.online.rows
    )
    checkpoints.close()
    assert int(found.env_steps) == 128 and checkpoints.refilled
    assert "160" in str(checkpoints.stepped_over)
    assert restore(run_dir, fresh) == (128, None)


def test_refill_does_not_hide_a_damaged_state(
    saved: Path, fresh: TrainState, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(saved, run_dir)
    remove_rows(run_dir)
    for step in (128, 160):
        flip(next((run_dir / "checkpoints" / "orbax" / str(step) / "train_state" / "d").iterdir()))
    for refill in (None, lambda _: pytest.fail("asked")):
        checkpoints = Checkpoints(run_dir)
        with pytest.raises(DamagedError, match=r"160.*is damaged.*Give another --name"):
            checkpoints.restore(jax.eval_shape(lambda: fresh), refill)
        checkpoints.close()


def test_refill_is_not_asked_for_rows_that_are_there(saved: Path, fresh: TrainState) -> None:
    checkpoints = Checkpoints(saved)
    found, _ = checkpoints.restore(jax.eval_shape(lambda: fresh), lambda _: pytest.fail("asked"))
    checkpoints.close()
    assert int(found.env_steps) == 160 and not checkpoints.refilled


def test_a_row_between_checkpoints_that_none_needs_is_no_damage(
    saved: Path, fresh: TrainState, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(saved, run_dir)
    flip(run_dir / "checkpoints" / "replay" / "rows_000000000032_000000000064.npy")
    assert restore(run_dir, fresh) == (160, None)


def test_checkpoints_of_older_versions_are_read_and_then_replaced(
    saved: Path, fresh: TrainState, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(saved, run_dir)
    shutil.rmtree(run_dir / "checkpoints" / "manifests")
    assert has_checkpoint(run_dir)
    assert len(load_replay(run_dir, CAPACITY)) == CAPACITY
    assert restore(run_dir, fresh) == (160, None)
    assert manifests.visible(run_dir / "checkpoints") == [128, 160]
    save(run_dir, fresh, 192)
    assert manifests.visible(run_dir / "checkpoints") == [160, 192]
    flip(run_dir / "checkpoints" / "manifests" / "192.json")
    step, said = restore(run_dir, fresh)
    assert step == 160
    assert "192.json is damaged" in str(said)
    save(run_dir, fresh, 192, 224)
    assert manifests.visible(run_dir / "checkpoints") == [192, 224]
    assert json.loads((run_dir / "checkpoints" / "unsealed.json").read_text()) == []


def test_a_power_cut_at_any_moment_leaves_whole_checkpoints(
    disk: Any, fresh: TrainState, tmp_path: Path
) -> None:
    """Four saves, the power cut after each ``fsync`` of them and before the next."""
    cuts: list[Path] = []

    def note() -> None:
        cuts.append(tmp_path / f"cut{len(cuts):04d}")
        disk.after_the_cut(cuts[-1])

    disk.at_sync = note
    save(disk.root, fresh, 32, 64, 96, 128)
    disk.at_sync = lambda: None
    reached: dict[int, int] = {}
    whole: dict[tuple[Any, ...], int] = {}
    for folder in cuts:
        visible = tuple(manifests.visible(folder / "checkpoints"))
        for step in visible:
            manifests.check(folder / "checkpoints", step)
        if not visible:
            assert not reached, "a checkpoint that counted is gone"
            continue
        assert visible[-1] >= max(reached, default=0)
        if visible not in whole:
            step, said = restore(folder, fresh)
            assert (step, said) == (visible[-1], None)
            whole[visible] = step
        reached[visible[-1]] = reached.get(visible[-1], 0) + 1
    assert set(reached) == {32, 64, 96, 128}
    assert len(cuts) > 4 * 10


def test_the_simulated_disk_drops_what_was_not_forced(disk: Any, tmp_path: Path) -> None:
    """The test above would notice: a file without ``fsync`` is empty, a name may be missing."""
    for name in ("kept", "empty"):
        (disk.root / name).write_text("x")
    for path in (disk.root / "kept", disk.root):
        descriptor = os.open(path, os.O_RDONLY)
        os.fsync(descriptor)
        os.close(descriptor)
    (disk.root / "nameless").write_text("x")
    disk.after_the_cut(tmp_path / "cut")
    assert {p.name: p.read_text() for p in (tmp_path / "cut").iterdir()} == {
        "kept": "x", "empty": "",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda metrics: metrics | {"new": metrics["cosine"]}, "new is not in the checkpoint"),
        (lambda metrics: {"cosine": metrics["cosine"]}, "is only in the checkpoint"),
    ],
    ids=["more", "less"],
)
def test_a_state_of_another_version_is_named(
    change: Callable[..., Any], told: str, saved: Path, fresh: TrainState
) -> None:
    other = fresh.replace(env=fresh.env.replace(metrics=change(dict(fresh.env.metrics))))
    checkpoints = Checkpoints(saved)
    try:
        with pytest.raises(ValueError, match=f"another version .*{told}"):
            checkpoints.restore(jax.eval_shape(lambda: other))
    finally:
        checkpoints.close()
