"""A policy sees the worlds as its own task shows them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.droq import networks
from twirl_mjx.motion.formats import read_clip, write_clip
from twirl_mjx.policies.learned import PolicyFileError, PolicyHeader, load_policy, save_policy
from twirl_mjx.policies.resolve import config_of_card, config_of_source, resolve_policy
from twirl_mjx.policies.source import ObservingSource, OwnTaskSource
from twirl_mjx.tasks.imitate import ImitateOptions
from twirl_mjx.tasks.stand import StandOptions
from twirl_mjx.training.presets import make_config


def save(path: Path, task: str, size: int, **card: object) -> Path:
    actor = networks.init_actor(jax.random.key(0), (8,), size, 12)
    header = PolicyHeader(task, size, 12, 0.05, card=dict(card))
    return save_policy(path, jax.tree.map(np.asarray, actor), header)


def test_in_its_own_task_a_policy_sees_what_the_task_shows(tmp_path: Path) -> None:
    """The reference phase of an ``imitate`` episode is known to the worlds alone."""
    path = save(tmp_path / "imitate.npz", "imitate", 160)
    policy = resolve_policy(str(path), make_config("imitate", "cpu")).policy
    assert isinstance(policy, OwnTaskSource)
    obs = jnp.linspace(-1.0, 1.0, 320).reshape(2, 160)
    action, memory = policy.act((), SimpleNamespace(obs=obs), jax.random.key(0))
    np.testing.assert_allclose(action, load_policy(path).act(np.asarray(obs)), atol=1e-6)
    assert memory == ()


def test_in_a_foreign_task_it_brings_its_observer_and_its_options(tmp_path: Path) -> None:
    clip = tmp_path / "mine.json"
    leap = read_clip(asset_path("a1", "leap.json"))
    write_clip(dataclasses.replace(leap, frame_duration=2 * leap.frame_duration), clip)
    options = dataclasses.asdict(ImitateOptions(clip=str(clip)))
    path = save(tmp_path / "imitate.npz", "imitate", 160, options=options)
    found = resolve_policy(str(path), make_config("hurdles", "cpu"))
    assert isinstance(found.policy, ObservingSource)
    assert found.policy._observer.duration == pytest.approx(2 * leap.cycle_duration)


def test_options_come_back_from_json_as_they_were(tmp_path: Path) -> None:
    options = dataclasses.asdict(make_config("biped").options) | {"fixed_goal": (2.0, 1.0)}
    path = save(tmp_path / "biped.npz", "biped", 101, options=options)
    header = load_policy(path).header
    own = config_of_source(make_config("hurdles"), header)
    assert own.task == "biped"
    assert own.options.fixed_goal == (2.0, 1.0)
    hash(own)


def test_card_gives_the_options_of_its_own_task(tmp_path: Path) -> None:
    path = save(tmp_path / "stand.npz", "stand", 101, options={"height_of": "root"})
    config = config_of_card(load_policy(path).header, str(path))
    assert (config.task, config.options) == ("stand", StandOptions(height_of="root"))
    assert make_config("stand").options.height_of == "front_feet"
    path = save(tmp_path / "old.npz", "stand", 101)  # cards did not always have options
    config = config_of_card(load_policy(path).header, str(path))
    assert config.options == make_config("stand").options


@pytest.mark.parametrize(
    ("task", "card", "message"),
    [
        ("crawl", {}, r"mine\.npz: unknown task 'crawl': choose one of .*nearest: "),
        ("seed", {}, r"mine\.npz: unknown task 'seed'"),
        ("stand", {"options": {"height_off": 1}}, r"mine\.npz: .*'height_off'.*'height_of'"),
        (
            "stand",
            {"options": {"risen_fraction": 7}},
            r"mine\.npz: .*risen_fraction = 7 is outside",
        ),
        ("stand", {"options": {"risen_fraction": "x"}}, r"mine\.npz: .*'risen_fraction': 'x'"),
        ("stand", {"options": 3}, r"mine\.npz: the options on its card are 3"),
    ],
)
def test_policies_of_another_version_are_refused(
    task: str, card: dict, message: str, tmp_path: Path
) -> None:
    path = save(tmp_path / "mine.npz", task, 101, **card)
    with pytest.raises(PolicyFileError, match=message):
        resolve_policy(str(path), make_config("biped"))
    with pytest.raises(PolicyFileError, match=message):
        config_of_card(load_policy(path).header, str(path))


def test_a_policy_of_another_size_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "biped.npz", "biped", 95)
    with pytest.raises(ValueError, match="observations of 95 numbers, task biped shows 101"):
        resolve_policy(str(path), make_config("hurdles"))
