// The live page: shows pictures of a running simulation, and sends what the reader does.

const REACH = 22; // how near to a rod a pointer holds it [pixels]
const STICK = 0.15; // a stick that is moved less is at rest
const HAND = "#d62f5b";

const LEAST = 30; // pictures a second that the view is to show

// Whether a processor draws the view in the place of a graphics card.
function drawnBySoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const more = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl?.getParameter(more ? more.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  return /swiftshader|llvmpipe|software/i.test(name ?? "");
}

class LivePlayer extends Player {
  newRenderer() {
    if (drawnBySoftware()) {
      this.sharpness = { along: 2, around: 10, detail: 0.5 };
      document.body.classList.add("plain"); // without blur
    }
    return super.newRenderer();
  }

  furnish() {
    this.handTube = this.tubes.add(4, { colour: linearColour(HAND) });
    super.furnish();
    for (const tube of this.trailTubes) tube.visible = false;
    this.news = { pace: 1, rate: 0, force: 0, time: 0, held: -1, hand: [0, 0, 0] };
    [this.drawn, this.shown, this.counted] = [0, 0, performance.now()];
    this.wanted = {};
    this.buttons = [];
    this.held = null;
    this.makeHandles();
  }

  // One row per slider, three per target.
  makeHandles() {
    const axes = ["x", "y", "z"];
    this.rows = [];
    for (const handle of this.recording.handles) {
      const many = Array.isArray(handle.value);
      (many ? handle.value : [handle.value]).forEach((value, k) => {
        const row = $("handles").appendChild(document.createElement("label"));
        const name = row.appendChild(document.createElement("span"));
        name.textContent = breakable(many ? `${handle.label} ${axes[k]} [m]` : handle.label);
        const number = row.appendChild(document.createElement("output"));
        const input = row.appendChild(document.createElement("input"));
        const [low, high] = handle.range.map((end) => (many ? end[k] : end));
        Object.assign(input, { type: "range", step: "any", min: low, max: high });
        const digits = Math.max(0, 2 - Math.floor(Math.log10(high - low)));
        const made = { handle, many, k, input, number, digits, low, high };
        input.addEventListener("input", () => this.slide(made, Number(input.value)));
        this.rows.push(made);
        this.showValue(made, value);
      });
    }
    $("handles").addEventListener("submit", (event) => event.preventDefault());
    $("handles").hidden = !this.rows.length;
  }

  showValue(row, value) {
    row.value = value;
    if (document.activeElement !== row.input || row.input.value === "") row.input.value = value;
    const text = value.toFixed(row.digits).replace("-", "−");
    if (row.number.textContent !== text) row.number.textContent = text;
  }

  slide(row, value) {
    row.value = clamp(value, row.low, row.high);
    const own = this.rows.filter(({ handle }) => handle === row.handle);
    const given = row.many ? own.map((one) => one.value) : row.value;
    this.ask({ set: { ...this.wanted.set, [row.handle.label]: given } });
  }

  // Commands: one under way at a time; what is asked meanwhile goes together after it.
  async ask(command) {
    Object.assign(this.wanted, command);
    if (this.asking) return;
    this.asking = true;
    while (Object.keys(this.wanted).length) {
      const body = JSON.stringify(this.wanted);
      this.wanted = {};
      const headers = { "Content-Type": "application/json" };
      try {
        const answer = await fetch("do", { method: "POST", headers, body });
        if (!answer.ok) this.say(await answer.text());
      } catch {
        break; // `watch` says so
      }
    }
    this.asking = false;
  }

  say(text) {
    $("message").textContent = text;
    $("message").hidden = !text;
  }

  async watch() {
    let seen = 0;
    for (;;) {
      try {
        const answer = await fetch(`picture?after=${seen}`, { cache: "no-store" });
        if (!answer.ok) throw new Error(answer.statusText);
        const buffer = await answer.arrayBuffer();
        if (this.lost) {
          this.lost = false;
          this.say("");
        }
        if (buffer.byteLength) seen = this.take(buffer);
      } catch {
        this.lost = true;
        this.say("The simulation has ended.");
        await new Promise((resume) => setTimeout(resume, 1000));
        seen = 0;
      }
    }
  }

