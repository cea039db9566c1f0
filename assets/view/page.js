"use strict";
// The page around the picture: a replay of recorded frames (REPLAY holds them) or, with REPLAY
// null, a live view of the loop that `twirl view` runs; with "inside", of one in the page (web.js).

const at = id => document.getElementById(id);
const PLOT_SECONDS = 10, FOLLOW_MS = 150;  // FOLLOW_MS: how far the camera lags behind

// ---- read-outs and plot

class Readouts {
  constructor() {
    this.rows = new Map();
    this.shown = null;
    this.history = [];
  }

  show(values, time) {
    if (Object.keys(values).join() !== [...this.rows.keys()].join()) this.clear();
    for (const [name, value] of Object.entries(values)) {
      if (!this.rows.has(name)) this.addRow(name);
      this.rows.get(name).cells[1].textContent = value === null ? "-" : number(value);
    }
    if (this.history.length && time < this.history.at(-1).time) this.history = [];
    if (!this.history.length || time > this.history.at(-1).time)
      this.history.push({ time, values });
    while (this.history[0].time < time - PLOT_SECONDS) this.history.shift();
  }

  clear() {
    at("values").replaceChildren();
    this.rows.clear();
    this.history = [];
    this.shown = null;
  }

  addRow(name) {
    const row = at("values").insertRow();
    row.insertCell().textContent = name;
    row.insertCell();
    row.title = "plot this";
    row.addEventListener("click", () => this.choose(name));
    this.rows.set(name, row);
    if (this.shown === null) this.choose(name);
  }

  choose(name) {
    this.shown = name;
    for (const [other, row] of this.rows) row.classList.toggle("plotted", other === name);
  }

  draw(history = this.history, now = null) {
    const canvas = at("plot"), scale = window.devicePixelRatio || 1, pen = canvas.getContext("2d");
    const width = canvas.clientWidth, height = canvas.clientHeight;
    Object.assign(canvas, { width: width * scale, height: height * scale });
    pen.scale(scale, scale);
    const points = history.map(h => [h.time, h.values[this.shown]])
      .filter(([, v]) => typeof v === "number");
    if (points.length < 2) return;
    const style = getComputedStyle(document.body), read = name => style.getPropertyValue(name);
    const ys = points.map(p => p[1]);
    let low = Math.min(...ys), high = Math.max(...ys);
    if (high - low < 1e-6) [low, high] = [low - 0.5, high + 0.5];
    const first = points[0][0], last = points.at(-1)[0];
    const x = t => 4 + (width - 8) * (t - first) / (last - first);
    const y = v => height - 16 - (height - 32) * (v - low) / (high - low);
    pen.fillStyle = read("--soft");
    pen.font = "11px system-ui, sans-serif";
    pen.fillText(number(high), 4, 11);
    pen.fillText(number(low), 4, height - 3);
    pen.textAlign = "right";
    pen.fillText(`${number(last - first)} s`, width - 4, height - 3);
    pen.strokeStyle = read("--mark");
    pen.lineWidth = 1.5;
    pen.beginPath();
    for (const [t, v] of points) pen.lineTo(x(t), y(v));
    pen.stroke();
    if (now === null) return;
    pen.fillStyle = read("--ink");
    pen.fillRect(x(now), 14, 1, height - 28);
  }
}

function number(value) {
  if (Math.abs(value) >= 100) return value.toFixed(0);
  return Math.abs(value) >= 10 ? value.toFixed(1) : value.toFixed(2);
}

function clock(time) { return `${time.toFixed(2)} s`; }

function startDrawing(view, frameAt) {
  let before = 0;
  function step(now) {
    const frame = frameAt(now);
    if (frame) {
      const share = frame.jump ? 1 : 1 - Math.exp((before - now) / FOLLOW_MS);
      view.covered = document.querySelector("aside").offsetWidth;
      if (at("follow").checked) view.follow(frame.poses.slice(7, 10), share);
      view.draw(frame);
    }
    before = now;
    requestAnimationFrame(step);
  }
  requestAnimationFrame(step);
}

