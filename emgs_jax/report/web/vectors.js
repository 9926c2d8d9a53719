// Vectors of three numbers, rotations as nine numbers row by row, cameras with OpenCV axes (x right, y down, z ahead).
"use strict";

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const mul = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => mul(a, 1 / (norm(a) || 1));

// A vector turned about a unit axis (Rodrigues).
function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add(mul(v, c), mul(cross(axis, v), s)), mul(axis, dot(axis, v) * (1 - c)));
}

// Where a camera is and how it looks: position, right, down, ahead (world), focal length as a share of its height.
function lookAt(position, target, up) {
  const ahead = unit(sub(target, position));
  let right = cross(ahead, up);
  right = norm(right) > 1e-6 ? unit(right) : unit(cross(ahead, [up[1], up[2], up[0]]));
  return { position, right, down: cross(ahead, right), ahead };
}

// A pose of the data: twelve numbers, the upper rows of T_world_camera.
function poseAt(poses, row) {
  const m = poses.subarray(12 * row, 12 * row + 12);
  const [right, down, ahead, position] = [0, 1, 2, 3].map((k) => [m[k], m[k + 4], m[k + 8]]);
  return { position, right, down, ahead };
}

const toCamera = (view, point) => {
  const d = sub(point, view.position);
  return [dot(d, view.right), dot(d, view.down), dot(d, view.ahead)];
};
const toWorld = (view, p) =>
  add(view.position, add(mul(view.right, p[0]), add(mul(view.down, p[1]), mul(view.ahead, p[2]))));
