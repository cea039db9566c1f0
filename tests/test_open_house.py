"""What a user keeps outside: a task, a shift, a robot, a learner, a sink, each in a file.

CONTRIBUTING.md says what must change to add one; every row of its table is a test here or named
there.
"""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import twirl_mjx
from twirl_mjx import cli, plugins
from twirl_mjx.commands import evaluate, options, render
from twirl_mjx.commands.options import parse_train
from twirl_mjx.policies.identity import digest_of
from twirl_mjx.policies.scripted import get_scripted
from twirl_mjx.sim.leaves import SHIFTS
from twirl_mjx.sim.robots import ROBOTS
from twirl_mjx.sweep import plan
from twirl_mjx.sweep.grid import load
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.task import Measure, Task
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import RunDir, RunMismatchError
from twirl_mjx.worlds.config import WorldConfig

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def _forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is gone after it."""
    for registry in (TASKS, SHIFTS, ROBOTS):
        registry.names()
        monkeypatch.setattr(registry, "_items", dict(registry._items))
        monkeypatch.setattr(registry, "_references", dict(registry._references))


@pytest.fixture
def trot(tmp_path: Path) -> str:
    """The example task, copied to a folder of its own."""
    folder = tmp_path / "somewhere else"
    folder.mkdir()
    return f"{shutil.copy(ROOT / 'examples' / 'trot.py', folder)}:Trot"


@pytest.mark.parametrize("name", ["trot.py", "muddy.py", "go1.py"])
def test_examples_are_short(name: str) -> None:
    lines = (ROOT / "examples" / name).read_text().splitlines()
    assert len(lines) <= 60
    assert max(map(len, lines)) <= 100


@pytest.mark.slow
def test_a_task_of_ones_own_is_trained_evaluated_and_read_back(
    trot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    command = ["train", "--task", trot, "--trot.speed", "0.8", "--variant", "scratch"]
    assert cli.main([*command, "--preset", "debug", "--runs", str(runs)]) == 0
    run_dir = RunDir(runs / "trot-scratch-debug-s0-speed_0.8")
    record = json.loads(run_dir.config.read_text())
    assert (record["task"], record["trot"]["speed"], record["uses"]) == ("trot", 0.8, [trot])
    config = run_dir.read_config()
    assert config.options.speed == 0.8
    with run_dir.metrics.open(newline="") as file:
        names = {row["metric"] for row in csv.DictReader(file)}
    assert {"speed", "eval/speed", "world/level", "eval/min_distance"} <= names
    # The options are part of the run's identity.
    capsys.readouterr()
    assert cli.main([*command[:-2], "--variant", "scratch", "--trot.speed", "0.5", "--preset",
                     "debug", "--runs", str(runs), "--name", run_dir.name]) == 2  # fmt: skip
    assert "trot.speed: 0.8 -> 0.5" in capsys.readouterr().err
    # And evaluation, under a shift of one's own, finds the task by the run alone.
    out = tmp_path / "table.csv"
    muddy = f"{ROOT / 'examples' / 'muddy.py'}:MUDDY"
    words = ["evaluate", str(run_dir), "--shifts", "none", muddy, "--episodes", "2"]
    assert cli.main([*words, "--trot.distance", "1.5", "--out", str(out)]) == 0
    with out.open(newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert {row["shift"] for row in rows} == {"none", "muddy"}
    assert {"speed", "min_distance", "success", "return"} <= {row["metric"] for row in rows}
    assert {row["task"] for row in rows} == {"trot"}


def test_options_of_ones_own_task_are_in_the_help(
    trot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        cli.main(["train", "--task", trot, "--help"])
    shown = capsys.readouterr().out
    assert "--trot.speed" in shown
    assert "full reward" in shown


def test_worlds_from_a_class_an_object_and_a_file(trot: str) -> None:
    kind = plugins.load(trot)
    for task in (kind, kind(kind.Options(distance=2.0)), trot):
        env = twirl_mjx.make(task, num_envs=2, engine="native")
        state = jax.jit(env.reset)(jax.random.key(0))
        radius = np.hypot(*np.asarray(state.world.goal - state.data.qpos[:, :2]).T)
        np.testing.assert_allclose(radius, 2.0 if isinstance(task, Task) else 3.0, rtol=1e-5)
    env = twirl_mjx.make(kind, num_envs=2, options={"distance": 1.0})
    assert env.task.options.distance == 1.0


def test_three_ways_to_set_the_dynamics() -> None:
    muddy = f"{ROOT / 'examples' / 'muddy.py'}:MUDDY"
    env = twirl_mjx.make("stand", muddy, 2, dynamics={"friction": 0.3, "kp_scale": 0.9})
    np.testing.assert_allclose(env.dynamics.friction, 0.3)  # set by hand: after the shift
    np.testing.assert_allclose(env.dynamics.payload, 1.5)
    np.testing.assert_allclose(env.dynamics.kp_scale, 0.9)
    env = twirl_mjx.make("stand", num_envs=64, randomize=["friction=0.4:1.25", "payload=-1:2"])
    drawn = jax.jit(env.reset)(jax.random.key(0)).world.dynamics
    assert 0.4 <= float(drawn.friction.min()) < 0.6 < 1.0 < float(drawn.friction.max()) <= 1.25
    assert float(drawn.payload.min()) < -0.5 < 1.5 < float(drawn.payload.max())
    assert len(np.unique(drawn.friction)) == 64


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"randomize": ("fricton=0.4:1.2",)}, "nearest: 'friction'"),
        ({"randomize": ("friction=1.2:0.4",)}, r"reversed \(nearest: friction=0.4:1.2\)"),
        ({"randomize": ("friction=0.4:9",)}, r"outside \[0.01, 4.0\] \(nearest: 4.0\)"),
        ({"randomize": ("incline=0:0.1",)}, "acts in a sloped scene only"),
        ({"randomize": ("friction",)}, "write leaf=low:high"),
        ({"task": "trott.py:Trot"}, "there is no file trott.py to take the task 'Trot' from"),
        ({"task": "bipde"}, "unknown task 'bipde'.*nearest: 'biped'"),
        ({"robot": "a2"}, "unknown robot 'a2'.*nearest: 'a1'"),
        ({"shift": "icey"}, "unknown shift 'icey'.*nearest: 'icy'"),
    ],
)
def test_bad_names_and_ranges_are_one_line(given: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        WorldConfig(**given)
    assert "\n" not in str(caught.value)


BROKEN = {
    "does not import": ("import nothing_of_that_name", "does not import: ModuleNotFoundError"),
    "no such object": ("Trout = 1", r"has no task 'Trot' \(nearest: 'Trout'\)"),
    "no task": ("class Trot: pass", "Trot is no task: expected a class derived from Task"),
    "a taken name": (
        "import twirl_mjx\nclass Trot(twirl_mjx.Task):\n    name = 'biped'",
        "there is another task called 'biped'",
    ),
    "a name with capitals": (
        "import twirl_mjx\nclass Trot(twirl_mjx.Task):\n    name = 'My trot'",
        r"has the name 'My trot', expected lower case letters.*nearest: 'trot'",
    ),
    "an option without default": (
        "import dataclasses, twirl_mjx\n@dataclasses.dataclass(frozen=True)\nclass O:\n"
        "    speed: float\nclass Trot(twirl_mjx.Task):\n    name = 'trot'\n    Options = O",
        r"Trot.Options.speed has no default",
    ),
    "no measure": (
        "import twirl_mjx\nclass Trot(twirl_mjx.Task):\n    name = 'trot'\n"
        "    measures = {'speed': 'mean'}",
        r"measures\['speed'\] is no Measure: 'mean'",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_file_is_one_line_that_names_it(kind: str, tmp_path: Path) -> None:
    text, message = BROKEN[kind]
    path = tmp_path / "broken.py"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        make_config(f"{path}:Trot", "debug")
    assert "broken.py" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) in (
        ["broken.py"],
        ["__pycache__", "broken.py"],
    )


START = """        qpos, qvel = base.start_on_feet(key, scene, dynamics)
        memory = self.observer.init(qpos, qvel)
        return twirl_mjx.Start(qpos=qpos, qvel=qvel, goal=qpos[:2], memory=memory, task=())