function onKeys(keys) {
  document.addEventListener("keydown", event => {
    if (["INPUT", "SELECT"].includes(event.target.tagName) || !(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  });
}

// ---- replay

function replay(record, view) {
  view.load(record.scene);
  const poses = floats(record.poses), goals = record.goals && floats(record.goals);
  const stride = 7 * record.scene.bodies, count = poses.length / stride, dt = record.dt;
  const readouts = new Readouts(), end = (count - 1) * dt;
  const names = Object.keys(record.values);
  const valuesAt = i => Object.fromEntries(names.map(name => [name, record.values[name][i]]));
  const history = Array.from({ length: count }, (_, i) => ({ time: i * dt, values: valuesAt(i) }));
  let time = 0, playing = true, before = null, jump = true;
  at("status").textContent = record.note;
  at("hint").textContent = "drag turns, wheel zooms, space pauses";
  at("controls").remove();
  const play = value => {
    playing = value;
    at("pause").textContent = playing ? "pause" : "play";
  };
  const toggle = () => {
    if (time >= end) [time, jump] = [0, true];
    play(!playing);
  };
  const restart = () => { [time, jump] = [0, true]; play(true); };
  const asked = /^#t=([0-9.]+)$/.exec(location.hash);  // FILE.html#t=2.5 opens there, at rest
  if (asked) { time = Math.min(Number(asked[1]), end); play(false); }
  at("pause").addEventListener("click", toggle);
  at("restart").addEventListener("click", restart);
  at("time").addEventListener("input", () => { time = at("time").value * end; play(false); });
  onKeys({ " ": toggle, r: restart });
  view.listen();
  startDrawing(view, now => {
    if (playing && before !== null) time += at("speed").value * Math.min(now - before, 100) / 1000;
    before = now;
    if (time >= end) { time = end; if (playing) play(false); }
    const step = Math.min(time / dt, count - 1), i = Math.floor(step);
    const next = Math.min(i + 1, count - 1);
    const frame = k => poses.subarray(k * stride, (k + 1) * stride);
    at("time").value = end ? time / end : 0;
    at("clock").textContent = `${clock(time)} / ${clock(end)}`;
    readouts.show(valuesAt(i), i * dt);
    readouts.draw(history, time);
    const wasJump = jump;
    jump = false;
    return { poses: between(frame(i), frame(next), step - i), jump: wasJump,
             goal: goals && Array.from(goals.subarray(3 * i, 3 * i + 3)) };
  });
}

// ---- live

// The server's loop.
const BEHIND = {
  async act(name, value) {
    const answer = await fetch("do", {
      method: "POST", headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ name, value }),
    });
    return answer.ok ? "" : answer.text();
  },
  async scene(number) { return (await fetch(`scene?${number}`)).json(); },
  listen(take) {
    const source = new EventSource("events");
    source.onmessage = event => take(JSON.parse(event.data));
    source.onerror = () => { at("status").textContent = "twirl view has ended"; };
  },
};

function live(view, loop) {
  const readouts = new Readouts();
  let shown = null, frame = null, last = null, arrived = 0, controls = null, wanted = null;

  const send = async (name, value = null) => {
    const refusal = await loop.act(name, value);
    if (refusal) at("hint").textContent = refusal;
  };

  const loadScene = async number => {
    wanted = number;
    const scene = await loop.scene(number);
    if (wanted !== number) return;
    view.load(scene);
    shown = number;
    if (controls === null) controls = buildControls(scene.controls, send);
    controls.choices(scene.policies, scene.shifts);
  };

  const take = next => {
    if (next.scene !== shown && next.scene !== wanted) loadScene(next.scene);
    last = frame && frame.scene === next.scene && next.time > frame.time ? frame : null;
    frame = { ...next, poses: Float32Array.from(next.poses) };
    arrived = performance.now();
    at("status").textContent = next.status;
    at("clock").textContent = clock(next.time);
    at("pause").textContent = next.paused ? "go on" : "pause";
    readouts.show(next.values, next.time);
    readouts.draw();
    if (controls) controls.follow(next);
  };

  const pause = () => send("pause", !(frame && frame.paused));
  at("time").remove();
  at("pause").addEventListener("click", pause);
  at("restart").addEventListener("click", () => send("restart"));
  at("speed").addEventListener("change", () => send("speed", Number(at("speed").value)));
  at("hint").textContent = "pull the robot, drag the goal or click; elsewhere dragging turns, wheel zooms";
  onKeys({ " ": pause, r: () => send("restart") });
  view.listen((x, y) => grab(view, () => frame, send, x, y), (x, y) => {
    const point = frame && frame.goalMoves && view.pointAtLevel(x, y, frame.goal[2]);
    if (point) send("goal", point.slice(0, 2));
  });
  loop.listen(take);
  startDrawing(view, now => {
    if (!frame || frame.scene !== shown) return null;
    const share = last ? Math.min((now - arrived) / 1000 * frame.speed / frame.dt, 1) : 1;
    const poses = last ? between(last.poses, frame.poses, share) : frame.poses;
    return { poses, goal: frame.goal, force: frame.force, from: Array.from(poses.slice(7, 10)),
             jump: !last };
  });
}

