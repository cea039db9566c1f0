"""Identity, needed runs and status of cells."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from twirl_mjx.commands.sweep import main
from twirl_mjx.commands.sweep_run import wanted
from twirl_mjx.sweep import plan
from twirl_mjx.sweep.grid import Draft, load
from twirl_mjx.sweep.plan import Cell, make_plan, status_of
from twirl_mjx.training import rundir, source_rules
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import RunDir

Finish = Callable[..., Path]


def adaptation(**changes: object) -> Draft:
    settings = {"shift": "icy", "variant": "weights", "seed": 3, **changes}
    config = dataclasses.replace(make_config("biped", "debug"), **settings)
    return Draft("biped-icy", "debug", config, (("total_env_steps", 64),))


def resolve(draft: Draft, runs: Path, nominal: list[Path] | None = None) -> dict[str, Cell]:
    cells: dict[str, Cell] = {}
    plan.resolve(draft, runs, plan.given_nominals(nominal or []), cells)
    return cells


def test_needed_runs_come_first(tmp_path: Path) -> None:
    stand, nominal, cell = resolve(adaptation(), tmp_path).values()
    assert (stand.config.task, stand.config.seed, stand.arm) == ("stand", 3, "")
    assert (nominal.config.task, nominal.config.shift, nominal.config.seed) == ("biped", "none", 3)
    assert (nominal.config.variant, nominal.config.total_env_steps) == ("twirl", 64)
    assert (nominal.needs, cell.needs) == ((stand.name,), (nominal.name,))
    assert cell.source == str(tmp_path / nominal.name)


def test_cells_share_the_runs_they_need(grid_file: Path, tmp_path: Path) -> None:
    cells = make_plan(load(str(grid_file)), tmp_path)
    first = [(c.config.task, c.config.seed) for c in cells if not c.arm]
    assert first == [("stand", 0), ("stand", 1)]
    assert len(cells) == 5 + 2


def test_arms_with_equal_settings_are_refused(grid_file: Path, tmp_path: Path) -> None:
    text = grid_file.read_text()
    grid_file.write_text(
        text.replace("for p in (0.25, 0.5)}", 'for p in (0.25, 0.5)} | {"own": {}}')
    )
    with pytest.raises(ValueError, match=r"'biped-phi0\.5' and 'biped-own' have equal settings"):
        make_plan(load(str(grid_file)), tmp_path)
    with pytest.raises(ValueError, match="'biped-own'"):  # also when only another arm is wanted
        main([str(grid_file), "--runs", str(tmp_path), "--arms", "biped-zs", "--dry-run"])


def test_a_cell_may_be_the_run_that_another_needs(grid_file: Path, tmp_path: Path) -> None:
    axes = '{"shift": {s: {"shift": s} for s in ("none", "icy")}, "task": TASK}'
    grid_file.write_text(
        'TASK = {"b": {"task": "biped"}}\n'
        f'GRID = ({{"preset": "debug", "seeds": (0,), "axes": {axes}}},)'
    )
    stand, nominal, icy = make_plan(load(str(grid_file)), tmp_path)
    assert (stand.arm, nominal.arm, icy.arm) == ("", "none-b", "icy-b")
    assert icy.needs == (nominal.name,)


def test_a_shipped_policy_is_known_by_its_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "stand.npz"
    monkeypatch.setattr(source_rules, "asset_path", lambda *_: file)
    draft = Draft("arm", "cpu", make_config("biped", "cpu"), ())
    identities = set()
    for content in (b"a policy", b"another"):
        file.write_bytes(content)
        (cell,) = resolve(draft, tmp_path).values()
        assert (cell.source, cell.needs) == ("auto", ())
        identities.add(cell.config.source)
    assert len(identities) == 2


def test_scratch_and_scripted_need_nothing(tmp_path: Path) -> None:
    assert len(resolve(adaptation(shift="none", variant="scratch"), tmp_path)) == 1
    (cell,) = resolve(adaptation(source="trot", variant="twirl"), tmp_path).values()
    assert (cell.needs, cell.source, cell.config.source) == ((), "trot", "trot")


def test_a_source_may_have_a_scripted_source_itself(tmp_path: Path) -> None:
    draft = Draft("", "cpu", make_config("hurdles", "cpu"), ())
    imitate, hurdles = resolve(draft, tmp_path).values()
    assert (imitate.config.task, imitate.config.source, imitate.needs) == ("imitate", "clip", ())
    assert hurdles.needs == (imitate.name,)


def test_identity_is_the_resolved_config(tmp_path: Path) -> None:
    def name(draft: Draft) -> str:
        return list(resolve(draft, tmp_path))[-1]

    base = name(adaptation())
    assert name(adaptation()) == base
    assert base.startswith("biped-icy-weights-s3-")
    assert name(dataclasses.replace(adaptation(), arm="renamed")) == base
    changed = dataclasses.replace(adaptation().config.droq, learning_rate=1e-3)
    assert name(adaptation(droq=changed)) != base
    # another nominal run is another source
    assert name(dataclasses.replace(adaptation(), nominal=(("total_env_steps", 96),))) != base


def test_identity_does_not_depend_on_where_runs_lie(tmp_path: Path) -> None:
    names = [list(resolve(adaptation(), tmp_path / folder)) for folder in ("a", "b")]
    assert names[0] == names[1]


def test_a_changed_policy_file_is_another_cell(tmp_path: Path) -> None:
    path = tmp_path / "own.npz"
    path.write_bytes(b"one")
    first = list(resolve(adaptation(source=str(path)), tmp_path))
    path.write_bytes(b"two")
    assert list(resolve(adaptation(source=str(path)), tmp_path)) != first


def test_status(tmp_path: Path, finish_run: Finish) -> None:
    stand, nominal, cell = resolve(adaptation(), tmp_path).values()
    assert status_of(cell, tmp_path) == "missing"
    run_dir = finish_run(cell, tmp_path, steps=cell.config.total_env_steps - 1)
    assert status_of(cell, tmp_path) == "cut off"  # closed at a smaller budget
    with RunDir(run_dir).exclusive():
        assert status_of(cell, tmp_path) == "in use"
    finish_run(cell, tmp_path)
    with RunDir(run_dir).exclusive():
        assert status_of(cell, tmp_path) == "in use"  # its last files are being written
    assert status_of(cell, tmp_path) == "finished"
    assert status_of(nominal, tmp_path) == "missing"
    assert status_of(stand, tmp_path) == "missing"


def test_a_run_changed_by_hand_is_refused(tmp_path: Path, finish_run: Finish) -> None:
    cell = list(resolve(adaptation(), tmp_path).values())[-1]
    run_dir = finish_run(cell, tmp_path)
    text = (run_dir / "config.json").read_text()
    (run_dir / "config.json").write_text(text.replace('"tau": 0.005', '"tau": 0.5'))
    with pytest.raises(ValueError, match=r"droq.tau: 0.5 -> 0.005"):
        status_of(cell, tmp_path)


def test_only_missing_runs_and_their_needs_are_wanted(tmp_path: Path, finish_run: Finish) -> None:
    cells = tuple(resolve(adaptation(), tmp_path).values())
    stand, nominal, cell = cells

    def names() -> list[str]:
        return [c.name for c in wanted(cells, {c.name: status_of(c, tmp_path) for c in cells})]

    assert names() == [stand.name, nominal.name, cell.name]
    finish_run(nominal, tmp_path)  # its own source is not needed any more
    assert names() == [cell.name]
    finish_run(cell, tmp_path)
    assert names() == []


def test_a_finished_run_of_twirl_train_is_adopted(tmp_path: Path, finish_run: Finish) -> None:
    draft = dataclasses.replace(adaptation(), nominal=())
    own = list(resolve(draft, tmp_path).values())
    plain = dataclasses.replace(own[1], name="biped-twirl-debug-s3", source="auto")
    finish_run(plain, tmp_path)
    adopted = list(resolve(draft, tmp_path).values())
    assert adopted[1].name == "biped-twirl-debug-s3"
    assert adopted[2].name == own[2].name  # the identity of what builds on it is the same
    assert adopted[2].needs == ("biped-twirl-debug-s3",)
    assert status_of(adopted[1], tmp_path) == "finished"


def test_a_nominal_run_can_be_given(tmp_path: Path, finish_run: Finish) -> None:
    _, nominal, cell = resolve(adaptation(), tmp_path).values()
    run_dir = finish_run(nominal, tmp_path)
    (given,) = resolve(adaptation(), tmp_path, [run_dir]).values()
    assert (given.needs, given.source) == ((), str(run_dir))
    assert given.name != cell.name
    with pytest.raises(ValueError, match="both nominal runs of biped"):
        plan.given_nominals([run_dir, run_dir])
    with pytest.raises(ValueError, match="not a finished run without a shift"):
        plan.given_nominals([finish_run(cell, tmp_path)])


def test_reached_steps_reads_the_last_whole_row(tmp_path: Path) -> None:
    assert plan.reached_steps(tmp_path) == 0
    row = "r,biped,none,twirl,0,return,{},10,1.0,2.0"
    text = "\n".join(["run,task,...", row.format(320), row.format(640), row.format(960)])
    (tmp_path / "metrics.csv").write_text(text)  # the last row was being written
    assert plan.reached_steps(tmp_path) == 640


def test_a_run_directory_has_one_owner(tmp_path: Path) -> None:
    assert RunDir(tmp_path).owner() is None
    with RunDir(tmp_path).exclusive():
        assert "process" in (RunDir(tmp_path).owner() or "")
        with (
            pytest.raises(rundir.RunBusyError, match=r"in use by process \d+"),
            RunDir(tmp_path).exclusive(wait_s=0.0),
        ):
            pass
    assert RunDir(tmp_path).owner() is None
