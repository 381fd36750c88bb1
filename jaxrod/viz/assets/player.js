// The page: fills the scene for a moment in time, and connects the controls.

const $ = (id) => document.getElementById(id);
const TRAIL_NODES = 40;

class Player {
  constructor(recording) {
    this.recording = recording;
    this.time = 0;
    this.playing = false;
    this.canvas = $("view");
    this.invalidate = this.invalidate.bind(this);
    this.tubes = new Tubes();
    this.camera = new Camera(this.canvas, recording.up, this.invalidate);
    this.axes = new Axes(recording.box, this.camera, this.tubes, $("labels"));
    this.furnish();
    this.theme = readTheme();
    const many = recording.rods * (recording.nodes - 1) > 2500;
    this.sharpness = many ? { along: 2, around: 10 } : { along: 5, around: 28 };
    this.renderer = new Renderer(this.canvas, this.tubes, this.sharpness);
    this.writeLegend();
    this.readouts = recording.readouts.map((readout) => new Readout(readout, recording));
    this.connect();
    this.layOut();
    this.seek(0);
  }

  // Makes the tubes: rods, obstacles, and a trail behind every tip and moving sphere.
  furnish() {
    const { rods, nodes, spheres, cylinders, radii, series } = this.recording;
    this.rodTubes = [];
    this.trailTubes = [];
    const trail = (point, radius, colour) => {
      const look = { trail: true, point, radius: 0.35 * radius, colour: linearColour(colour) };
      this.trailTubes.push(this.tubes.add(TRAIL_NODES, look));
    };
    for (let rod = 0; rod < rods; rod++) {
      const colour = rodColour(rod, rods);
      const look = { colour: linearColour(colour), shadow: true, rings: true };
      this.rodTubes.push(this.tubes.add(nodes, look));
      if (rods <= 64) trail((rod + 1) * nodes - 1, radii[(rod + 1) * nodes - 1], colour);
    }
    this.balls = spheres.map(({ radius }, k) => {
      const colour = SPHERES[k % SPHERES.length];
      trail(series / 3 - spheres.length + k, radius, colour);
      return { radius, colour: linearColour(colour), centre: [0, 0, 0] };
    });
    const fixed = cylinders.map((cylinder) => {
      const look = { colour: linearColour(CYLINDERS), shadow: true };
      return [cylinder, this.tubes.add(2, look)];
    });
    this.tubes.allocate();
    for (const [{ start, end, radius }, tube] of fixed) {
      this.tubes.setLine(tube, start, end, radius);
    }
  }

  pose() {
    const { recording, tubes } = this;
    const { nodes, radii, spheres, series } = recording;
    const [frame, fraction] = recording.locate(this.time);
    this.rodTubes.forEach((tube, rod) => {
      for (let node = 0; node < nodes; node++) {
        const k = rod * nodes + node;
        const at = (axis) => recording.at(3 * k + axis, frame, fraction);
        tubes.setNode(tube, node, at(0), at(1), at(2), radii[k]);
      }
      tubes.close(tube);
    });
    this.balls.forEach((ball, k) => {
      ball.centre = recording.point(series / 3 - spheres.length + k, frame, fraction);
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
      floor: this.axes.floor(), balls: this.balls, theme: this.theme,
      steepest: this.steepest || 0,
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
    for (const tube of this.rodTubes) tube.curved = curved;
    this.writeLegend();
    this.layOut();
  }

  writeLegend() {
    const { rods, rodNames, spheres, cylinders, title } = this.recording;
    $("title").textContent = title;
    const entries = [];
    if (this.steepest) {
      entries.push([`linear-gradient(90deg, ${RAMP})`, `curvature 0 – ${this.steepest.toPrecision(2)} /m`, "ramp"]);
    } else if (rodNames.length && rods <= RODS.length) {
      rodNames.forEach((name, rod) => entries.push([rodColour(rod, rods), name]));
    } else if (rods > 1) {
      const ends = Array.from({ length: 6 }, (_, k) => rodColour(Math.round((k * (rods - 1)) / 5), rods));
      entries.push([`linear-gradient(90deg, ${ends})`, `${rods} rods`, "ramp"]);
    } else entries.push([rodColour(0, 1), "rod"]);
    spheres.forEach(({ name }, k) => entries.push([SPHERES[k % SPHERES.length], name]));
    const obstacles = new Map();
    for (const { name } of cylinders) obstacles.set(name, (obstacles.get(name) || 0) + 1);
    for (const [name, count] of obstacles) {
      entries.push([CYLINDERS, count > 1 ? `${name} × ${count}` : name]);
    }
    $("legend").replaceChildren(...entries.map(([fill, text, kind]) => {
      const item = document.createElement("li");
      const swatch = item.appendChild(document.createElement("i"));
      swatch.style.background = fill;
      if (kind) swatch.className = kind;
      item.append(text);
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
    this.axes.reserved = [heading, $("presets"), $("controls")].map((element) => {
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
    for (const button of document.querySelectorAll("[data-preset]")) {
      button.addEventListener("click", () => this.camera.show(button.dataset.preset));
    }
    document.addEventListener("keydown", (event) => this.press(event));
    new ResizeObserver(() => this.layOut()).observe(this.canvas);
    const scheme = window.matchMedia("(prefers-color-scheme: dark)");
    scheme.addEventListener("change", () => {
      this.theme = readTheme();
      this.invalidate();
    });
    // A browser with many views open may take the graphics away and give them back.
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => {
      this.renderer = new Renderer(this.canvas, this.tubes, this.sharpness);
      this.invalidate();
    });
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { tagName, type } = event.target;
    if (tagName === "SELECT") return;
    const onButton = tagName === "BUTTON" || tagName === "SUMMARY" || type === "checkbox";
    if (event.key === " " && onButton) return;
    const frames = event.shiftKey ? 10 : 1;
    const presets = ["free", "front", "side", "top"];
    const actions = {
      " ": () => this.toggle(),
      ArrowLeft: () => this.stepFrames(-frames),
      ArrowRight: () => this.stepFrames(frames),
      ArrowUp: () => this.changeSpeed(1),
      ArrowDown: () => this.changeSpeed(-1),
      Home: () => this.seek(0),
      End: () => this.seek(this.recording.duration),
      "+": () => this.camera.zoom(0.9),
      "=": () => this.camera.zoom(0.9),
      "-": () => this.camera.zoom(1 / 0.9),
      a: () => this.camera.turn(0.1, 0),
      d: () => this.camera.turn(-0.1, 0),
      w: () => this.camera.turn(0, 0.1),
      s: () => this.camera.turn(0, -0.1),
    };
    presets.forEach((name, k) => (actions[k + 1] = () => this.camera.show(name)));
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }
}

async function main() {
  try {
    const header = JSON.parse($("header").textContent);
    const recording = await unpackRecording(header, $("data").textContent);
    const player = new Player(recording);
    if (header.autoplay && !player.camera.still) player.play();
  } catch (error) {
    $("message").textContent = error.message;
    $("message").hidden = false;
    throw error;
  }
}

main();
