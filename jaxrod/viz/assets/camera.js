// Turning, moving and zooming around a point, with a mouse, fingers or keys.

const FIELD_OF_VIEW = (32 * Math.PI) / 180;
const STEEPEST = Math.PI / 2 - 0.001;
const PRESETS = {
  free: [-0.95, 0.42],
  front: [-Math.PI / 2, 0],
  side: [0, 0],
  top: [-Math.PI / 2, STEEPEST],
};

class Camera {
  constructor(canvas, upName, onChange) {
    this.canvas = canvas;
    this.onChange = onChange;
    // first x second = up
    const k = "xyz".indexOf(upName);
    const unit = (i) => [0, 1, 2].map((axis) => (axis === i % 3 ? 1 : 0));
    this.up = unit(k);
    this.first = unit(k + 1);
    this.second = unit(k + 2);
    this.axisNames = [1, 2, 3].map((i) => "xyz"[(k + i) % 3]);
    // Seen from the front, x points right and y or z up.
    this.front = upName === "y" ? Math.PI / 2 : 0;
    this.insets = { top: 0, bottom: 0, sides: 0 };
    this.pointers = new Map();
    this.listen();
  }

  // Looks at the whole of a box, from the side the presets call free.
  frameBox(low, high) {
    this.box = [low, high];
    this.middle = scale(add(low, high), 0.5);
    this.size = 0.5 * length(subtract(high, low));
    this.preset = "free";
    this.fitted = true;
    [this.azimuth, this.elevation] = this.angles("free");
    this.centre = this.middle;
    this.distance = 4 * this.size;
  }

  angles(preset) {
    const [azimuth, elevation] = PRESETS[preset];
    return [azimuth + this.front, elevation];
  }

  get still() {
    return window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  }

  // Distance at which every corner of the box falls in the part of the view that the
  // controls leave free.
  fitDistance(azimuth = this.azimuth, elevation = this.elevation) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const { top, bottom, sides } = this.insets;
    const tall = Math.tan(FIELD_OF_VIEW / 2) * Math.max(0.3, 1 - (top + bottom) / height);
    const wide = (Math.tan(FIELD_OF_VIEW / 2) * Math.max(0.3 * width, width - 2 * sides)) / height;
    const { right, above, backward } = this.frame(azimuth, elevation);
    let distance = 0;
    for (let k = 0; k < 8; k++) {
      const corner = [0, 1, 2].map((axis) => this.box[(k >> axis) & 1][axis]);
      const away = subtract(corner, this.middle);
      const across = Math.abs(dot(away, right)) / wide;
      const upward = Math.abs(dot(away, above)) / tall;
      distance = Math.max(distance, dot(away, backward) + Math.max(across, upward));
    }
    return distance;
  }

  fit() {
    this.fitted = true;
    this.glide({ centre: this.middle, distance: this.fitDistance() });
  }

  show(preset) {
    this.preset = preset;
    this.fitted = true;
    const [azimuth, elevation] = this.angles(preset);
    const turns = Math.round((this.azimuth - azimuth) / (2 * Math.PI));
    this.glide({
      azimuth: azimuth + 2 * Math.PI * turns,
      elevation,
      centre: this.middle,
      distance: this.fitDistance(azimuth, elevation),
    });
  }

  // Keeps a fitted view fitted when the window changes.
  refit() {
    if (!this.fitted || this.gliding) return;
    this.centre = this.middle;
    this.distance = this.fitDistance();
  }

  glide(goal) {
    const start = { ...goal };
    for (const key of Object.keys(goal)) start[key] = this[key];
    cancelAnimationFrame(this.gliding);
    const begin = performance.now();
    const move = (now) => {
      const u = this.still ? 1 : clamp((now - begin) / 280, 0, 1);
      const ease = u * u * (3 - 2 * u);
      for (const key of Object.keys(goal)) {
        this[key] = Array.isArray(goal[key])
          ? goal[key].map((end, i) => mix(start[key][i], end, ease))
          : mix(start[key], goal[key], ease);
      }
      this.gliding = u < 1 ? requestAnimationFrame(move) : 0;
      this.onChange();
    };
    this.gliding = requestAnimationFrame(move);
  }

  turn(right, upward) {
    this.release();
    this.azimuth -= right;
    this.elevation = clamp(this.elevation + upward, -STEEPEST, STEEPEST);
    this.preset = null;
    this.onChange();
  }

  // Moves the picture by pixels.
  pan(right, down) {
    this.release();
    const { right: across, above } = this.frame();
    const metres = (2 * this.distance * Math.tan(FIELD_OF_VIEW / 2)) / this.canvas.clientHeight;
    this.centre = add(this.centre, add(scale(across, -right * metres), scale(above, down * metres)));
    this.fitted = false;
    this.onChange();
  }

  zoom(factor) {
    this.release();
    this.distance = clamp(this.distance * factor, this.size * 0.05, this.size * 40);
    this.fitted = false;
    this.onChange();
  }

  release() {
    cancelAnimationFrame(this.gliding);
    this.gliding = 0;
  }

  frame(azimuth = this.azimuth, elevation = this.elevation) {
    const level = add(
      scale(this.first, Math.cos(azimuth)),
      scale(this.second, Math.sin(azimuth)),
    );
    const backward = normalize(
      add(scale(level, Math.cos(elevation)), scale(this.up, Math.sin(elevation))),
    );
    const right = normalize(cross(this.up, level));
    return { right, above: cross(backward, right), backward };
  }

  view() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const { right, above, backward } = this.frame();
    const eye = add(this.centre, scale(backward, this.distance));
    const near = Math.max(0.02 * this.distance, this.distance - 4 * this.size);
    const lens = perspective(FIELD_OF_VIEW, width / height, near, this.distance + 8 * this.size);
    lens[9] = -(this.insets.bottom - this.insets.top) / height;
    const lamp = normalize(
      add(add(scale(this.up, 0.9), scale(right, -0.45)), scale(backward, 0.55)),
    );
    const matrix = multiply(lens, lookAt(right, above, backward, eye));
    return { matrix, eye, lamp, right, backward, width, height };
  }

  listen() {
    const { canvas, pointers } = this;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", () => this.fit());
    canvas.addEventListener("wheel", (event) => {
      // As a part of a page, it leaves the wheel to the page until it is clicked.
      if (window.parent !== window && document.activeElement !== canvas) return;
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
      this.zoom(Math.exp(clamp(pixels, -200, 200) * 0.0015));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      if (this.grab?.(event)) return; // what is under the pointer moves, not the view
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    const lift = (event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointerup", lift);
    canvas.addEventListener("pointercancel", lift);
    canvas.addEventListener("pointermove", (event) => this.drag(event));
  }

  drag(event) {
    const { pointers } = this;
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    if (pointers.size === 1) {
      if (event.buttons & 6 || event.shiftKey) this.pan(dx, dy);
      else this.turn(dx * 0.008, dy * 0.008);
    } else {
      // Two fingers: their distance zooms, their middle pans.
      const [, other] = [...pointers].find(([id]) => id !== event.pointerId);
      const spread = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
      this.zoom(spread(before) / spread(now));
      this.pan(dx / 2, dy / 2);
    }
    pointers.set(event.pointerId, now);
  }
}