  take(buffer) {
    const { recording, rows } = this;
    const values = new Float64Array(buffer, 0, recording.head + rows.length);
    const [number, time, pace, heard, paused, failed, held, x, y, z, force, rate] = values;
    recording.positions.set(new Float32Array(buffer, 8 * values.length));
    this.news = { number, time, pace, heard, paused, failed, held, hand: [x, y, z], force, rate };
    rows.forEach((row, k) => {
      if (!this.asking) this.showValue(row, values[recording.head + k]);
    });
    if (failed && !this.failed) this.say(`The simulation broke down after ${time.toFixed(3)} s. Start again.`);
    if (!failed && this.failed) this.say("");
    this.failed = failed;
    if (this.playing !== !paused) {
      this.playing = !paused;
      this.showState();
    }
    // Text costs as much as a picture: ten times a second is enough to read it.
    if (!(performance.now() - this.told < 100)) {
      this.told = performance.now();
      this.showTime();
    }
    this.invalidate();
    return number;
  }

  showTime() {
    const { time, pace, force, held, paused } = this.news;
    $("clock").innerHTML = `<b>${time.toFixed(2)}</b> s`;
    const slow = !paused && pace < 0.95;
    const words = pace < 0.1 ? pace.toPrecision(1) : pace.toFixed(2);
    const now = paused ? "paused" : slow ? `slower than real time: ${words}×` : "real time";
    $("pace").textContent = `${now} · ${this.shown.toFixed(0)} pictures/s`;
    $("pace").classList.toggle("slow", slow);
    $("force").textContent = held < 0 ? "" : `pull ${force.toPrecision(3)} N`;
  }

  tick(now) {
    this.pending = 0;
    this.readGamepad();
    this.drawNow();
    this.judge(now);
  }

  // Counts the drawn pictures of a second. Where they are too few, the view gets coarser.
  judge(now) {
    this.drawn += 1;
    if (now - this.counted < 1000) return;
    this.shown = (1000 * this.drawn) / (now - this.counted);
    if (this.shown < LEAST && this.news.rate >= LEAST && this.renderer.detail > 0.5) {
      this.renderer.detail *= 0.8;
    }
    this.drawn = 0;
    this.counted = now;
  }

  pose() {
    super.pose();
    const { held, hand } = this.news;
    const start = held < 0 ? hand : this.recording.point(held, 0, 0);
    const thickness = 0.0035 * 2 * this.camera.size;
    const way = subtract(hand, start);
    const shown = held >= 0 && length(way) > thickness;
    this.tubes.setArrow(this.handTube, start, shown ? way : [0, 0, 0], thickness);
  }

  // What can be held: nodes, targets, bodies, as indices of points.
  points() {
    const { recording } = this;
    const list = recording.spheres.map((_, k) => recording.firstSphere + k);
    for (let k = 0; k < recording.total; k++) list.push(k);
    for (let k = 0; k < recording.moving; k++) list.push(recording.firstBody + k);
    return list;
  }

  // Where a point is in the view [pixels], or null behind the eye.
  onScreen(index) {
    const { matrix, width, height } = this.camera.view();
    return project(matrix, this.recording.point(index, 0, 0), width, height);
  }

  nearest(x, y) {
    let best = { far: 1, index: -1 };
    for (const index of this.points()) {
      const spot = this.onScreen(index);
      if (!spot) continue;
      // A thick rod is held anywhere on it.
      const radius = this.radiusOf(index) * this.pixelsPerMetre(index);
      const far = Math.hypot(spot[0] - x, spot[1] - y) / Math.max(REACH, 1.2 * radius);
      if (far < best.far) best = { far, index };
    }
    return best.index;
  }

  radiusOf(index) {
    const { radii, spheres, total } = this.recording;
    if (index < total) return radii[index];
    return spheres[index - total]?.radius ?? 0.05 * this.camera.size;
  }

  pixelsPerMetre(index) {
    const { eye, backward, height } = this.camera.view();
    const depth = dot(subtract(eye, this.recording.point(index, 0, 0)), backward);
    return height / (2 * depth * Math.tan(FIELD_OF_VIEW / 2));
  }

  grab(event) {
    if (event.button !== 0 || event.shiftKey || this.held) return false;
    const { left, top } = this.canvas.getBoundingClientRect();
    const index = this.nearest(event.clientX - left, event.clientY - top);
    if (index < 0) return false;
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.classList.add("held");
    const start = this.recording.point(index, 0, 0);
    const scale = 1 / this.pixelsPerMetre(index);
    this.held = { index, start, scale, pointer: event.pointerId, x: event.clientX, y: event.clientY };
    this.moveTo(index, start);
    return true;
  }

