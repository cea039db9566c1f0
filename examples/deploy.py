"""Run an exported policy on a robot: policy.onnx and contract.json; numpy and onnxruntime only.

    python examples/deploy.py policy.onnx    # prints joint targets for a robot at rest
"""  # fmt: skip

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime

# What is measured -> what the policy is shown. m: rotation [3, 3] body to world, gyro [3] rad/s in
# the body, joints [12] rad, position [3] m and goal [2] m in the world; start, action: kept here.
WORDS = {
    "roll_pitch": lambda m: [np.arctan2(m["rotation"][2, 1], m["rotation"][2, 2]),
                             -np.arcsin(np.clip(m["rotation"][2, 0], -1.0, 1.0))],
    "roll_pitch_rate_b": lambda m: m["gyro"][:2],
    "joint_pos": lambda m: m["joints"],
    "base_displacement_w": lambda m: m["position"] - m["start"],
    "previous_action": lambda m: m["action"],
    "goal_displacement_w": lambda m: m["goal"] - m["position"][:2],
    "base_x_axis_w": lambda m: m["rotation"][:, 0],
    "base_z_axis_w": lambda m: m["rotation"][:, 2],
}  # fmt: skip


class Controller:
    """Asked once every ``control_dt`` s; joints are in the order of ``joints`` in the contract."""

    def __init__(self, onnx):
        self.session = onnxruntime.InferenceSession(onnx, providers=["CPUExecutionProvider"])
        self.c = json.loads(Path(onnx).with_name("contract.json").read_text())
        self.frames = None  # no episode yet: the next measurement begins one

    def step(self, **m):
        """Return the action [12] and the joint targets [12] in rad."""
        if self.frames is None:
            self.start, self.action = m["position"], np.zeros(len(self.c["joints"]))
            self.x, self.y = [m["joints"]] * 2, [m["joints"]] * 2  # the low-pass is at rest
        m |= {"start": self.start, "action": self.action}
        seen = [np.asarray(WORDS[term["name"]](m), float) for term in self.c["observation"]]
        steps = max(term["history"] for term in self.c["observation"])
        self.frames = [*(self.frames or [seen] * steps)[1:], seen]
        past = [i for i, term in enumerate(self.c["observation"]) if term["history"] > 1]
        history = [frame[i] for frame in self.frames for i in past]  # frame by frame, oldest first
        obs = [*seen[: past[0]], *history, *seen[past[-1] + 1 :]]
        row = np.concatenate(obs).astype(np.float32)[None]
        self.action = np.clip(self.session.run(None, {"observation": row})[0][0], -1.0, 1.0)
        target = self.c["default_pose"] + np.array(self.c["action"]["scale"]) * self.action
        (b, a), self.x = (self.c["lowpass"][k] for k in "ba"), [target, *self.x]
        out = np.dot(b, self.x) - np.dot(a[1:], self.y)
        self.x, self.y = self.x[:2], [out, self.y[0]]
        return self.action, np.clip(out, *np.transpose(self.c["joint_limits"]))


if __name__ == "__main__":
    robot = Controller(sys.argv[1])
    rest = dict(rotation=np.eye(3), gyro=np.zeros(3), joints=np.array(robot.c["default_pose"]))
    print(robot.step(**rest, position=np.array([0.0, 0.0, 0.27]), goal=np.array([1.0, 0.0]))[1])
