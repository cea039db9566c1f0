from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx.policies.learned import (
    NumpyPolicy,
    Params,
    PolicyFileError,
    PolicyHeader,
    load_policy,
    save_policy,
)

LAYOUT = (("goal", 0, 2, "m"), ("roll_pitch[-2]", 2, 5, "rad"))


def make_header(**changes: object) -> PolicyHeader:
    header = PolicyHeader(
        task="biped",
        observation_size=5,
        action_size=2,
        control_dt=0.05,
        observation_layout=LAYOUT,
        config_digest="abc",
        versions={"jax": "1"},
        card={"seed": 3, "return": 1.5},
    )
    return dataclasses.replace(header, **changes)  # type: ignore[arg-type]


def make_params(observation: int = 5, hidden: int = 8, action: int = 2, seed: int = 0) -> Params:
    rng = np.random.default_rng(seed)

    def layer(size: int, out: int) -> dict[str, np.ndarray]:
        kernel = rng.standard_normal((size, out)).astype(np.float32)
        return {"kernel": kernel, "bias": rng.standard_normal(out).astype(np.float32)}

    return {
        "hidden_0": layer(observation, hidden),
        "hidden_1": layer(hidden, hidden),
        "mean": layer(hidden, action),
        "log_std": layer(hidden, action),
    }


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    return save_policy(tmp_path / "policy.npz", make_params(), make_header())


def loaded(path: Path) -> NumpyPolicy:
    policy = load_policy(path)
    assert isinstance(policy, NumpyPolicy)
    return policy


def test_action_by_hand() -> None:
    params: Params = {
        "hidden_0": {"kernel": np.array([[1.0, -1.0]]), "bias": np.array([0.5, 0.5])},
        "mean": {"kernel": np.array([[0.25], [3.0]]), "bias": np.array([-0.1])},
        "log_std": {"kernel": np.zeros((2, 1)), "bias": np.zeros(1)},
    }
    policy = NumpyPolicy(PolicyHeader("stand", 1, 1, 0.05), params)
    # x = 2: hidden = relu(2.5, -1.5) = (2.5, 0), mean = 0.625 - 0.1 = 0.525
    np.testing.assert_allclose(policy.act(np.array([2.0])), [np.tanh(0.525)], rtol=1e-6)
    # x = -1: hidden = relu(-0.5, 1.5) = (0, 1.5), mean = 4.5 - 0.1 = 4.4
    np.testing.assert_allclose(policy.act(np.array([-1.0])), [np.tanh(4.4)], rtol=1e-6)


def test_round_trip_is_exact(saved: Path) -> None:
    policy = loaded(saved)
    assert policy.header == make_header()
    for layer, arrays in make_params().items():
        for name, value in arrays.items():
            np.testing.assert_array_equal(policy.actor_params[layer][name], value)


def test_one_row_equals_a_batch_of_rows(saved: Path) -> None:
    policy = loaded(saved)
    obs = np.random.default_rng(1).standard_normal((3, 4, 5))
    actions = policy.act(obs)
    assert actions.shape == (3, 4, 2)
    assert actions.dtype == np.float32
    assert policy.act(obs[1, 2]).shape == (2,)
    np.testing.assert_allclose(policy.act(obs[1, 2]), actions[1, 2], atol=1e-6)


def test_equal_policies_have_equal_bytes(saved: Path, tmp_path: Path) -> None:
    other = save_policy(tmp_path / "again" / "policy.npz", make_params(), make_header())
    assert other.read_bytes() == saved.read_bytes()
    assert [p.name for p in other.parent.iterdir()] == ["policy.npz"]


def test_paper_sized_policy_is_below_one_megabyte(tmp_path: Path) -> None:
    header = PolicyHeader("biped", 101, 12, 0.05)
    path = save_policy(tmp_path / "big.npz", make_params(101, 256, 12), header)
    assert path.stat().st_size < 1_000_000


