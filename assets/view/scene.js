"use strict";
// A small WebGL 2 renderer: solids and ground of a MuJoCo scene, one light with shadows, a camera
// that orbits. World frame: z up, metres. Poses are [x, y, z, qw, qx, qy, qz].

const SHADOW_PIXELS = 1024, SHADOW_HALF_SIZE = 1.6;
const SUN = normalize([-0.35, -0.45, 1]);
const GROUND_HALF_SIZE = 60;
const CLICK_PIXELS = 5;

// ---- vectors and matrices (column-major, as WebGL takes them)

function normalize(v) { const n = Math.hypot(...v) || 1; return v.map(x => x / n); }
function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
function add(a, b, k = 1) { return [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]]; }

function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

function poseMatrix(p, at = 0) {
  const [x, y, z, w, i, j, k] = [0, 1, 2, 3, 4, 5, 6].map(n => p[at + n]);
  return new Float32Array([
    1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j), 0,
    2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i), 0,
    2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j), 0,
    x, y, z, 1,
  ]);
}

function lookAt(eye, target) {
  const back = normalize(add(eye, target, -1));
  const right = normalize(cross([0, 0, 1], back)), up = cross(back, right);
  return new Float32Array([
    right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
    -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
  ]);
}

function perspective(fovy, aspect, near, far) {
  const f = 1 / Math.tan(fovy / 2), d = 1 / (near - far);
  return new Float32Array(
    [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * d, -1, 0, 0, 2 * near * far * d, 0]);
}

function orthographic(half, near, far) {
  const d = 1 / (near - far);
  return new Float32Array(
    [1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, 2 * d, 0, 0, 0, (near + far) * d, 1]);
}

// A pose between two, for frames between control steps.
function between(a, b, t) {
  const out = new Float32Array(a.length);
  for (let i = 0; i < a.length; i += 7) {
    let sign = 0;
    for (let k = 3; k < 7; k++) sign += a[i + k] * b[i + k];
    sign = sign < 0 ? -1 : 1;
    let n = 0;
    for (let k = 0; k < 7; k++) {
      out[i + k] = (1 - t) * a[i + k] + t * (k < 3 ? 1 : sign) * b[i + k];
      if (k > 2) n += out[i + k] ** 2;
    }
    for (let k = 3; k < 7; k++) out[i + k] /= Math.sqrt(n) || 1;
  }
  return out;
}

// ---- shapes: {points, normals, faces} in the frame of the geom

function revolve(profile, segments = 28) {
  const points = [], normals = [], faces = [];
  for (const [radius, z, nr, nz] of profile)
    for (let s = 0; s <= segments; s++) {
      const a = 2 * Math.PI * s / segments, c = Math.cos(a), d = Math.sin(a);
      points.push(radius * c, radius * d, z);
      normals.push(nr * c, nr * d, nz);
    }
  for (let row = 0; row + 1 < profile.length; row++)
    for (let s = 0; s < segments; s++) {
      const a = row * (segments + 1) + s, b = a + segments + 1;
      faces.push(a, a + 1, b, b, a + 1, b + 1);
    }
  return { points, normals, faces };
}

function arc(radius, from, to, shift, rows = 8) {
  return Array.from({ length: rows + 1 }, (_, i) => {
    const a = from + (to - from) * i / rows, c = Math.cos(a), s = Math.sin(a);
    return [radius * c, radius * s + shift, c, s];
  });
}

