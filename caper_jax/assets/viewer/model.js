// One scene: decoding and kinematics. Vectors are arrays of 3, motions {r: 9 numbers by rows, t}.
"use strict";

const IDENTITY = {r: [1, 0, 0, 0, 1, 0, 0, 0, 1], t: [0, 0, 0]};

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const mean = (vectors) => scale(vectors.reduce(add), 1 / vectors.length);

function rotate(r, v) {
  return [
    r[0] * v[0] + r[1] * v[1] + r[2] * v[2],
    r[3] * v[0] + r[4] * v[1] + r[5] * v[2],
    r[6] * v[0] + r[7] * v[1] + r[8] * v[2],
  ];
}

function multiply(a, b) {
  const out = [];
  for (let i = 0; i < 3; i++)
    for (let j = 0; j < 3; j++)
      out.push(a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j]);
  return out;
}

const transpose = (r) => [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]];
const move = (motion, v) => add(rotate(motion.r, v), motion.t);

function compose(a, b) {
  return {r: multiply(a.r, b.r), t: add(rotate(a.r, b.t), a.t)};
}

// Rodrigues' rotation by an angle about a unit axis.
function turn([x, y, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), k = 1 - c;
  return [
    c + k * x * x, k * x * y - s * z, k * x * z + s * y,
    k * y * x + s * z, c + k * y * y, k * y * z - s * x,
    k * z * x - s * y, k * z * y + s * x, c + k * z * z,
  ];
}

// The motion of a joint by `amount` from where it is, in the camera's frame.
function jointMotion(type, axis, pivot, amount) {
  if (type === "prismatic") return {r: IDENTITY.r, t: scale(axis, amount)};
  const r = turn(axis, amount);
  return {r, t: subtract(pivot, rotate(r, pivot))};
}

// Motions of all parts away from their estimated poses, for joint states away from the estimated
// ones. With T_k the estimated pose of part k, joint j carries it by
//   M_k = M_parent (T_parent J_j(change) T_parent^-1),
// whose bracket is the joint's motion about its axis in the camera's frame. At no change every M
// is the identity, so estimates that the kinematics do not quite explain are shown as they are.
function partMotions(scene, states) {
  const motions = [IDENTITY];
  scene.joints.forEach((joint, j) => {
    const {axis, pivot, state} = scene.estimate;
    const own = jointMotion(joint.type, axis[j], pivot[j], states[j] - state[j]);
    motions.push(compose(motions[joint.parent], own));
  });
  return motions;
}

// Base64 of little-endian float32 numbers.
function decodeFloats(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Float32Array.from({length: bytes.length / 4}, (_, i) => view.getFloat32(4 * i, true));
}
