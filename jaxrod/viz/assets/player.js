// The page: fills the scene for a moment in time, and connects the controls.

const $ = (id) => document.getElementById(id);
const TRAIL_NODES = 40;
// Long names may break after an underscore: a space of no width says so.
const breakable = (name) => name.replaceAll("_", "_\u200b");

class Player {
  constructor(recording) {
    this.recording = recording;
    this.time = 0;
    this.playing = false;
    this.canvas = $("view");
    this.invalidate = this.invalidate.bind(this);
    this.tubes = new Tubes();
    this.camera = new Camera(this.canvas, recording.up, this.invalidate);
    this.axes = new Axes(recording.box, recording.floor, this.camera, this.tubes, $("labels"));
    this.furnish();
    this.theme = readTheme();
    this.ramp = recording.ramp.flatMap(linearColour);
    const many = recording.total - recording.nodes.length > 2500;
    this.sharpness = many ? { along: 2, around: 10 } : { along: 5, around: 28 };
    this.renderer = this.newRenderer();
    recording.fields.forEach(({ label }, k) => $("colour").add(new Option(label, `field ${k}`)));
    this.writeLegend();
    this.readouts = recording.readouts.map((readout) => new Readout(readout, recording));
    this.connect();
    this.layOut();
    this.seek(0);
  }

  newRenderer() {
    const bodies = this.recording.meshes.map((mesh) => ({ ...mesh, colour: linearColour(mesh.colour) }));
    return new Renderer(this.canvas, this.tubes, bodies, this.sharpness);
  }

  // Makes the tubes: rods, obstacles, arrows, and a trail behind every tip and moving
  // sphere.
  furnish() {
    const { nodes, spheres, cylinders, arrows, radii, rodColours, firsts, firstSphere } = this.recording;
    this.trailTubes = [];
    const trail = (point, radius, colour) => {
      const look = { trail: true, point, radius: 0.35 * radius, colour: linearColour(colour) };
      this.trailTubes.push(this.tubes.add(TRAIL_NODES, look));
    };
    this.rodTubes = nodes.map((count, rod) => {
      const look = { colour: linearColour(rodColours[rod]), shadow: true, rings: true, rod: true };
      const tip = firsts[rod] + count - 1;
      if (nodes.length <= 64) trail(tip, radii[tip], rodColours[rod]);
      return this.tubes.add(count, look);
    });
    this.balls = spheres.map(({ radius, colour }, k) => {
      trail(firstSphere + k, radius, colour);
      return { radius, colour: linearColour(colour), centre: [0, 0, 0] };
    });
    this.arrowTubes = arrows.flatMap(({ count, colour }) =>
      Array.from({ length: count }, () => this.tubes.add(4, { colour: linearColour(colour) })));
    const fixed = cylinders.map((cylinder) => {
      const look = { colour: linearColour(cylinder.colour), shadow: true };
      return [cylinder, this.tubes.add(2, look)];
    });
    this.tubes.allocate();
    for (const [{ start, end, radius }, tube] of fixed) {
      this.tubes.setLine(tube, start, end, radius);
    }
  }

  pose() {
    const { recording, tubes, field } = this;
    const { nodes, firsts, radii, meshes, firstSphere, firstBody, firstArrow } = recording;
    const [frame, fraction] = recording.locate(this.time);
    this.rodTubes.forEach((tube, rod) => {
      for (let node = 0; node < nodes[rod]; node++) {
        const k = firsts[rod] + node;
        const at = (axis) => recording.at(3 * k + axis, frame, fraction);
        const level = field ? recording.level(field, k, frame, fraction) : -1;
        tubes.setNode(tube, node, at(0), at(1), at(2), radii[k], level);
      }
      tubes.close(tube);
    });
    this.balls.forEach((ball, k) => {
      ball.centre = recording.point(firstSphere + k, frame, fraction);
    });
    let body = 0;
    this.poses = meshes.map(({ count }) => Array.from({ length: count }, () => {
      const origin = recording.point(firstBody + body, frame, fraction);
      return { origin, turn: recording.turn(body++, frame, fraction) };
    }));
    const thickness = 0.0035 * 2 * this.camera.size;
    this.arrowTubes.forEach((tube, k) => {
      const start = recording.point(firstArrow + k, frame, fraction);
      const way = recording.arrow(k, frame, fraction);
      tubes.setArrow(tube, start, length(way) > 2 * thickness ? way : [0, 0, 0], thickness);
    });
    const span = Math.min(1, 0.25 * recording.duration);
    for (const tube of this.trailTubes) {
      if (!tube.visible) continue;
      for (let k = 0; k < TRAIL_NODES; k++) {
        const u = k / (TRAIL_NODES - 1);
        const then = recording.locate(Math.max(0, this.time - span * (1 - u)));
        const point = recording.point(tube.point, ...then);
        tubes.setNode(tube, k, ...point, tube.radius * u);
      }
      tubes.close(tube);
    }
  }