const QUARTER = Math.PI / 2;
const SHAPES = {
  sphere: ([r]) => revolve(arc(r, -QUARTER, QUARTER, 0, 16)),
  capsule: ([r, h]) => revolve([...arc(r, -QUARTER, 0, -h), ...arc(r, 0, QUARTER, h)]),
  cylinder: ([r, h]) => revolve([
    [0, -h, 0, -1], [r, -h, 0, -1], [r, -h, 1, 0], [r, h, 1, 0], [r, h, 0, 1], [0, h, 0, 1]]),
  cone: ([r, h]) => revolve([[0, -h, 0, -1], [r, -h, 0, -1], [r, -h, 0.9, 0.4], [0, h, 0.9, 0.4]]),
  ellipsoid: size => {
    const ball = SHAPES.sphere([1]);
    ball.points = ball.points.map((p, i) => p * size[i % 3]);
    ball.normals = ball.normals.map((n, i) => n / size[i % 3]);
    return ball;
  },
  box: size => {
    const points = [], normals = [], faces = [];
    for (let axis = 0; axis < 3; axis++)
      for (const side of [-1, 1]) {
        const first = points.length / 3;
        for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
          const p = [0, 0, 0];
          p[axis] = side * size[axis];
          p[(axis + 1) % 3] = u * size[(axis + 1) % 3];
          p[(axis + 2) % 3] = side * v * size[(axis + 2) % 3];
          points.push(...p);
          normals.push(...[0, 1, 2].map(k => (k === axis ? side : 0)));
        }
        faces.push(first, first + 1, first + 2, first, first + 2, first + 3);
      }
    return { points, normals, faces };
  },
  plane: () => {
    const g = GROUND_HALF_SIZE;
    return { points: [-g, -g, 0, g, -g, 0, g, g, 0, -g, g, 0],
             normals: [0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1], faces: [0, 1, 2, 0, 2, 3] };
  },
  mesh: (_, geom) => smooth(floats(geom.points), Array.from(new Uint32Array(bytes(geom.faces)))),
  hfield: ([x, y, z], geom) => {
    const heights = new Uint8Array(bytes(geom.heights)), { rows, columns } = geom;
    const points = [], faces = [];
    for (let r = 0; r < rows; r++)
      for (let c = 0; c < columns; c++)
        points.push(x * (2 * c / (columns - 1) - 1), y * (2 * r / (rows - 1) - 1),
                    z * heights[r * columns + c] / 255);
    for (let r = 0; r + 1 < rows; r++)
      for (let c = 0; c + 1 < columns; c++) {
        const a = r * columns + c, b = a + columns;
        faces.push(a, a + 1, b, b, a + 1, b + 1);
      }
    const shade = Array.from(heights, h => 0.6 + 0.5 * h / 255);  // hollows are darker
    return { ...smooth(points, faces), shade };
  },
};

function smooth(points, faces) {
  const normals = new Array(points.length).fill(0);
  const point = i => [points[3 * i], points[3 * i + 1], points[3 * i + 2]];
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map(k => point(faces[f + k]));
    const n = cross(add(b, a, -1), add(c, a, -1));
    for (let k = 0; k < 3; k++)
      for (let d = 0; d < 3; d++) normals[3 * faces[f + k] + d] += n[d];
  }
  return { points: Array.from(points), normals, faces };
}

function bytes(base64) { return Uint8Array.from(atob(base64), c => c.charCodeAt(0)).buffer; }
function floats(base64) { return new Float32Array(bytes(base64)); }

// ---- shaders

