"""The shipped policies are the ones their page describes."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.policies.learned import NumpyPolicy, load_policy
from twirl_mjx.tasks.observations import layout_size
from twirl_mjx.training.presets import make_config

FILES = sorted(asset_path("policies").glob("*.npz"))


def test_every_policy_is_listed_with_its_hash() -> None:
    page = (asset_path("policies") / "README.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"^\| `(\S+\.npz)` .*`([0-9a-f]{64})` \|$", page, re.MULTILINE))
    assert listed == {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in FILES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_policy_loads_and_fits_its_task(path: Path) -> None:
    assert path.stat().st_size < 1_000_000
    policy = load_policy(path)
    assert isinstance(policy, NumpyPolicy)
    task = policy.header.task
    assert path.stem.startswith(task)
    observer = make_config(task).make_task().observer
    assert policy.observation_size == layout_size(observer.layout)
    assert policy.header.card["evaluation"]["return"] > 0
