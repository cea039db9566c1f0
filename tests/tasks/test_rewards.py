"""Every reward term by hand-computed numbers, thresholds included."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.tasks import rewards


@pytest.mark.parametrize(
    ("cosine", "value"), [(1.0, 1.0), (0.0, 0.25), (-1.0, 0.0), (0.5, 0.5625), (-0.6, 0.04)]
)
def test_normalised_cosine(cosine: float, value: float) -> None:
    assert float(rewards.normalised_cosine(jnp.float32(cosine))) == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize(
    ("height", "value"), [(0.0, 0.0), (0.27, 0.3099645), (0.5, 0.6487213), (-0.1, -0.0951626)]
)
def test_height_bonus(height: float, value: float) -> None:
    assert float(rewards.height_bonus(jnp.float32(height))) == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize(
    ("z_axis", "displacement", "value"),
    [
        ((-1.0, 0.0, 0.0), (2.0, 0.0), 1.0),  # on the hind legs, belly to the goal
        ((1.0, 0.0, 0.0), (2.0, 0.0), -1.0),  # back to the goal
        ((0.0, 1.0, 0.0), (2.0, 0.0), 0.0),  # goal to the side
        ((0.0, 0.0, 1.0), (0.3, 0.4), 0.0),  # on four feet: down is at right angles to any way
        ((-0.6, 0.0, 0.8), (0.3, 0.4), 0.36),  # 0.6 * 0.3 / 0.5
        ((-1.0, 0.0, 0.0), (0.0, 0.0), 0.0),  # at the goal
    ],
)
def test_facing_cosine(
    z_axis: tuple[float, ...], displacement: tuple[float, ...], value: float
) -> None:
    result = rewards.facing_cosine(jnp.array(z_axis), jnp.array(displacement))
    assert float(result) == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize(
    ("distance", "previous", "value"),
    [
        (0.0101, 0.02, 0.5),  # just outside the goal, nearer
        (0.01, 0.02, 1.0),  # at the threshold
        (0.0, 0.0, 1.0),
        (0.005, 0.001, 1.0),  # inside, though further than before
        (1.0, 1.0, 0.0),  # not nearer
        (1.0, 1.0001, 0.5),
        (1.0001, 1.0, 0.0),
    ],
)
def test_distance_progress(distance: float, previous: float, value: float) -> None:
    result = rewards.distance_progress(jnp.float32(distance), jnp.float32(previous))
    assert float(result) == pytest.approx(value)


@pytest.mark.parametrize(
    ("distance", "previous", "value"),
    [
        (0.01, 0.02, 1.0),  # at the goal
        (1.0, 1.025, 0.5),  # 0.5 m/s: the whole bonus
        (1.0, 1.1, 0.5),  # never more
        (1.0, 1.005, 0.1),  # 0.1 m/s
        (1.0, 1.0, 0.0),
        (1.005, 1.0, -0.1),  # away: swaying sums to nothing
        (1.5, 1.0, -0.5),
    ],
)
def test_approach_speed(distance: float, previous: float, value: float) -> None:
    result = rewards.approach_speed(jnp.float32(distance), jnp.float32(previous), 0.05)
    assert float(result) == pytest.approx(value, abs=1e-4)


@pytest.mark.parametrize(("speed", "value"), [(0.51, 1.0), (0.5, 0.007), (-2.0, 0.007)])
def test_forward(speed: float, value: float) -> None:
    assert float(rewards.forward(jnp.float32(speed))) == pytest.approx(value)


@pytest.mark.parametrize(("angle", "value"), [(0.0, 1.0), (0.5, 0.3678794), (np.pi, 0.0018674)])
def test_orientation(angle: float, value: float) -> None:
    assert float(rewards.orientation(jnp.float32(angle))) == pytest.approx(value, abs=1e-6)


def test_joint_calm() -> None:
    velocity = jnp.zeros(12)
    assert float(rewards.joint_calm(velocity)) == 1.0
    three_four = velocity.at[0].set(3.0).at[7].set(-4.0)  # |qdot| = 5
    assert float(rewards.joint_calm(three_four)) == pytest.approx(0.6065307)


@pytest.mark.parametrize(("error", "value"), [(0.0, 1.0), (1.0, 0.3678794), (2.0, 0.1353353)])
def test_kernel(error: float, value: float) -> None:
    assert float(rewards.kernel(jnp.float32(error))) == pytest.approx(value)


def test_tracking_terms() -> None:
    def close(got: jax.Array, want: float) -> None:
        assert float(got) == pytest.approx(want, abs=1e-6)

    dq = jnp.zeros(12).at[0].set(0.3).at[7].set(-0.4)  # sum of squares 0.25
    close(rewards.joint_tracking(dq), 0.286505)
    close(rewards.joint_tracking(jnp.zeros(12)), 1.0)
    close(rewards.joint_vel_tracking(10.0 * dq), 0.082085)
    dx = jnp.array([0.1, 0.0, -0.2])
    close(rewards.root_tracking(dx, jnp.array(0.0)), 0.367879)
    close(rewards.root_tracking(jnp.zeros(3), jnp.array(0.5)), 0.082085)
    close(rewards.root_tracking(dx, jnp.array(0.5)), 0.030197)
    close(rewards.root_vel_tracking(jnp.array([0.5, 0, 0]), jnp.zeros(3)), 0.606531)
    close(rewards.root_vel_tracking(jnp.zeros(3), jnp.array([0, 1.0, 2.0])), 0.367879)
    feet = jnp.zeros((4, 3)).at[0, 0].set(0.1).at[3, 2].set(0.1)
    close(rewards.foot_tracking(feet), 0.449329)