  // One picture is drawn per change, however many changes a frame brings.
  invalidate() {
    this.pending ||= requestAnimationFrame((now) => this.tick(now));
  }

  tick(now) {
    this.pending = 0;
    if (this.playing) {
      const elapsed = Math.min(0.1, (now - (this.last ?? now)) / 1000);
      this.last = now;
      this.time += elapsed * this.speed;
      if (this.time > this.recording.duration) this.time = 0;
      this.showTime();
      this.invalidate();
    }
    this.drawNow();
  }

  drawNow() {
    this.pose();
    this.renderer.resize();
    const view = this.camera.view();
    this.axes.update(view);
    this.renderer.draw({
      camera: view.matrix, eye: view.eye, lamp: view.lamp, up: this.camera.up,
      floor: this.axes.floor(), balls: this.balls, poses: this.poses, theme: this.theme,
      ramp: this.ramp, steepest: this.steepest || 0, measured: Boolean(this.field),
    });
    for (const button of document.querySelectorAll("[data-preset]")) {
      button.setAttribute("aria-pressed", button.dataset.preset === this.camera.preset);
    }
  }

  get speed() {
    return Number($("speed").value);
  }

  seek(time) {
    this.time = clamp(time, 0, this.recording.duration);
    this.showTime();
    this.invalidate();
  }

  stepFrames(count) {
    this.pause();
    const { times } = this.recording;
    const frame = clamp(this.recording.frameAt(this.time) + count, 0, times.length - 1);
    this.seek(times[frame]);
  }

  play() {
    if (this.recording.times.length < 2) return;
    this.playing = true;
    this.last = undefined;
    this.showState();
    this.invalidate();
  }

