// Unpacks the recorded motion and interpolates it in time.

async function unpackRecording(header, base64) {
  const packed = Uint8Array.from(atob(base64.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();

  const { frames, nodes } = header;
  const total = nodes.reduce((sum, count) => sum + count, 0);
  let offset = 0;
  const floats = (count) => {
    const part = new Float32Array(buffer, offset, count);
    offset += 4 * count;
    return part;
  };
  const times = floats(frames);
  const radii = floats(total);
  const readouts = header.readouts.map((name) => ({ name, values: floats(frames) }));
  const meshes = header.meshes.map((mesh) => ({ ...mesh, vertices: floats(6 * mesh.corners) }));

  const count = (list) => list.reduce((sum, part) => sum + part.count, 0);
  const widths = [[header.points, 3], [count(meshes), 4], [count(header.arrows), 3]];
  const scale = widths.flatMap(([number, width], k) =>
    Array.from({ length: number * width }, (_, s) =>
      [header.scales[k].low[s % width], header.scales[k].step[s % width]]));
  const series = scale.length;
  const low = new Uint8Array(buffer, offset, series * frames);
  const high = new Uint8Array(buffer, offset + series * frames, series * frames);
  const positions = new Float32Array(series * frames);
  for (let s = 0, k = 0; s < series; s++) {
    const [least, step] = scale[s];
    let level = 0;
    for (let frame = 0; frame < frames; frame++, k++) {
      const zigzag = low[k] | (high[k] << 8);
      level = (level + ((zigzag >>> 1) ^ -(zigzag & 1))) & 65535;
      positions[frame * series + s] = least + step * level;
    }
  }
  offset += 2 * series * frames;
  const fields = header.fields.map((field) => {
    const changes = new Uint8Array(buffer, offset, total * frames);
    offset += total * frames;
    const levels = new Uint8Array(total * frames);
    for (let node = 0, k = 0; node < total; node++) {
      let level = 0;
      for (let frame = 0; frame < frames; frame++, k++) {
        level = (level + changes[k]) & 255;
        levels[frame * total + node] = level;
      }
    }
    return { ...field, levels };
  });
  return new Recording({ ...header, times, radii, readouts, meshes, fields, positions, series, total });
}

class Recording {
  constructor(parts) {
    Object.assign(this, parts);
    this.duration = this.times[this.times.length - 1];
    // Where each rod's nodes begin; then spheres, bodies and arrows among the points.
    let next = 0;
    this.firsts = this.nodes.map((count) => (next += count) - count);
    this.firstSphere = next;
    this.firstBody = next + this.spheres.length;
    const bodies = this.meshes.reduce((sum, { count }) => sum + count, 0);
    this.firstArrow = this.firstBody + bodies;
    this.turnsAt = 3 * this.points;
    this.arrowsAt = this.turnsAt + 4 * bodies;
  }

  // The last frame at or before a time, and how far towards the next the time is.
  locate(time) {
    const { times } = this;
    let first = 0;
    let last = times.length - 1;
    while (last - first > 1) {
      const middle = (first + last) >> 1;
      if (times[middle] <= time) first = middle;
      else last = middle;
    }
    if (times.length === 1) return [0, 0];
    const fraction = (time - times[first]) / (times[first + 1] - times[first]);
    return [first, clamp(fraction, 0, 1)];
  }

  // The frame nearest to a time.
  frameAt(time) {
    const [frame, fraction] = this.locate(time);
    return fraction > 0.5 ? frame + 1 : frame;
  }

  // Coordinate number `coordinate` of the flattened points, at a located time.
  at(coordinate, frame, fraction) {
    const k = frame * this.series + coordinate;
    const now = this.positions[k];
    return fraction === 0 ? now : mix(now, this.positions[k + this.series], fraction);
  }

  point(index, frame, fraction) {
    return [0, 1, 2].map((axis) => this.at(3 * index + axis, frame, fraction));
  }

  // Unit quaternion (w, x, y, z) of a body.
  turn(body, frame, fraction) {
    const at = this.turnsAt + 4 * body;
    const parts = [0, 1, 2, 3].map((k) => this.at(at + k, frame, fraction));
    const size = Math.hypot(...parts) || 1;
    return parts.map((part) => part / size);
  }

  // An arrow from its origin [m].
  arrow(index, frame, fraction) {
    return [0, 1, 2].map((axis) => this.at(this.arrowsAt + 3 * index + axis, frame, fraction));
  }

  // Level of a field at a node, 0 to 1, or -1 where there is none.
  level(field, node, frame, fraction) {
    const k = frame * this.total + node;
    const now = field.levels[k];
    if (now === 255) return -1;
    const next = fraction === 0 ? now : field.levels[k + this.total];
    return mix(now, next === 255 ? now : next, fraction) / 254;
  }

  // The curvature [1/m] that 98 % of the inner nodes stay below, for the colour scale.
  curvatureScale() {
    const { nodes, times, total } = this;
    const stride = Math.max(1, Math.floor((times.length * total) / 20000));
    const found = [];
    let count = 0;
    for (let frame = 0; frame < times.length; frame++) {
      nodes.forEach((number, rod) => {
        for (let node = 1; node < number - 1; node++) {
          if (count++ % stride) continue;
          const [a, b, c] = [-1, 0, 1].map((d) => this.point(this.firsts[rod] + node + d, frame, 0));
          const [e, f] = [subtract(b, a), subtract(c, b)];
          const sides = length(e) * length(f) * length(subtract(c, a));
          found.push(sides ? (2 * length(cross(e, f))) / sides : 0);
        }
      });
    }
    found.sort((a, b) => a - b);
    return Math.max(found[Math.floor(found.length * 0.98)] || 0, 1e-6);
  }
}