const VERTEX = `#version 300 es
layout(location = 0) in vec3 point;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 colour;
uniform mat4 model, camera, sun;
out vec3 at, facing, tint, local;
out vec4 lit;
void main() {
  vec4 world = model * vec4(point, 1.0);
  at = world.xyz; local = point; tint = colour;
  facing = mat3(model) * normal;
  lit = sun * (world + vec4(0.004 * normalize(facing), 0.0));
  gl_Position = camera * world;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 at, facing, tint, local;
in vec4 lit;
uniform vec3 eye, toSun, sky;
uniform float checker;
uniform highp sampler2DShadow shadow;
out vec4 pixel;
float parity(vec2 p) {  // chequers of edge 1, blurred by the width of a pixel
  vec2 w = fwidth(p) + 1e-4, wave = abs(fract(0.5 * p) - 0.5) * 2.0;
  vec2 s = clamp((wave - 0.5) * 2.0 / w, -1.0, 1.0);
  return s.x * s.y / (1.0 + dot(w, w));
}
void main() {
  vec3 n = normalize(facing), v = normalize(eye - at);
  vec3 base = tint * (1.0 + 0.07 * checker * parity(local.xy * 2.0));
  vec3 s = lit.xyz / lit.w * 0.5 + 0.5;
  bool inside = all(greaterThan(s, vec3(0.0))) && all(lessThan(s, vec3(1.0)));
  float open = 1.0;
  if (inside) {
    open = 0.0;
    for (int i = 0; i < 4; i++)
      open += 0.25 * texture(shadow, s + vec3(vec2(i % 2, i / 2) - 0.5, 0.0) / 1024.0);
  }
  float sun = max(dot(n, toSun), 0.0) * open;
  vec3 light = mix(vec3(0.50, 0.48, 0.46), vec3(0.60, 0.63, 0.68), 0.5 * n.z + 0.5) + 0.55 * sun;
  float shine = (1.0 - checker) * 0.25 * open * pow(max(dot(n, normalize(v + toSun)), 0.0), 40.0);
  float far = checker * smoothstep(6.0, 26.0, length(at - eye));
  pixel = vec4(mix(base * light + shine, sky, far), 1.0);
}`;
const DEPTH_VERTEX = `#version 300 es
layout(location = 0) in vec3 point;
uniform mat4 model, camera;
void main() { gl_Position = camera * model * vec4(point, 1.0); }`;
const DEPTH_FRAGMENT = `#version 300 es
precision mediump float;
void main() {}`;

// ---- the view