  pause() {
    this.playing = false;
    this.showState();
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  showState() {
    $("play").classList.toggle("playing", this.playing);
    $("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
  }

  showTime() {
    const { start, times, duration } = this.recording;
    const digits = duration < 1 ? 3 : 2;
    const now = (start + this.time).toFixed(digits);
    $("clock").innerHTML = `<b>${now}</b><span> / ${(start + duration).toFixed(digits)}</span> s`;
    const scrubber = $("scrubber");
    scrubber.value = this.recording.frameAt(this.time);
    scrubber.setAttribute("aria-valuetext", `${now} seconds`);
    for (const readout of this.readouts) readout.show(this.time, this.recording);
    scrubber.max = times.length - 1;
  }

  changeSpeed(direction) {
    const { options } = $("speed");
    $("speed").selectedIndex = clamp($("speed").selectedIndex + direction, 0, options.length - 1);
  }

  colourBy(what) {
    const curved = what === "curvature";
    this.scale ??= curved ? this.recording.curvatureScale() : undefined;
    this.steepest = curved ? this.scale : 0;
    this.field = this.recording.fields.find((_, k) => what === `field ${k}`);
    this.writeLegend();
    this.layOut();
  }

  writeLegend() {
    const { rodLegend, otherLegend, ramp, title } = this.recording;
    $("title").textContent = breakable(title);
    const colours = `linear-gradient(90deg, ${ramp})`;
    const entries = [...rodLegend, ...otherLegend];
    const named = (words) => entries.splice(0, rodLegend.length, [colours, words, "ramp"]);
    if (this.steepest) named(`curvature 0 – ${this.steepest.toPrecision(2)} /m`);
    if (this.field) {
      const [low, high] = this.field.range.map((x) =>
        String(Number(x.toPrecision(3))).replace("-", "−"));
      named(`${this.field.label} ${low} – ${high}`);
    }
    $("legend").replaceChildren(...entries.map(([fill, text, kind]) => {
      const item = document.createElement("li");
      const swatch = item.appendChild(document.createElement("i"));
      swatch.style.background = fill;
      if (kind) swatch.className = kind;
      item.append(breakable(text));
      return item;
    }));
    const shown = entries.map(([, text]) => text).join(", ");
    this.canvas.setAttribute("aria-label", `3-D view of ${shown}. Drag to turn, wheel to zoom.`);
  }

  layOut() {
    const narrow = this.canvas.clientWidth <= 560;
    const heading = $("heading");
    this.camera.insets = {
      top: narrow ? heading.offsetTop + heading.offsetHeight + 12 : 54,
      bottom: $("controls").offsetHeight + 58,
      sides: narrow ? 34 : 60,
    };
    this.camera.refit();
    this.axes.reserved = [...heading.children, $("presets"), $("controls")].map((element) => {
      const { left, top, width, height } = element.getBoundingClientRect();
      return [left + width / 2, top + height / 2, width / 2, height / 2];
    });
    this.invalidate();
  }

  connect() {
    $("play").addEventListener("click", () => this.toggle());
    $("play").disabled = this.recording.times.length < 2;
    $("scrubber").addEventListener("input", (event) => {
      this.pause();
      this.seek(this.recording.times[Number(event.target.value)]);
    });
    $("colour").addEventListener("change", (event) => this.colourBy(event.target.value));
    $("trails").addEventListener("change", (event) => {
      for (const tube of this.trailTubes) tube.visible = event.target.checked;
      this.invalidate();
    });
    this.connectView();
  }

  connectView() {
    for (const button of document.querySelectorAll("[data-preset]")) {
      button.addEventListener("click", () => this.camera.show(button.dataset.preset));
    }
    document.addEventListener("keydown", (event) => this.press(event));
    new ResizeObserver(() => this.layOut()).observe(this.canvas);
    const recolour = () => {
      this.theme = readTheme();
      this.invalidate();
    };
    DARK.addEventListener("change", recolour);
    window.addEventListener("hashchange", recolour);
    // A browser with many views open may take the graphics away and give them back.
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => {
      this.renderer = this.newRenderer();
      this.invalidate();
    });
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { tagName, type } = event.target;
    if (tagName === "SELECT") return;
    const onButton = tagName === "BUTTON" || tagName === "SUMMARY" || type === "checkbox";
    if (event.key === " " && onButton) return;
    const action = this.actionsOf(event)[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  actionsOf(event) {
    const frames = event.shiftKey ? 10 : 1;
    return {
      ...this.viewActions(),
      " ": () => this.toggle(),
      ArrowLeft: () => this.stepFrames(-frames),
      ArrowRight: () => this.stepFrames(frames),
      ArrowUp: () => this.changeSpeed(1),
      ArrowDown: () => this.changeSpeed(-1),
      Home: () => this.seek(0),
      End: () => this.seek(this.recording.duration),
    };
  }

  viewActions() {
    const presets = ["free", "front", "side", "top"];
    return {
      ...Object.fromEntries(presets.map((name, k) => [k + 1, () => this.camera.show(name)])),
      "+": () => this.camera.zoom(0.9),
      "=": () => this.camera.zoom(0.9),
      "-": () => this.camera.zoom(1 / 0.9),
      a: () => this.camera.turn(0.1, 0),
      d: () => this.camera.turn(-0.1, 0),
      w: () => this.camera.turn(0, 0.1),
      s: () => this.camera.turn(0, -0.1),
    };
  }
}