  drag(event) {
    const { held } = this;
    if (!held || event.pointerId !== held.pointer) return;
    const { right, above } = this.camera.frame();
    const across = scale(right, (event.clientX - held.x) * held.scale);
    const upward = scale(above, (held.y - event.clientY) * held.scale);
    this.moveTo(held.index, add(held.start, add(across, upward)));
  }

  drop(event) {
    if (!this.held || event.pointerId !== this.held.pointer) return;
    if (this.targetOf(this.held.index) === undefined) this.ask({ pull: null });
    this.held = null;
    this.canvas.classList.remove("held");
  }

  targetOf(index) {
    const { firstSphere, spheres, handles } = this.recording;
    const k = index - firstSphere;
    return k >= 0 && k < spheres.length ? handles.filter(({ radius }) => radius !== null)[k] : undefined;
  }

  // Moves a target, or the hand on a node or body, to a point.
  moveTo(index, point) {
    const target = this.targetOf(index);
    if (target) this.ask({ set: { ...this.wanted.set, [target.label]: point } });
    else {
      const { total, spheres } = this.recording;
      this.ask({ pull: { node: index < total ? index : index - spheres.length, point } });
    }
  }

  readGamepad() {
    const pad = [...(navigator.getGamepads?.() ?? [])].find(Boolean);
    if (!pad) return;
    const now = performance.now();
    const elapsed = Math.min(0.1, (now - (this.padRead ?? now)) / 1000);
    this.padRead = now;
    const [x, y, u, v] = [0, 1, 2, 3].map((k) => {
      const axis = pad.axes[k] ?? 0;
      return Math.abs(axis) < STICK ? 0 : axis;
    });
    const tip = this.recording.total - 1;
    if ((x || y) && tip >= 0 && !this.held) {
      this.stick ??= this.recording.point(tip, 0, 0);
      const { right, above } = this.camera.frame();
      const reach = 0.7 * this.camera.size;
      this.moveTo(tip, add(this.stick, add(scale(right, x * reach), scale(above, -y * reach))));
    } else if (this.stick) {
      this.stick = undefined;
      this.ask({ pull: null });
    }
    const sliders = this.rows.filter(({ many }) => !many);
    [u, -v].forEach((speed, k) => {
      const row = sliders[k];
      if (row && speed) this.slide(row, row.value + speed * elapsed * 0.7 * (row.high - row.low));
    });
    const pressed = pad.buttons.map((button) => button.pressed);
    if (pressed[0] && !this.buttons[0]) this.toggle();
    if (pressed[1] && !this.buttons[1]) this.ask({ reset: true });
    this.buttons = pressed;
  }

  // On a narrow page the handles are below the view, not beside it.
  layOut() {
    super.layOut();
    const narrow = this.canvas.clientWidth <= 560;
    const handles = $("handles");
    const above = $("controls").offsetHeight + 16;
    handles.style.bottom = narrow ? `${above}px` : "";
    if (narrow) {
      this.camera.insets.bottom += handles.offsetHeight;
      this.camera.refit();
    }
    const { left, top, width, height } = handles.getBoundingClientRect();
    this.axes.reserved.push([left + width / 2, top + height / 2, width / 2, height / 2]);
  }

  toggle() {
    this.ask({ paused: this.playing });
  }

  connect() {
    const { canvas } = this;
    this.camera.grab = (event) => this.grab(event);
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => this.drop(event));
    canvas.addEventListener("pointercancel", (event) => this.drop(event));
    $("play").addEventListener("click", () => this.toggle());
    $("reset").addEventListener("click", () => this.ask({ reset: true }));
    this.connectView();
    new ResizeObserver(() => this.layOut()).observe($("controls"));
  }

  actionsOf() {
    return {
      ...this.viewActions(),
      " ": () => this.toggle(),
      r: () => this.ask({ reset: true }),
    };
  }
}

async function main() {
  try {
    const header = JSON.parse($("header").textContent);
    const recording = await unpackRecording(header, $("data").textContent);
    window.live = new LivePlayer(recording);
    window.live.watch();
  } catch (error) {
    $("message").textContent = error.message;
    $("message").hidden = false;
    throw error;
  }
}

main();