"""
JUDGE = """        return twirl_mjx.Outcome(reward=jnp.float32(1.0), terminated=jnp.bool_(False),
                                 goal=world.goal, task=(), metrics={"height": view.height})
"""


def write_task(path: Path, start: str = START, judge: str = JUDGE, more: str = "") -> str:
    path.write_text(
        "import jax.numpy as jnp\nimport twirl_mjx\nfrom twirl_mjx.tasks import base\n\n"
        "class Hop(twirl_mjx.Task):\n    name = 'hop'\n" + more + "\n"
        f"    def start(self, key, scene, dynamics):\n{start}\n"
        f"    def judge(self, world, view, scene):\n{judge}"
    )
    return f"{path}:Hop"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"start": START.replace("qpos=qpos,", "qpos=qpos[:12],")},
            r"Hop\.start: qpos is \[12\] float32, expected \[19\] float32",
        ),
        (
            {"start": "        return 3\n"},
            r"Hop\.start returned a number or an array, expected Start",
        ),
        (
            {"judge": JUDGE.replace("jnp.float32(1.0)", "jnp.ones(3)")},
            r"Hop\.judge: reward is \[3\] float32, expected \[\] float32",
        ),
        (
            {"judge": JUDGE.replace("jnp.bool_(False)", "jnp.float32(0)")},
            r"Hop\.judge: terminated is \[\] float32, expected \[\] bool",
        ),
        ({"judge": JUDGE.replace("task=()", "task=3")}, r"Hop\.judge: the task's state is "),
        (
            {"judge": "        return world.gaol\n"},
            r"Hop\.judge fails: AttributeError: .*gaol",
        ),
        (
            {"more": "    measures = {'top': twirl_mjx.Measure('hight', 'max')}\n"},
            r"Hop\.measures: 'top' folds 'hight', which judge does not report.*nearest: 'height'",
        ),
    ],
)
def test_what_a_task_returns_is_checked_before_anything_is_compiled(
    changes: dict[str, str], message: str, tmp_path: Path
) -> None:
    reference = write_task(tmp_path / "hop.py", **changes)
    with pytest.raises(ValueError, match=message) as caught:
        twirl_mjx.make(reference, num_envs=2)
    assert "hop.py" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_task_with_nothing_but_start_and_judge_works(tmp_path: Path) -> None:
    env = twirl_mjx.make(write_task(tmp_path / "hop.py"), num_envs=2, engine="native")
    state = env.step(env.reset(jax.random.key(0)), jnp.zeros((2, env.action_size)))
    np.testing.assert_allclose(state.reward, 1.0)
    assert set(state.metrics) == {"height"}


def test_a_task_may_not_be_called_like_a_part_of_the_config(tmp_path: Path) -> None:
    path = tmp_path / "eval.py"
    path.write_text("import twirl_mjx\nclass Eval(twirl_mjx.Task):\n    name = 'eval'\n")
    with pytest.raises(ValueError, match=r"'eval' has the name of a field .*nearest: 'my_eval'"):
        make_config(f"{path}:Eval", "debug")


@pytest.mark.slow
def test_a_source_object_from_python(tmp_path: Path) -> None:
    def train(source: str) -> Any:
        return twirl_mjx.train(
            "stand",
            preset="debug",
            source=get_scripted(source),
            variant="twirl",
            runs=tmp_path,
            name="mine",
            total_env_steps=64,
            droq={"utd": 1.0},
            say=lambda _: None,
        )

    result = train("trot")
    assert result.directory == tmp_path / "mine"
    source = RunDir(result.directory).read_source()
    assert source == {"origin": "object GaitPolicy", "digest": digest_of(get_scripted("trot"))}
    with pytest.raises(RunMismatchError, match=r"source digest: '.*GaitPolicy .* -> '.*Policy "):
        train("bound")
    steps, values = result.curves["source_rows"]
    assert steps.tolist() == [32.0, 64.0]
    assert values.tolist() == [64.0, 64.0]
    assert result.policy.act(np.zeros(101, np.float32)).shape == (12,)
    assert set(result.measures) >= {"return", "standing_time", "success"}
    again = twirl_mjx.train(
        "stand", preset="debug", source=get_scripted("trot"), variant="twirl", runs=tmp_path,
        name="mine", total_env_steps=64, say=lambda _: None,
    )  # fmt: skip
    assert again.measures == result.measures


def test_a_cell_names_the_files_of_its_task_and_its_shift(trot: str, tmp_path: Path) -> None:
    """It is trained by another process, which has loaded neither."""
    muddy = f"{ROOT / 'examples' / 'muddy.py'}:MUDDY"
    grid = {
        "preset": "debug",
        "base": {"variant": "scratch", "trot.speed": 0.5},
        "axes": {"task": {"trot": {"task": trot}}, "shift": {"mud": {"shift": muddy}}},
        "seeds": (3,),
    }
    (tmp_path / "mine.py").write_text(f"GRID = ({grid!r},)\n")
    (cell,) = plan.make_plan(load(str(tmp_path / "mine.py")), tmp_path)
    argv = plan.arguments(cell, tmp_path)
    assert argv[argv.index("--task") + 1] == trot
    assert argv[argv.index("--shift") + 1] == muddy
    assert parse_train(argv[1:]).config == cell.config


def test_names_of_tasks_and_of_the_robot_stand_in_few_files() -> None:
    files = [p for p in (ROOT / "twirl_mjx").rglob("*.py")]
    for name in TASKS.builtin_names():
        spelled = [p for p in files if f'"{name}"' in p.read_text() or f"'{name}'" in p.read_text()]
        assert len(spelled) <= 6, (name, spelled)
    robot = [p for p in files if re.search(r"\ba1\b", p.read_text())]
    assert len(robot) <= 8, robot


def test_measures_have_defaults() -> None:
    assert Measure("speed", "mean", unit="m/s") == Measure("speed", "mean", 1.0, "m/s", "", False)


@pytest.mark.parametrize("kind", [evaluate.EvaluateOptions, render.RenderOptions])
def test_a_policy_is_shown_on_another_robot(kind: Any, tmp_path: Path) -> None:
    path = tmp_path / "r.py"
    path.write_text(
        "import dataclasses\nfrom twirl_mjx.sim.robots import A1\n"
        "TALL = dataclasses.replace(A1, name='tall')\n"
    )
    positional = ["zero", "--task", "stand"]
    _, overrides = options.parse_in_tasks(kind, [*positional, "--robot", f"{path}:TALL"], "x")
    config = options.with_overrides(WorldConfig(task="stand"), overrides)
    assert config.make_task().robot.name == "tall"
    _, none = options.parse_in_tasks(kind, positional, "x")
    assert options.with_overrides(WorldConfig(task="stand"), none).robot == "a1"
    _, wrong = options.parse_in_tasks(kind, [*positional, "--robot", "a2"], "x")
    with pytest.raises(ValueError, match=r"unknown robot 'a2'.*nearest: 'a1'"):
        options.with_overrides(WorldConfig(task="stand"), wrong)
