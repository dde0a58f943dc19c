// The camera, and the two layers it draws: points below (WebGL, or 2D where that is missing),
// boxes and joint axes above (2D, for dashes, halos and any line width).
"use strict";

const FIELD_OF_VIEW = 30 * Math.PI / 180;

class Camera {
  // Starts where the depth camera looked from: x right, y down, z forward becomes x right, y up,
  // z towards the viewer.
  constructor(target, up, radius) {
    this.start = {target, rotation: [1, 0, 0, 0, -1, 0, 0, 0, -1], radius};
    this.up = up;
    this.reset();
  }

  reset() {
    this.target = this.start.target;
    this.rotation = this.start.rotation;
    this.distance = 1.25 * this.start.radius / Math.sin(FIELD_OF_VIEW / 2);
  }

  // Angles in radians: around the object's up axis, then over the top. An object seen upside
  // down turns the other way round, so that its front always follows the pointer.
  orbit(around, over) {
    const side = rotate(this.rotation, this.up)[1] < 0 ? -1 : 1;
    this.rotation = multiply(this.rotation, turn(this.up, side * around));
    this.rotation = multiply(turn([1, 0, 0], over), this.rotation);
  }

  zoom(factor) {
    const {radius} = this.start;
    this.distance = Math.min(Math.max(this.distance * factor, 0.3 * radius), 60 * radius);
  }

  // Pixels; the object follows the pointer.
  pan(dx, dy, height) {
    const meters = 2 * this.distance * Math.tan(FIELD_OF_VIEW / 2) / height;
    const shift = rotate(transpose(this.rotation), [-dx * meters, dy * meters, 0]);
    this.target = add(this.target, shift);
  }

  // Viewer's frame: x right, y up, the scene at negative z.
  toView(point) {
    const v = rotate(this.rotation, subtract(point, this.target));
    return [v[0], v[1], v[2] - this.distance];
  }
}

class Layers {
  constructor(pointCanvas, lineCanvas) {
    this.pointCanvas = pointCanvas;
    this.lineCanvas = lineCanvas;
    this.lines = lineCanvas.getContext("2d");
    this.gl = pointCanvas.getContext("webgl", {antialias: true, alpha: true});
    if (this.gl) this.compile();
    else this.flat = pointCanvas.getContext("2d");
  }

  compile() {
    const gl = this.gl;
    const program = gl.createProgram();
    const attach = (type, source) => {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    };
    attach(gl.VERTEX_SHADER, `
      attribute vec3 position; uniform mat4 toClip; uniform float size; varying float away;
      void main() {
        gl_Position = toClip * vec4(position, 1.0);
        gl_PointSize = size / gl_Position.w;
        away = gl_Position.w;
      }`);
    attach(gl.FRAGMENT_SHADER, `
      precision mediump float; uniform vec3 color, paper; uniform vec2 fog; varying float away;
      void main() {
        vec2 offset = gl_PointCoord - 0.5;
        if (dot(offset, offset) > 0.25) discard;
        float fade = 0.5 * clamp((away - fog.x) / (fog.y - fog.x), 0.0, 1.0);
        gl_FragColor = vec4(mix(color, paper, fade), 1.0);
      }`);
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const position = gl.getAttribLocation(program, "position");
    gl.enableVertexAttribArray(position);
    gl.vertexAttribPointer(position, 3, gl.FLOAT, false, 0, 0);
    this.uniform = (name) => gl.getUniformLocation(program, name);
  }

  load(scene) {
    if (this.gl) this.gl.bufferData(this.gl.ARRAY_BUFFER, scene.points, this.gl.STATIC_DRAW);
  }

  draw(scene, camera, motions, layers) {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.lineCanvas.clientWidth;
    this.height = this.lineCanvas.clientHeight;
    for (const canvas of [this.pointCanvas, this.lineCanvas]) {
      const width = Math.round(this.width * ratio), height = Math.round(this.height * ratio);
      if (canvas.width !== width || canvas.height !== height) {
        canvas.width = width;
        canvas.height = height;
      }
    }
    // A tall window fits the object by its width.
    this.focal = Math.min(this.height, this.width) / 2 / Math.tan(FIELD_OF_VIEW / 2);
    this.camera = camera;
    this.near = camera.distance / 100;
    const style = getComputedStyle(document.documentElement);
    this.ink = style.getPropertyValue("--ink").trim();
    this.paper = style.getPropertyValue("--panel").trim();

    if (this.gl) this.drawPoints(scene, motions, layers.points, ratio);
    else this.drawPointsFlat(scene, motions, layers.points, ratio);

    this.lines.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.lines.clearRect(0, 0, this.width, this.height);
    this.lines.lineCap = this.lines.lineJoin = "round";
    if (layers.truth && scene.truth) {
      if (layers.boxes) this.drawTruth(scene);
      if (layers.axes) for (const [a, b] of scene.truth.segments)
        this.line(a, b, this.ink, 1.2, [6, 4]);
    }
    if (layers.others) this.drawOthers(scene);
    if (layers.boxes) this.drawBoxes(scene, motions);
    if (layers.axes) this.drawAxes(scene, motions);
  }

