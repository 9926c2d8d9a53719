// Mouse, fingers and keys move the view: around a point (orbit) or by itself (fly).
"use strict";

const FLY_KEYS = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0] };

class Controls {
  // onMove(): the view has changed; onPick(x, y): a click without a move, pixels of the page from the element's corner.
  constructor(element, state, onMove, onPick) {
    Object.assign(this, { element, state, onMove, onPick, pointers: new Map(), keys: new Set(), travelled: 0 });
    element.addEventListener("pointerdown", (event) => this.down(event));
    element.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) element.addEventListener(name, (event) => this.up(event));
    element.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("keydown", (event) => this.key(event, true));
    element.addEventListener("keyup", (event) => this.key(event, false));
    element.addEventListener("blur", () => this.keys.clear());
  }

  down(event) {
    this.element.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.travelled = this.pointers.size > 1 ? 99 : 0;
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
    this.travelled += Math.abs(dx) + Math.abs(dy);
    const apart = () => {
      const [a, b] = [...this.pointers.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    if (this.pointers.size === 2) {
      const old = apart();
      this.pointers.set(event.pointerId, now);
      this.approach(old / apart());
      this.pan(dx / 2, dy / 2);
    } else {
      this.pointers.set(event.pointerId, now);
      if (this.travelled > 3) event.buttons === 2 || event.shiftKey ? this.pan(dx, dy) : this.turn(dx, dy);
    }
  }

  up(event) {
    const was = this.pointers.delete(event.pointerId);
    if (!was || this.travelled > 3 || event.type !== "pointerup") return;
    const box = this.element.getBoundingClientRect();
    this.onPick(event.clientX - box.left, event.clientY - box.top);
  }

  turn(dx, dy) {
    const { state } = this, view = state.view, flies = state.flies;
    const angle = (flies ? 1.2 : -5) / this.element.clientHeight, up = ABOUT.up;
    const about = (v) => {
      const level = turned(v, up, angle * dx);
      return turned(level, turned(view.right, up, angle * dx), -angle * dy);
    };
    const ahead = about(view.ahead);
    if (Math.abs(dot(ahead, up)) > 0.998) return; // straight up or down there is no left and right
    const position = flies ? view.position : sub(state.pivot, mul(ahead, norm(sub(state.pivot, view.position))));
    state.view = lookAt(position, add(position, ahead), up);
    this.onMove();
  }

  pan(dx, dy) {
    const { state } = this, far = norm(sub(state.pivot, state.view.position));
    const step = far / (state.focal * this.element.clientHeight);
    const move = add(mul(state.view.right, -dx * step), mul(state.view.down, -dy * step));
    state.view = { ...state.view, position: add(state.view.position, move) };
    state.pivot = add(state.pivot, move);
    this.onMove();
  }

  approach(factor) {
    const { state } = this, view = state.view;
    const move = state.flies
      ? mul(view.ahead, (1 - factor) * state.size)
      : mul(sub(state.pivot, view.position), 1 - Math.max(factor, 0.2));
    state.view = { ...view, position: add(view.position, move) };
    if (state.flies) state.pivot = add(state.pivot, move);
    this.onMove();
  }

  wheel(event) {
    event.preventDefault();
    this.approach(Math.exp(0.0012 * event.deltaY * (event.deltaMode === 1 ? 25 : 1)));
  }

  key(event, isDown) {
    const key = event.key.toLowerCase();
    if (!(key in FLY_KEYS) || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    if (!isDown) this.keys.delete(key);
    else if (!this.keys.has(key)) {
      this.keys.add(key);
      if (this.keys.size === 1) this.fly(performance.now());
    }
  }

  fly(before) {
    requestAnimationFrame((now) => {
      if (!this.keys.size) return;
      const { state } = this, step = Math.min((now - before) / 1000, 0.2) * 0.25 * state.size;
      const way = [...this.keys].map((key) => FLY_KEYS[key]).reduce(add);
      const move = sub(toWorld(state.view, mul(way, step)), state.view.position);
      state.view = { ...state.view, position: add(state.view.position, move) };
      state.pivot = add(state.pivot, move);
      this.onMove();
      this.fly(now);
    });
  }
}
