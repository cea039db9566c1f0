"use strict";
// The live page without a server behind it: the loop runs in the page itself.

const REST_MS = 1500;  // an episode that has ended is looked at before the next begins
const PUSH_STEPS = 4;

class Inside {
  constructor(loop, record) {
    Object.assign(this, { loop, record, paused: false, speed: 1, pushed: 0, force: [0, 0, 0] });
    this.conditions = { gravity: 9.81, friction: 1 };
  }

  // The loop's own module, MuJoCo and the record lie beside the page.
  static async begin() {
    const [{ default: load }, { Loop }, record] = await Promise.all([
      import("./mujoco.js"), import("./loop.js"), fetch("robot.json").then(r => r.json())]);
    return new Inside(new Loop(await load(), record), record);
  }

  async scene() {
    return { ...this.record.scene, number: 0, controls: this.record.controls,
             policies: ["biped"], shifts: ["none"] };
  }

  async act(name, value) {
    if (name === "pause") this.paused = value;
    else if (name === "speed") this.speed = value;
    else if (name === "restart") this.loop.restart();
    else if (name === "goal") this.loop.goal = value;
    else if (name === "pull" || name === "push") {
      this.force = value;
      this.pushed = name === "push" ? PUSH_STEPS : Infinity;
    } else {
      this.loop.set(name, value);
      this.conditions[name] = value;
    }
    return "";
  }

  listen(take) {
    const tick = () => {
      const began = performance.now();
      if (!this.paused) this.advance();
      take(this.frame());
      const wait = this.loop.fallen ? REST_MS : 50 / this.speed - (performance.now() - began);
      setTimeout(tick, Math.max(wait, 0));
    };
    tick();
  }

  advance() {
    if (this.loop.fallen) this.loop.restart();
    if (this.pushed <= 0) this.force = [0, 0, 0];
    this.pushed -= 1;
    this.loop.push(this.force);
    this.loop.step();
  }

  frame() {
    const { loop } = this, [x, y] = loop.data.qvel;
    return {
      scene: 0, time: loop.steps * 0.05, dt: 0.05, speed: this.speed, paused: this.paused,
      poses: loop.poses(), goal: [...loop.goal, 0], goalMoves: true, force: this.force,
      values: { "distance to goal (m)": loop.distance(), "upright (s)": loop.upright * 0.05,
                "speed (m/s)": Math.hypot(x, y), "height (m)": loop.data.qpos[2] },
      status: loop.fallen ? "it fell; the next episode begins" : "click where it shall walk to",
      policy: "biped", shift: "none", conditions: this.conditions,
    };
  }
}
