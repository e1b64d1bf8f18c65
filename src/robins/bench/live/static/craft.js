// A craft and its body axes in WebGL: every piece is a box, turned by a quaternion in the shader.

import { multiply, turn } from "./quaternion.js";

const VERTEX = `
attribute vec3 corner, normal;
uniform vec3 size, offset;
uniform vec4 attitude, camera;
uniform vec2 scale;
varying float light;
vec3 turned(vec4 q, vec3 v) { return v + 2.0 * cross(q.yzw, cross(q.yzw, v) + q.x * v); }
void main() {
  vec3 at = turned(camera, turned(attitude, size * corner + offset));
  vec3 up = turned(camera, turned(attitude, normal));
  light = 0.6 + 0.4 * max(0.0, dot(up, normalize(vec3(0.3, 0.6, 0.8))));
  gl_Position = vec4(scale * at.xy, -0.4 * at.z, 1.0);
}`;
const FRAGMENT = `
precision mediump float;
uniform vec4 colour;
varying float light;
void main() { gl_FragColor = vec4(light * colour.rgb * colour.a, colour.a); }`;

const RADIUS = 1.1; // of what is seen
const STILL = [1, 0, 0, 0];
// z of the reference is up; seen from the right and from above
const CAMERA = multiply(turn(0.4, [1, 0, 0]), multiply(turn(-Math.PI / 2, [1, 0, 0]), turn(-0.6, [0, 0, 1])));
// half sizes and centres, in body axes: the box, its wings along y, what looks along z
const HULL = [
  [[0.3, 0.22, 0.22], [0, 0, 0]],
  [[0.16, 0.72, 0.012], [0, 0, 0]],
  [[0.07, 0.07, 0.07], [0, 0, 0.28]],
];

/** Corners and normals of a cube of half size one, as triangles. */
function cube() {
  const numbers = [];
  for (let axis = 0; axis < 3; axis++)
    for (const side of [-1, 1])
      for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) {
        const corner = [0, 0, 0];
        corner[axis] = side;
        corner[(axis + 1) % 3] = u;
        corner[(axis + 2) % 3] = v;
        numbers.push(...corner, ...[0, 1, 2].map((k) => (k === axis ? side : 0)));
      }
  return new Float32Array(numbers);
}

/** Half size and centre of an axis. */
const bar = (axis, length, width) => [[0, 1, 2].map((k) => (k === axis ? length / 2 : width)), [0, 1, 2].map((k) => (k === axis ? length / 2 : 0))];

function program(gl) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  return made;
}

export class Craft {
  /** `supported` is false where there is no WebGL. */
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl", { antialias: true });
    this.supported = this.gl !== null;
    if (!this.supported) return;
    this.#make();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault()); // it comes back
    canvas.addEventListener("webglcontextrestored", () => this.#make());
  }

  #make() {
    const { gl } = this;
    const made = program(gl);
    gl.useProgram(made);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, cube(), gl.STATIC_DRAW);
    ["corner", "normal"].forEach((name, k) => {
      const at = gl.getAttribLocation(made, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 24, 12 * k);
    });
    this.at = Object.fromEntries(["size", "offset", "attitude", "camera", "scale", "colour"].map((name) => [name, gl.getUniformLocation(made, name)]));
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /** Draw attitudes of body to reference: the first solid, others as ghosts with longer axes; null: not known. */
  draw(attitudes, colours) {
    if (!this.supported || this.gl.isContextLost()) return;
    const { gl, canvas, at } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.max(1, Math.round(size * devicePixelRatio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const least = Math.min(width, height);
    gl.uniform2f(at.scale, least / width / RADIUS, least / height / RADIUS);
    gl.uniform4fv(at.camera, CAMERA);
    for (const axis of [0, 1, 2]) this.#box(STILL, bar(axis, 1.1, 0.006), colours.frame, 1);
    attitudes.forEach((q, k) => {
      if (!q) return;
      const ghost = k > 0;
      gl.depthMask(!ghost); // a ghost hides nothing
      for (const box of HULL) this.#box(q, box, ghost ? colours.ghost : colours.craft, ghost ? 0.3 : 1);
      for (const axis of [0, 1, 2]) this.#box(q, bar(axis, ghost ? 1.05 : 0.85, ghost ? 0.009 : 0.022), colours.axes[axis], ghost ? 0.75 : 1);
    });
    gl.depthMask(true);
  }

  #box(q, [size, offset], colour, alpha) {
    const { gl, at } = this;
    gl.uniform4fv(at.attitude, q);
    gl.uniform3fv(at.size, size);
    gl.uniform3fv(at.offset, offset);
    gl.uniform4f(at.colour, ...colour, alpha);
    gl.drawArrays(gl.TRIANGLES, 0, 36);
  }
}