class SceneView {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = this.gl = canvas.getContext("webgl2", { antialias: true });
    if (!gl) throw new Error("this browser has no WebGL 2, which the picture needs");
    this.camera = { azimuth: -1.95, elevation: 0.3, distance: 2.4, target: [0, 0, 0.25] };
    this.program = this.link(VERTEX, FRAGMENT);
    this.depth = this.link(DEPTH_VERTEX, DEPTH_FRAGMENT);
    this.makeShadowMap();
    this.bodies = [];
    const green = [0.10, 0.65, 0.25], red = [0.85, 0.15, 0.35];
    this.disc = this.solid([[SHAPES.cylinder([0.07, 0.004]), green, [0, 0, 0.004, 1, 0, 0, 0]],
                            [SHAPES.cylinder([0.01, 0.15]), green, [0, 0, 0.15, 1, 0, 0, 0]]]);
    this.shaft = this.solid([[SHAPES.cylinder([0.012, 0.5]), red, [0, 0, 0.5, 1, 0, 0, 0]]]);
    this.tip = this.solid([[SHAPES.cone([0.035, 0.05]), red, [0, 0, 0, 1, 0, 0, 0]]]);
    this.covered = this.shift = 0;  // pixels on the right that something else covers; their share
    this.setSky();
  }

  setSky() {
    const text = getComputedStyle(document.body).getPropertyValue("--sky");
    this.sky = text.trim().split(/\s+/).map(Number);
  }

  link(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(`the shaders do not compile: ${gl.getProgramInfoLog(program)}`);
    const names = ["model", "camera", "sun", "eye", "toSun", "sky", "checker", "shadow"];
    const places = names.map(name => [name, gl.getUniformLocation(program, name)]);
    return { program, at: Object.fromEntries(places) };
  }

  makeShadowMap() {
    const gl = this.gl, size = SHADOW_PIXELS;
    this.map = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.map);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, size, size);
    for (const [name, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
      [gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE]])
      gl.texParameteri(gl.TEXTURE_2D, name, value);
    this.target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.map, 0);
    gl.drawBuffers([gl.NONE]);
  }

  // One buffer of [shape, colour, pose in the body] triples.
  solid(parts) {
    const gl = this.gl, data = [], faces = [];
    for (const [shape, colour, pose] of parts) {
      const m = poseMatrix(pose), first = data.length / 9;
      const turn = (v, i, w) => [0, 1, 2].map(
        r => m[r] * v[i] + m[4 + r] * v[i + 1] + m[8 + r] * v[i + 2] + w * m[12 + r]);
      for (let i = 0; i < shape.points.length; i += 3) {
        const shade = shape.shade ? shape.shade[i / 3] : 1;
        data.push(...turn(shape.points, i, 1), ...turn(shape.normals, i, 0),
                  ...colour.map(c => c * shade));
      }
      for (const f of shape.faces) faces.push(first + f);
    }
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(data), gl.STATIC_DRAW);
    for (let i = 0; i < 3; i++) {
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 36, 12 * i);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(faces), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { array, count: faces.length };
  }

  load(scene) {
    for (const { array } of this.bodies) this.gl.deleteVertexArray(array);
    const parts = Array.from({ length: scene.bodies }, () => []), ground = [];
    for (const geom of scene.geoms) {
      const isGround = geom.type === "plane" || geom.type === "hfield";
      const shape = SHAPES[geom.type](geom.size, geom);
      if (isGround) ground.push(this.grounded(shape, geom));
      else parts[geom.body].push([shape, geom.colour, geom.pose]);
    }
    this.bodies = [...parts.map(p => this.solid(p)), ...ground];
    this.solids = scene.bodies;
  }

  // Ground keeps its own frame, in which its chequers are drawn.
  grounded(shape, geom) {
    const solid = this.solid([[shape, geom.colour, [0, 0, 0, 1, 0, 0, 0]]]);
    return { ...solid, model: poseMatrix(geom.pose) };
  }

  put(program, solid, model, checker = 0) {
    const gl = this.gl;
    gl.uniformMatrix4fv(program.at.model, false, model);
    if (program.at.checker) gl.uniform1f(program.at.checker, checker);
    gl.bindVertexArray(solid.array);
    gl.drawElements(gl.TRIANGLES, solid.count, gl.UNSIGNED_INT, 0);
  }

  putAll(program, { poses, goal, force, from }) {
    for (let i = 0; i < this.solids; i++)
      if (this.bodies[i].count) this.put(program, this.bodies[i], poseMatrix(poses, 7 * i));
    if (goal) this.put(program, this.disc, poseMatrix([...goal, 1, 0, 0, 0]));
    if (force && Math.hypot(...force) > 1) this.putArrow(program, from, force);
  }

  putArrow(program, from, force) {
    const length = Math.hypot(...force) / 100, d = normalize(force);
    const side = normalize(cross(Math.abs(d[2]) > 0.9 ? [1, 0, 0] : [0, 0, 1], d));
    const other = cross(d, side), end = add(from, d, length);
    const frame = (at, k) => new Float32Array(
      [...side, 0, ...other, 0, d[0] * k, d[1] * k, d[2] * k, 0, ...at, 1]);
    this.put(program, this.shaft, frame(from, length));
    this.put(program, this.tip, frame(end, 1));
  }

  eye() {
    const { azimuth, elevation, distance, target } = this.camera, c = Math.cos(elevation);
    const away = [c * Math.cos(azimuth), c * Math.sin(azimuth), Math.sin(elevation)];
    return add(target, away, distance);
  }

  draw(frame) {
    const gl = this.gl, canvas = this.canvas, scale = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * scale);
    const height = Math.round(canvas.clientHeight * scale);
    if (canvas.width !== width || canvas.height !== height)
      Object.assign(canvas, { width, height });
    gl.enable(gl.DEPTH_TEST);
    const target = this.camera.target, eye = this.eye();
    const light = multiply(orthographic(SHADOW_HALF_SIZE, 0.5, 9),
                           lookAt(add(target, SUN, 5), target));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, SHADOW_PIXELS, SHADOW_PIXELS);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.depth.program);
    gl.uniformMatrix4fv(this.depth.at.camera, false, light);
    this.putAll(this.depth, frame);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.sky, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const at = this.program.at, lens = perspective(0.7, width / Math.max(height, 1), 0.05, 120);
    lens[8] = this.shift = this.covered / Math.max(canvas.clientWidth, 1);
    this.matrix = multiply(lens, lookAt(eye, target));
    gl.useProgram(this.program.program);
    gl.uniformMatrix4fv(at.camera, false, this.matrix);
    gl.uniformMatrix4fv(at.sun, false, light);
    gl.uniform3fv(at.eye, eye);
    gl.uniform3fv(at.toSun, SUN);
    gl.uniform3fv(at.sky, this.sky);
    gl.uniform1i(at.shadow, 0);
    gl.bindTexture(gl.TEXTURE_2D, this.map);
    this.putAll(this.program, frame);
    for (const ground of this.bodies.slice(this.solids))
      this.put(this.program, ground, ground.model, 1);
  }

  follow(point, share) {
    const target = this.camera.target;
    for (let i = 0; i < 2; i++) target[i] += share * (point[i] - target[i]);
    target[2] += share * (Math.max(0.25, 0.6 * point[2]) - target[2]);
  }

  // The ray from the eye through a pixel of the page: {eye, way}.
  ray(x, y) {
    const box = this.canvas.getBoundingClientRect(), { target } = this.camera;
    const eye = this.eye(), back = normalize(add(eye, target, -1));
    const right = normalize(cross([0, 0, 1], back)), up = cross(back, right);
    const tan = Math.tan(0.35), aspect = box.width / box.height;
    const u = (2 * (x - box.left) / box.width - 1 + this.shift) * tan * aspect;
    const v = (1 - 2 * (y - box.top) / box.height) * tan;
    return { eye, way: normalize(add(add(add([0, 0, 0], right, u), up, v), back, -1)) };
  }

  // Where a pixel shows the level z; null above the horizon.
  pointAtLevel(x, y, z) {
    const { eye, way } = this.ray(x, y), t = (z - eye[2]) / way[2];
    return t > 0 && t < 60 ? add(eye, way, t) : null;
  }

  // Pixel of the page that shows a point.
  pixelOf(point) {
    const m = this.matrix, box = this.canvas.getBoundingClientRect();
    const [x, y, , w] = [0, 1, 2, 3].map(
      r => m[r] * point[0] + m[4 + r] * point[1] + m[8 + r] * point[2] + m[12 + r]);
    return [box.left + box.width * (0.5 + 0.5 * x / w), box.top + box.height * (0.5 - 0.5 * y / w)];
  }

  // Drag turns, wheel and two fingers zoom. `grab(x, y)` may claim a drag: it returns a function
  // that is called with every position and with null at the end. `click(x, y)` gets a press that
  // stayed where it was.
  listen(grab = () => null, click = () => null) {
    const canvas = this.canvas, fingers = new Map();
    let held = null, still = null;
    canvas.addEventListener("pointerdown", event => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      held = fingers.size === 1 ? grab(event.clientX, event.clientY) : null;
      still = fingers.size === 1 && !held ? [event.clientX, event.clientY] : null;
    });
    canvas.addEventListener("pointermove", event => {
      const before = fingers.get(event.pointerId), now = [event.clientX, event.clientY];
      if (!before) return;
      fingers.set(event.pointerId, now);
      if (held) return held(...now);
      if (still && Math.hypot(now[0] - still[0], now[1] - still[1]) < CLICK_PIXELS) return;
      still = null;
      const [dx, dy] = [now[0] - before[0], now[1] - before[1]], camera = this.camera;
      if (fingers.size === 2) return this.zoom(Math.exp(-0.004 * dy));
      camera.azimuth -= 0.006 * dx;
      camera.elevation = Math.min(1.5, Math.max(0.02, camera.elevation + 0.006 * dy));
    });
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, event => {
        fingers.delete(event.pointerId);
        if (held) held(null);
        else if (still && name === "pointerup") click(...still);
        held = still = null;
      });
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.zoom(Math.exp(0.001 * event.deltaY));
    }, { passive: false });
  }

  zoom(factor) {
    this.camera.distance = Math.min(20, Math.max(0.6, this.camera.distance * factor));
  }
}
