// The rehearsal's ideal loop with MuJoCo in WebAssembly: observation, network, filter and motors of
// one robot that stands up and walks to a goal. `twirl_mjx.view.web` writes the record with all
// numbers; tests/view/test_web.py compares every step with `twirl_mjx.deploy.trial`.

const HISTORY = 3;

// ---- small pieces

function rotationOf([w, x, y, z]) {  // rows of the matrix from body to world
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

function clip(x, low, high) { return Math.min(Math.max(x, low), high); }

function floatsOf(base64) {
  return new Float32Array(Uint8Array.from(atob(base64), c => c.charCodeAt(0)).buffer);
}

// The actor: hidden layers with ReLU, then the tanh of the mean.
export class Network {
  constructor(layers) {
    this.layers = layers.map(l => ({ kernel: floatsOf(l.kernel), bias: floatsOf(l.bias) }));
  }

  act(obs) {
    let x = Float32Array.from(obs);
    this.layers.forEach(({ kernel, bias }, index) => {
      const y = Float64Array.from(bias);
      for (let i = 0; i < x.length; i++)
        for (let j = 0; j < y.length; j++) y[j] += x[i] * kernel[i * y.length + j];
      const last = index === this.layers.length - 1;
      x = Float32Array.from(y, v => (last ? Math.tanh(v) : Math.max(v, 0)));
    });
    return x;
  }
}

// The second-order low-pass on joint targets; it starts at rest at `joints`.
export class CommandFilter {
  constructor(record, joints) {
    this.record = record;
    this.inputs = [joints, joints];
    this.outputs = [joints, joints];
  }

  target(action) {
    const { pose, swing, lower, upper, filter: { b, a } } = this.record;
    const command = pose.map((p, j) => p + swing[j] * clip(action[j], -1, 1));
    const [x1, x2] = this.inputs, [y1, y2] = this.outputs;
    const out = command.map(
      (x, j) => b[0] * x + b[1] * x1[j] + b[2] * x2[j] - a[1] * y1[j] - a[2] * y2[j]);
    this.inputs = [command, x1];
    this.outputs = [out, y1];
    return out.map((q, j) => clip(q, lower[j], upper[j]));
  }
}

// What the policy sees: the goal, three steps of history, two axes of the base.
export class Observer {
  constructor(qpos, qvel) {
    this.start = Array.from(qpos.slice(0, 3));
    this.frames = Array(HISTORY).fill(this.frame(qpos, qvel, Array(12).fill(0)));
  }

  frame(qpos, qvel, action) {
    const r = rotationOf(qpos.slice(3, 7));
    const roll = Math.atan2(r[2][1], r[2][2]), pitch = -Math.asin(clip(r[2][0], -1, 1));
    const moved = this.start.map((s, k) => qpos[k] - s);
    return [roll, pitch, qvel[3], qvel[4], ...qpos.slice(7, 19), ...moved, ...action];
  }

  push(qpos, qvel, action) {
    this.frames = [...this.frames.slice(1), this.frame(qpos, qvel, action)];
  }

  observe(qpos, goal) {
    const r = rotationOf(qpos.slice(3, 7)), axis = k => [r[0][k], r[1][k], r[2][k]];
    return Float32Array.from(
      [goal[0] - qpos[0], goal[1] - qpos[1], ...this.frames.flat(), ...axis(0), ...axis(2)]);
  }
}

// ---- the loop

export class Loop {
  constructor(mujoco, record) {
    this.mujoco = mujoco;
    this.record = record;
    this.model = mujoco.MjModel.from_xml_string(record.xml);
    this.data = new mujoco.MjData(this.model);
    this.network = new Network(record.layers);
    this.falls = new Set(record.falls);
    this.goal = [1, 0];
    this.restart();
  }

  restart() {
    const { mujoco, model, data } = this;
    mujoco.mj_resetData(model, data);
    data.qpos.set(this.record.home);
    mujoco.mj_forward(model, data);
    this.observer = new Observer(data.qpos, data.qvel);
    this.filter = new CommandFilter(this.record, Array.from(data.qpos.slice(7, 19)));
    this.steps = this.upright = 0;
    this.fallen = false;
  }

  set(name, value) {
    if (name === "gravity") this.model.opt.gravity[2] = -value;
    else if (name === "friction") this.model.geom_friction[3 * this.record.floor] = value;
    else throw new Error(`${name} is fixed here`);
  }

  push(force) { this.data.xfrc_applied.set(force, 6 * this.record.trunk); }

  observe() { return this.observer.observe(this.data.qpos, this.goal); }

  // One control step: decide, then the motors follow the filtered target for `substeps` of physics.
  step() {
    const { mujoco, model, data, record } = this;
    const action = Array.from(this.network.act(this.observe()), x => clip(x, -1, 1));
    const target = this.filter.target(action);
    for (let n = 0; n < record.substeps && !this.fallen; n++) {
      const q = data.qpos, v = data.qvel, limit = record.torque_limit;
      data.ctrl.set(target.map(
        (t, j) => clip(record.kp * (t - q[7 + j]) - record.kd * v[6 + j], -limit, limit)));
      mujoco.mj_step(model, data);
      this.fallen = this.touches();
    }
    this.observer.push(data.qpos, data.qvel, action);
    this.steps += 1;
    const x_axis = rotationOf(data.qpos.slice(3, 7))[2][0];
    if (x_axis >= 0.7) this.upright += 1;
    return { action, target };
  }

  touches() {  // every contact has the floor on one side
    if (!this.data.ncon) return false;
    const contacts = this.data.contact;
    let found = false;
    for (let i = 0; i < this.data.ncon && !found; i++) {
      const contact = contacts.get(i);
      found = this.falls.has(contact.geom1) || this.falls.has(contact.geom2);
      contact.delete();
    }
    contacts.delete();
    return found;
  }

  poses() {  // [x, y, z, qw, qx, qy, qz] of every body that is drawn
    const { xpos, xquat } = this.data;
    return this.record.bodies.flatMap(
      b => [...xpos.slice(3 * b, 3 * b + 3), ...xquat.slice(4 * b, 4 * b + 4)]);
  }

  distance() { return Math.hypot(this.goal[0] - this.data.qpos[0], this.goal[1] - this.data.qpos[1]); }
}