def test_loading_imports_no_jax(saved: Path) -> None:
    code = (
        "import sys, numpy as np; from twirl_mjx.policies import load_policy;"
        f"print(load_policy({str(saved)!r}).act(np.zeros(5)).shape);"
        "bad = {'jax', 'mujoco', 'flax'} & set(sys.modules); assert not bad, bad"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "(2,)"


@pytest.mark.parametrize("shape", [(4,), (3, 6), ()])
def test_wrong_observation_size_is_refused(saved: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 5\] of task 'biped'"):
        load_policy(saved).act(np.zeros(shape))


def test_value_that_is_not_finite_is_named(saved: Path) -> None:
    obs = np.zeros((4, 5))
    obs[2, 3] = np.nan
    with pytest.raises(ValueError, match=r"observation\[2, 3\] is nan: roll_pitch\[-2\]\[1\]"):
        load_policy(saved).act(obs)


def test_truncated_file_is_refused(saved: Path) -> None:
    saved.write_bytes(saved.read_bytes()[:-200])
    with pytest.raises(PolicyFileError, match=r"not a readable \.npz"):
        load_policy(saved)


def test_corrupt_array_is_refused(saved: Path) -> None:
    content = bytearray(saved.read_bytes())
    middle = content.index(b"hidden_1/kernel") + 80
    content[middle] ^= 0xFF
    saved.write_bytes(bytes(content))
    with pytest.raises(PolicyFileError, match=r"not a readable \.npz"):
        load_policy(saved)


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 and nothing"])
def test_foreign_bytes_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "policy.npz"
    path.write_bytes(content)
    with pytest.raises(PolicyFileError, match=r"not a readable \.npz"):
        load_policy(path)


def test_foreign_archives_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "data.npz"
    np.savez(path, weights=np.zeros(3))
    with pytest.raises(PolicyFileError, match=r"no header among \['weights'\]"):
        load_policy(path)
    np.savez(path, header=np.array("{}"))
    with pytest.raises(PolicyFileError, match="not marked as 'twirl_mjx policy'"):
        load_policy(path)
    np.savez(path, header=np.array({"a": 1}, dtype=object), allow_pickle=True)
    with pytest.raises(PolicyFileError, match="not a readable"):
        load_policy(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(PolicyFileError, match="holds one array"):
        load_policy(path)


def rewrite(path: Path, **replacements: np.ndarray) -> None:
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    np.savez(path, allow_pickle=False, **(arrays | replacements))


def test_faults_inside_an_archive_are_named(saved: Path) -> None:
    rewrite(saved, **{"mean/bias": np.zeros(3, np.float32)})
    with pytest.raises(PolicyFileError, match=r"mean: kernel \(8, 2\) and bias \(3,\)"):
        load_policy(saved)
    rewrite(saved, **{"mean/bias": np.array([0.0, np.inf], np.float32)})
    with pytest.raises(PolicyFileError, match="mean/bias holds a value that is not finite"):
        load_policy(saved)
    rewrite(saved, **{"mean/bias": np.zeros(2, np.float32), "extra/kernel": np.zeros(1)})
    with pytest.raises(PolicyFileError, match="actor layers are"):
        load_policy(saved)


def test_other_format_version_is_refused(saved: Path) -> None:
    text = make_header().to_json().replace('"format_version": 1', '"format_version": 2')
    rewrite(saved, header=np.array(text))
    with pytest.raises(PolicyFileError, match=r"version 2 .* reads version 1"):
        load_policy(saved)


def test_card_that_is_no_object_is_refused(saved: Path) -> None:
    text = json.dumps(json.loads(make_header().to_json()) | {"card": [1, 2]})
    rewrite(saved, header=np.array(text))
    with pytest.raises(PolicyFileError, match=r"\.npz: the card .* object, got \[1, 2\]"):
        load_policy(saved)


def test_layout_with_a_gap_is_refused() -> None:
    with pytest.raises(PolicyFileError, match=r"'b' is \[3, 5\), expected to start at 2"):
        make_header(observation_layout=(("a", 0, 2, "m"), ("b", 3, 5, "m")))
    with pytest.raises(PolicyFileError, match=r"covers \[0, 2\), but the size is 5"):
        make_header(observation_layout=(("a", 0, 2, "m"),))


def test_parameters_that_do_not_fit_the_header_are_not_saved(tmp_path: Path) -> None:
    with pytest.raises(PolicyFileError, match=r"hidden_0: kernel \(5, 8\)"):
        header = make_header(observation_size=6, observation_layout=())
        save_policy(tmp_path / "p.npz", make_params(), header)
    with pytest.raises(PolicyFileError, match=r"ends in \.npz"):
        save_policy(tmp_path / "p.pkl", make_params(), make_header())
    assert not list(tmp_path.iterdir())


def test_run_directory_gives_its_best_policy(tmp_path: Path) -> None:
    run = tmp_path / "run"
    save_policy(run / "policy_last.npz", make_params(seed=1), make_header(card={"which": "last"}))
    with pytest.raises(FileNotFoundError, match=r"holds policy_last\.npz; its last policy is"):
        load_policy(run)
    save_policy(run / "policy.npz", make_params(), make_header(card={"which": "best"}))
    assert loaded(run).header.card == {"which": "best"}
    assert loaded(run / "policy_last.npz").header.card == {"which": "last"}


def test_missing_policies_say_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="`twirl train` makes one"):
        load_policy(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match=r"holds nothing; train it"):
        load_policy(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(PolicyFileError, match=r"ends in \.npz or \.onnx, got '\.txt'"):
        load_policy(tmp_path / "notes.txt")
