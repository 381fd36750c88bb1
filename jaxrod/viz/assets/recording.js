// Unpacks the recorded motion and interpolates it in time.

async function unpackRecording(header, base64) {
  const packed = Uint8Array.from(atob(base64.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();

  const { frames, rods, nodes } = header;
  const numPoints = rods * nodes + header.spheres.length;
  let offset = 0;
  const floats = (count) => {
    const part = new Float32Array(buffer, offset, count);
    offset += 4 * count;
    return part;
  };
  const times = floats(frames);
  const radii = floats(rods * nodes);
  const readouts = header.readouts.map((name) => ({ name, values: floats(frames) }));

  const series = numPoints * 3;
  const low = new Uint8Array(buffer, offset, series * frames);
  const high = new Uint8Array(buffer, offset + series * frames, series * frames);
  const positions = new Float32Array(series * frames);
  for (let s = 0, k = 0; s < series; s++) {
    let level = 0;
    for (let frame = 0; frame < frames; frame++, k++) {
      const zigzag = low[k] | (high[k] << 8);
      level = (level + ((zigzag >>> 1) ^ -(zigzag & 1))) & 65535;
      positions[frame * series + s] = header.low[s % 3] + header.step[s % 3] * level;
    }
  }
  return new Recording(header, times, radii, readouts, positions, series);
}

class Recording {
  constructor(header, times, radii, readouts, positions, series) {
    Object.assign(this, header, { times, radii, readouts, positions, series });
    this.duration = times[times.length - 1];
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

  // The curvature [1/m] that 98 % of the inner nodes stay below, for the colour scale.
  curvatureScale() {
    const { rods, nodes, times } = this;
    const stride = Math.max(1, Math.floor((times.length * rods * nodes) / 20000));
    const found = [];
    let count = 0;
    for (let frame = 0; frame < times.length; frame++) {
      for (let rod = 0; rod < rods; rod++) {
        for (let node = 1; node < nodes - 1; node++) {
          if (count++ % stride) continue;
          const [a, b, c] = [-1, 0, 1].map((d) => this.point(rod * nodes + node + d, frame, 0));
          const [e, f] = [subtract(b, a), subtract(c, b)];
          const sides = length(e) * length(f) * length(subtract(c, a));
          found.push(sides ? (2 * length(cross(e, f))) / sides : 0);
        }
      }
    }
    found.sort((a, b) => a - b);
    return Math.max(found[Math.floor(found.length * 0.98)] || 0, 1e-6);
  }
}
