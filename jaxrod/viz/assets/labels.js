// The floor, the three measured edges of the box, and their numbers in metres.

class Axes {
  constructor(box, floor, camera, tubes, element) {
    this.camera = camera;
    this.tubes = tubes;
    this.element = element;
    this.spans = [];
    this.reserved = []; // where other text is: middle x, y, half width, half height [pixels]
    const size = length(subtract(box[1], box[0]));
    this.step = roundStep(size / 10);
    this.ranges = [camera.first, camera.second, camera.up].map((axis, k) => {
      // Whole steps around the box; sticking out by less than a third of a step
      // is let pass.
      const low = Math.floor(dot(box[0], axis) / this.step + 0.3);
      const high = Math.ceil(dot(box[1], axis) / this.step - 0.3);
      const flat = high <= low;
      return [flat && k < 2 ? low - 1 : low, flat ? low + 1 : high].map((n) => n * this.step);
    });
    // The ground is where it is, or below everything.
    if (floor !== null) this.ranges[2][0] = floor;
    this.height = this.ranges[2][0];
    this.thickness = 0.0016 * size;
    const [low, high] = [0, 1].map((side) => this.place(...this.ranges.map((r) => r[side])));
    camera.frameBox(low, high);
    this.names = camera.axisNames;
    this.lines = this.names.map((name) => tubes.add(2, { line: true, themeColour: name }));
  }

  place(a, b, c) {
    const { first, second, up } = this.camera;
    return add(add(scale(first, a), scale(second, b)), scale(up, c));
  }

  floor() {
    const [a, b] = this.ranges;
    const centre = this.place((a[0] + a[1]) / 2, (b[0] + b[1]) / 2, this.height);
    const reach = 1.9 * Math.hypot(a[1] - a[0], b[1] - b[0]);
    const leading = Math.round(this.step / 10 ** Math.floor(Math.log10(this.step) + 1e-9));
    const fine = this.step / (leading === 2 ? 4 : 5);
    const { first, second } = this.camera;
    return { centre, reach, first, second, spacing: [fine, this.step], height: this.height };
  }

  // Chooses the edges nearest the reader, moves the three lines there and writes the
  // numbers beside them.
  update(view) {
    const [a, b, c] = this.ranges;
    const { eye, matrix, width, height, backward } = view;
    const { first, second, up } = this.camera;
    const nearA = dot(eye, first) > (a[0] + a[1]) / 2 ? 1 : 0;
    const nearB = dot(eye, second) > (b[0] + b[1]) / 2 ? 1 : 0;
    const screen = (point) => project(matrix, point, width, height);
    const corners = [[0, 0], [0, 1], [1, 0], [1, 1]];
    const left = corners
      .map((corner) => ({ corner, spot: screen(this.place(a[corner[0]], b[corner[1]], c[0])) }))
      .filter(({ spot }) => spot)
      .sort((p, q) => p.spot[0] - q.spot[0])[0];
    const corner = left ? left.corner : [0, 0];
    const along = [
      (u) => this.place(u, b[nearB], c[0]),
      (u) => this.place(a[nearA], u, c[0]),
      (u) => this.place(a[corner[0]], b[corner[1]], u),
    ];
    const outward = [
      scale(second, nearB ? 1 : -1),
      scale(first, nearA ? 1 : -1),
      scale(view.right, -1),
    ];
    const steep = dot(backward, up);
    this.taken = [...this.reserved];
    this.used = 0;
    for (const axis of [2, 0, 1]) {
      const [low, high] = this.ranges[axis];
      this.tubes.setLine(this.lines[axis], along[axis](low), along[axis](high), this.thickness);
      const direction = [first, second, up][axis];
      // An axis that points at the reader has no readable numbers.
      const readable = Math.abs(dot(direction, backward)) < 0.97;
      this.lines[axis].visible = readable || axis < 2;
      if (!readable) continue;
      const beside = (point, pixels) => {
        const spot = screen(point);
        const aside = screen(add(point, scale(outward[axis], 0.02 * this.step)));
        if (!spot || !aside) return null;
        let [dx, dy] = [aside[0] - spot[0], aside[1] - spot[1]];
        if (axis < 2 && Math.abs(steep) < 0.12) [dx, dy] = [0, 1];
        const norm = Math.hypot(dx, dy) || 1;
        return [spot[0] + (pixels * dx) / norm, spot[1] + (pixels * dy) / norm];
      };
      const top = axis === 2 && screen(along[2](high));
      const title = top ? [top[0], top[1] - 16] : beside(along[axis]((low + high) / 2), 40);
      this.write(`${this.names[axis]} [m]`, title, "axis", axis);
      const digits = Math.max(0, -Math.floor(Math.log10(this.step) + 1e-9));
      const start = Math.ceil(low / this.step - 1e-6);
      for (let k = start; k * this.step <= high + 1e-6 * this.step; k++) {
        const text = (k * this.step).toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1");
        this.write(text.replace("-", "−"), beside(along[axis](k * this.step), 16), "", axis);
      }
    }
    for (let k = this.used; k < this.spans.length; k++) this.spans[k].hidden = true;
  }

  write(text, spot, kind, axis) {
    if (!spot) return;
    const half = [4 + 3.2 * text.length, 8];
    const clash = ([x, y, w, h]) => Math.abs(x - spot[0]) < w + half[0] && Math.abs(y - spot[1]) < h + half[1];
    if (this.taken.some(clash)) return;
    this.taken.push([...spot, ...half]);
    let span = this.spans[this.used];
    if (!span) {
      span = this.element.appendChild(document.createElement("span"));
      this.spans.push(span);
    }
    this.used++;
    span.hidden = false;
    span.className = kind;
    span.style.color = kind ? `var(--${this.names[axis]})` : "";
    if (span.textContent !== text) span.textContent = text;
    span.style.transform = `translate(${spot[0].toFixed(1)}px, ${spot[1].toFixed(1)}px) translate(-50%, -50%)`;
  }
}