// What a press takes hold of: the goal, the robot (a pull of 100 N a metre), or nothing.
function grab(view, current, send, x, y) {
  const frame = current();
  if (!frame) return null;
  let waiting = null, next = null;
  const post = async (name, value) => {  // one request at a time, the newest value last
    next = [name, value];
    if (waiting) return;
    waiting = true;
    while (next) { const [n, v] = next; next = null; await send(n, v); }
    waiting = null;
  };
  const near = (point, pixels) => {
    const [u, v] = view.pixelOf(point);
    return Math.hypot(u - x, v - y) < pixels;
  };
  const trunk = () => Array.from(current().poses.slice(7, 10));
  if (near(trunk(), 45))
    return (...to) => {
      const from = trunk();
      const point = to[0] === null ? null : view.pointAtLevel(to[0], to[1], from[2]);
      const pull = point ? [0, 1].map(k => 100 * (point[k] - from[k])) : [0, 0];
      const size = Math.max(Math.hypot(...pull) / 150, 1);
      post("pull", [pull[0] / size, pull[1] / size, 0]);
    };
  if (frame.goal && frame.goalMoves && near(frame.goal, 30))
    return (...to) => {
      const point = to[0] === null ? null : view.pointAtLevel(to[0], to[1], frame.goal[2]);
      if (point) post("goal", point.slice(0, 2));
    };
  return null;
}

function buildControls(sliders, send) {
  const root = at("controls"), inputs = new Map();
  const make = (tag, parent, text = "") => {
    const node = parent.appendChild(document.createElement(tag));
    node.textContent = text;
    return node;
  };
  const chooser = (label, name) => {
    const row = make("label", root, label);
    row.className = "row";
    const select = make("select", row);
    select.name = name;
    select.addEventListener("change", () => send(name, select.value));
    return select;
  };
  const policy = chooser("policy", "policy"), shift = chooser("shift", "shift");
  const push = make("button", root, "push sideways");
  push.addEventListener("click", () => send("push", [0, 60, 0]));
  const back = make("button", root, "push back");
  back.addEventListener("click", () => send("push", [-60, 0, 0]));
  for (const slider of sliders) {
    const label = make("label", root);
    label.className = "slider";
    make("span", label, slider.label);
    const value = make("output", label), input = make("input", label);
    Object.assign(input, { type: "range", name: slider.name, min: slider.low, max: slider.high,
                           step: slider.step });
    const show = () => { value.textContent = `${number(Number(input.value))} ${slider.unit}`; };
    input.addEventListener("input", show);
    input.addEventListener("change", () => send(slider.name, Number(input.value)));
    inputs.set(slider.name, { input, show, label });
  }
  const fill = (select, names) => {
    if (names.join("\n") === [...select.options].map(o => o.value).join("\n")) return;
    select.replaceChildren(...names.map(name => new Option(name)));
    select.parentElement.hidden = names.length < 2;
  };
  return {
    choices: (policies, shifts) => { fill(policy, policies); fill(shift, shifts); },
    follow: frame => {
      policy.value = frame.policy;
      shift.value = frame.shift;
      at("speed").value = String(frame.speed);
      for (const [name, { input, show, label }] of inputs) {
        label.hidden = !(name in frame.conditions);
        if (label.hidden || input.matches(":active")) continue;
        input.value = frame.conditions[name];
        show();
      }
    },
  };
}

function sayWhy(error) { at("status").textContent = error.message; }

let view = null;
try {
  view = new SceneView(at("scene"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => view.setSky());
  if (REPLAY === "inside")
    Inside.begin().then(loop => live(view, loop)).catch(sayWhy);
  else if (REPLAY) replay(REPLAY, view);
  else live(view, BEHIND);
} catch (error) {
  sayWhy(error);
}