  drawPoints(scene, motions, shown, ratio) {
    const {gl, camera} = this;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!shown) return;
    gl.uniform1f(this.uniform("size"), scene.pointSize * this.focal * ratio);
    gl.uniform3fv(this.uniform("paper"), hexColor(this.paper));
    const {radius} = camera.start;
    gl.uniform2f(this.uniform("fog"), camera.distance - radius, camera.distance + 2 * radius);
    let first = 0;
    scene.counts.forEach((count, part) => {
      gl.uniformMatrix4fv(this.uniform("toClip"), false, this.clipMatrix(motions[part]));
      gl.uniform3fv(this.uniform("color"), hexColor(scene.parts[part].color));
      gl.drawArrays(gl.POINTS, first, count);
      first += count;
    });
  }

  // Column-major; part motion, then the camera, then perspective with clip planes near and far.
  clipMatrix(motion) {
    const {camera, near} = this, far = camera.distance + 20 * camera.start.radius;
    const view = compose(
      {r: camera.rotation, t: [0, 0, -camera.distance]},
      {r: motion.r, t: subtract(motion.t, camera.target)},
    );
    const sx = 2 * this.focal / this.width, sy = 2 * this.focal / this.height;
    const sz = (far + near) / (near - far), tz = 2 * far * near / (near - far);
    const out = new Float32Array(16);
    for (let column = 0; column < 4; column++) {
      const v = column < 3 ? [0, 1, 2].map((row) => view.r[3 * row + column]) : view.t;
      out.set([sx * v[0], sy * v[1], sz * v[2] + (column === 3 ? tz : 0), -v[2]], 4 * column);
    }
    return out;
  }

  drawPointsFlat(scene, motions, shown, ratio) {
    const flat = this.flat;
    flat.setTransform(ratio, 0, 0, ratio, 0, 0);
    flat.clearRect(0, 0, this.width, this.height);
    if (!shown) return;
    const dots = [];
    let index = 0;
    scene.counts.forEach((count, part) => {
      for (let i = 0; i < count; i++, index += 3) {
        const v = this.camera.toView(move(motions[part], scene.points.subarray(index, index + 3)));
        if (-v[2] > this.near) dots.push([v, part]);
      }
    });
    dots.sort((a, b) => a[0][2] - b[0][2]);
    for (const [v, part] of dots) {
      const size = Math.max(scene.pointSize * this.focal / -v[2], 1);
      const [x, y] = this.toPixel(v);
      flat.fillStyle = scene.parts[part].color;
      flat.fillRect(x - size / 2, y - size / 2, size, size);
    }
  }

  drawTruth(scene) {
    for (const corners of scene.truth.corners)
      for (const [a, b] of scene.edges) this.line(corners[a], corners[b], this.ink, 1, [5, 4]);
  }

  drawOthers(scene) {
    this.lines.globalAlpha = 0.45;
    for (const {corners} of scene.others)
      corners.forEach((box, part) => {
        for (const [a, b] of scene.edges) this.line(box[a], box[b], scene.parts[part].color, 1.2, []);
      });
    this.lines.globalAlpha = 1;
  }

  drawBoxes(scene, motions) {
    const boxes = scene.estimate.corners.map((corners, part) => {
      const view = corners.map((corner) => this.camera.toView(move(motions[part], corner)));
      return {view, color: scene.parts[part].color, depth: mean(view)[2]};
    });
    boxes.sort((a, b) => a.depth - b.depth);
    for (const {view, color} of boxes) {
      if (view.some((corner) => -corner[2] < this.near)) continue;
      const middle = mean(view);
      const away = scene.faces.map((face) => {
        const center = mean(face.map((corner) => view[corner]));
        return dot(subtract(center, middle), center) >= 0;
      });
      this.lines.globalAlpha = 0.1;
      this.lines.fillStyle = color;
      scene.faces.forEach((face, f) => { if (!away[f]) this.polygon(face.map((c) => view[c])); });
      this.lines.globalAlpha = 1;
      const hidden = scene.edges.map(([a, b]) =>
        scene.faces.every((face, f) => away[f] || !(face.includes(a) && face.includes(b))));
      for (const pass of [true, false])
        scene.edges.forEach(([a, b], edge) => {
          if (hidden[edge] !== pass) return;
          if (pass) this.stroke(view[a], view[b], color, 1, [2, 4]);
          else this.stroke(view[a], view[b], color, 2.4, [], true);
        });
    }
  }

  drawAxes(scene, motions) {
    scene.estimate.segments.forEach(([a, b], j) => {
      const motion = motions[scene.joints[j].parent];
      const start = this.camera.toView(move(motion, a)), end = this.camera.toView(move(motion, b));
      if (Math.max(start[2], end[2]) > -this.near) return;
      this.stroke(start, end, this.ink, 2.2, [], true);
      const [x, y] = this.toPixel(end), [fromX, fromY] = this.toPixel(start);
      const angle = Math.atan2(y - fromY, x - fromX);
      const tip = (side) => [x + 12 * Math.cos(angle + side), y + 12 * Math.sin(angle + side)];
      this.lines.fillStyle = this.ink;
      this.lines.beginPath();
      for (const [px, py] of [[x, y], tip(Math.PI - 0.35), tip(Math.PI + 0.35)])
        this.lines.lineTo(px, py);
      this.lines.fill();
    });
  }

  line(a, b, color, width, dash) {
    this.stroke(this.camera.toView(a), this.camera.toView(b), color, width, dash);
  }

  stroke(a, b, color, width, dash, halo) {
    if (Math.max(a[2], b[2]) > -this.near) return;
    const {lines} = this;
    lines.setLineDash(dash);
    lines.beginPath();
    lines.moveTo(...this.toPixel(a));
    lines.lineTo(...this.toPixel(b));
    if (halo) {
      lines.strokeStyle = this.paper;
      lines.lineWidth = width + 2;
      lines.stroke();
    }
    lines.strokeStyle = color;
    lines.lineWidth = width;
    lines.stroke();
  }

  polygon(corners) {
    this.lines.beginPath();
    for (const corner of corners) this.lines.lineTo(...this.toPixel(corner));
    this.lines.fill();
  }

  toPixel(v) {
    return [this.width / 2 - this.focal * v[0] / v[2], this.height / 2 + this.focal * v[1] / v[2]];
  }
}

function hexColor(text) {
  return [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);
}
