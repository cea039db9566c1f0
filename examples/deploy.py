"""Run an exported policy on a robot: policy.onnx and contract.json; numpy and onnxruntime only."""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime


class Controller:  # asked every control_dt s; joints are in the order of "joints" in the contract
    def __init__(self, onnx):
        self.session = onnxruntime.InferenceSession(onnx, providers=["CPUExecutionProvider"])
        self.c = json.loads(Path(onnx).with_name("contract.json").read_text())
        self.frames = None  # no episode yet: the next measurement begins one

    # rotation: body to world; gyro: in the body; position, goal: in the world; rad, rad/s and m
    def step(self, rotation, gyro, joints, position, goal=(0.0, 0.0)):
        if self.frames is None:
            self.start, self.action, self.tick, self.cycle = position, 0.0 * joints, 0, -1
            self.x, self.y = [joints] * 2, [joints] * 2  # the low-pass is at rest
        roll, yaw = np.arctan2(rotation[[2, 1], [1, 0]], rotation[[2, 0], [2, 0]])
        pitch = -np.arcsin(np.clip(rotation[2, 0], -1.0, 1.0))
        (cr, sr), (cp, sp) = ([np.cos(x / 2), np.sin(x / 2)] for x in (roll, pitch))
        words = {
            "roll_pitch": [roll, pitch], "roll_pitch_rate_b": gyro[:2], "joint_pos": joints,
            "base_displacement_w": position - self.start, "previous_action": self.action,
            "goal_displacement_w": goal - position[:2], "base_x_axis_w": rotation[:, 0],
            "base_z_axis_w": rotation[:, 2], "base_quat_h": [cp * cr, cp * sr, sp * cr, -sp * sr],
        }  # fmt: skip
        terms, follow = self.c["observation"], self.motion if self.c["motion"] else lambda *at: {}
        seen = [(words | follow(t["ahead"], position, yaw))[t["name"]] for t in terms]
        self.frames = [*(self.frames or [seen] * max(t["history"] for t in terms))[1:], seen]
        past = [i for i, term in enumerate(terms) if term["history"] > 1]
        history = [frame[i] for frame in self.frames for i in past]  # frame by frame, oldest first
        row = np.concatenate([*seen[: past[0]], *history, *seen[past[-1] + 1 :]], dtype=np.float32)
        self.action = np.clip(self.session.run(None, {"observation": row[None]})[0][0], -1.0, 1.0)
        self.x = [self.c["default_pose"] + self.action * self.c["action"]["scale"], *self.x]
        out = np.dot(self.c["lowpass"]["b"], self.x) - np.dot(self.c["lowpass"]["a"][1:], self.y)
        self.x, self.y, self.tick = self.x[:2], [out, self.y[0]], self.tick + 1
        return self.action, np.clip(out, *np.transpose(self.c["joint_limits"]))

    def motion(self, ahead, base, yaw):  # the pose to follow, seen from the base
        motion, poses = self.c["motion"], np.array(self.c["motion"]["frames"])
        time = motion["start"] + (self.tick + np.array([0, ahead])) * self.c["control_dt"]
        cycle, place = np.divmod(time / motion["frame_dt"], len(poses) - 1)
        travel = cycle[:, None] * motion["travels"] * (poses[-1] - poses[0])[:2]
        now, pose = ((1 - x % 1) * poses[int(x)] + x % 1 * poses[int(x) + 1] for x in place)
        if (begun := int(cycle[0] + place[0] / (len(poses) - 1) + 1e-4)) > self.cycle:
            self.cycle, self.shift = begun, base[:2] - now[:2] - travel[0]  # it begins at the base
        half, way = np.exp(-0.5j * yaw), pose[:2] + travel[1] + self.shift - base[:2]
        xy, (wz, x_y) = complex(*way) * half**2, (pose[3:5] + 1j * pose[[6, 5]]) * half
        q = np.array([wz.real, x_y.real, x_y.imag, wz.imag]) * np.copysign(1.0, wz.real)
        return {"target_base_displacement_h": [xy.real, xy.imag, pose[2] - base[2]],
            "target_base_quat_h": q / np.linalg.norm(q), "target_joint_pos": pose[7:]}  # fmt: skip


if __name__ == "__main__":  # joint targets for a robot at rest
    robot = Controller(sys.argv[1])
    print(robot.step(np.eye(3), np.zeros(3), np.array(robot.c["default_pose"]), np.zeros(3))[1])
