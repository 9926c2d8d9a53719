// Lines over the map: paths, the camera of the chosen frame, loops and the ruler.
"use strict";

const CELLS = 12; // along each side of an image

class Overlay {
  constructor(canvas, arrays, state) {
    Object.assign(this, { canvas, arrays, state, context: canvas.getContext("2d") });
  }

  // lens as of the map's canvas; scale: pixels of this canvas for one of those.
  draw(view, lens, scale) {
    const { context, canvas, arrays, state } = this;
    context.clearRect(0, 0, canvas.width, canvas.height);
    const focal = mul([...lens.focal, 0], scale), center = mul([...lens.center, 0], scale);
    const pixel = (p) => [(focal[0] * p[0]) / p[2] + center[0], (focal[1] * p[1]) / p[2] + center[1]];
    this.segment = (a, b, color, width = 2, dash = []) => {
      let [p, q] = [toCamera(view, a), toCamera(view, b)];
      const near = 0.02;
      if (p[2] < near && q[2] < near) return;
      if (p[2] < near) p = add(p, mul(sub(q, p), (near - p[2]) / (q[2] - p[2])));
      if (q[2] < near) q = add(q, mul(sub(p, q), (near - q[2]) / (p[2] - q[2])));
      context.setLineDash(dash);
      for (const [ink, extra] of [["rgba(0,0,0,.45)", 2], [color, 0]]) {
        context.strokeStyle = ink;
        context.lineWidth = (width + extra) * devicePixelRatio;
        context.beginPath();
        context.moveTo(...pixel(p));
        context.lineTo(...pixel(q));
        context.stroke();
      }
    };
    this.dot = (point, color, size) => {
      const p = toCamera(view, point);
      if (p[2] < 0.02) return;
      context.fillStyle = color;
      context.strokeStyle = "rgba(0,0,0,.6)";
      context.lineWidth = devicePixelRatio;
      context.setLineDash([]);
      context.beginPath();
      context.arc(...pixel(p), size * devicePixelRatio, 0, 7);
      context.fill();
      context.stroke();
    };
    for (const [name, color] of Object.entries(ABOUT.paths))
      if (state.paths[name] && arrays[name]) this.path(arrays[name], color, name === "poses" ? 2.5 : 1.5);
    if (state.paths.loops) this.loops();
    if (!state.atFrame) this.camera(state.frame, pixel, view);
    this.ruler(pixel, view);
    if (state.atFrame) this.border(pixel);
  }

  path(poses, color, width) {
    let before = null, isGap = false; // of frames that are not placed: dots from the one before to the one after
    for (let row = 0; row < poses.length / 12; row++) {
      const here = poseAt(poses, row).position;
      const isKnown = Number.isFinite(here[0]);
      const isOurs = poses === this.arrays.poses, look = isGap ? ["#e5484d", 1, [3, 6]] : [color, width];
      if (before && isKnown && (isOurs || !isGap)) this.segment(before, here, ...look);
      before = isKnown ? here : before;
      isGap = !isKnown;
    }
  }

  loops() {
    const place = (row) => poseAt(this.arrays.poses, row).position;
    for (const [frame, other, outcome] of ABOUT.loops)
      if (outcome === "accepted" && [frame, other].every((row) => Number.isFinite(place(row)[0])))
        this.segment(place(frame), place(other), ABOUT.paths.loops, 1);
  }

  // The chosen frame's camera as a pyramid of a twentieth of the map's size, with its image at the far side.
  camera(frame, pixel, view) {
    const pose = poseAt(this.arrays.poses, frame);
    if (!Number.isFinite(pose.position[0])) return; // not placed
    const { fx, fy, cx, cy, width, height } = ABOUT.camera, far = 0.06 * this.state.size;
    const at = (x, y) => toWorld(pose, mul([(x - cx) / fx, (y - cy) / fy, 1], far));
    this.image((x, y) => toCamera(view, at(x * width, y * height)), pixel);
    const corners = [at(0, 0), at(width, 0), at(width, height), at(0, height)];
    corners.forEach((corner, k) => {
      this.segment(pose.position, corner, "#ffffff", 1.5);
      this.segment(corner, corners[(k + 1) % 4], "#ffffff", 1.5);
    });
    this.dot(pose.position, "#ffffff", 4);
  }

  // The image of the chosen frame, in cells that are small enough to be drawn as parallelograms; place(x, y): where a
  // share of its width and height is, before the camera of the view.
  image(place, pixel) {
    const { context, state } = this, picture = state.image;
    if (!picture || !picture.complete || !picture.naturalWidth) return;
    const [w, h] = [picture.naturalWidth / CELLS, picture.naturalHeight / CELLS];
    for (let row = 0; row < CELLS; row++)
      for (let column = 0; column < CELLS; column++) {
        const corners = [[column, row], [column + 1, row], [column, row + 1]];
        const points = corners.map(([x, y]) => place(x / CELLS, y / CELLS));
        if (points.some((point) => point[2] < 0.02)) continue;
        const [p, q, r] = points.map(pixel);
        context.setTransform((q[0] - p[0]) / w, (q[1] - p[1]) / w, (r[0] - p[0]) / h, (r[1] - p[1]) / h, p[0], p[1]);
        const [right, below] = [w / Math.hypot(q[0] - p[0], q[1] - p[1]), h / Math.hypot(r[0] - p[0], r[1] - p[1])];
        context.drawImage(picture, column * w, row * h, w, h, 0, 0, w + right, h + below); // a pixel over the next one
      }
    context.resetTransform();
  }

  // What the chosen frame's image shows, where the view is its camera.
  border(pixel) {
    const { fx, fy, cx, cy, width, height } = ABOUT.camera;
    const [x, y] = pixel([(-0.5 - cx) / fx, (-0.5 - cy) / fy, 1]);
    const [right, bottom] = pixel([(width - 0.5 - cx) / fx, (height - 0.5 - cy) / fy, 1]);
    this.context.setLineDash([]);
    this.context.strokeStyle = "rgba(255,255,255,.5)";
    this.context.lineWidth = devicePixelRatio;
    this.context.strokeRect(x, y, right - x, bottom - y);
  }

  ruler(pixel, view) {
    const [a, b] = this.state.ruler;
    if (!a) return;
    if (b) this.segment(a, b, "#ffffff", 2);
    for (const end of [a, b]) if (end) this.dot(end, "#ffd60a", 4);
    const middle = b && toCamera(view, mul(add(a, b), 0.5));
    if (!b || middle[2] < 0.02) return;
    const [x, y] = pixel(middle), text = lengthText(norm(sub(a, b))), { context } = this;
    context.font = `600 ${14 * devicePixelRatio}px system-ui, sans-serif`;
    context.lineWidth = 4 * devicePixelRatio;
    context.strokeStyle = "rgba(0,0,0,.8)";
    context.fillStyle = "#ffd60a";
    context.strokeText(text, x + 8 * devicePixelRatio, y - 8 * devicePixelRatio);
    context.fillText(text, x + 8 * devicePixelRatio, y - 8 * devicePixelRatio);
  }
}

function lengthText(length) {
  if (!ABOUT.isMetric) return `${length.toPrecision(3)} units`;
  return length < 1 ? `${(100 * length).toFixed(1)} cm` : `${length.toFixed(2)} m`;
}
