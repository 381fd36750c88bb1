// Draws tubes, balls and the floor with WebGL2. It knows nothing of time or rods.

const NODE_FLOATS = 5; // x, y, z [m], radius [m], level of a field [1]

class Renderer {
  constructor(canvas, tubes, bodies, sharpness) {
    this.detail = sharpness.detail ?? 1; // of the pixels of the view, along each side
    const gl = canvas.getContext("webgl2", { antialias: this.detail === 1, stencil: true });
    if (!gl) throw new Error("This browser does not offer WebGL2, which the 3-D view needs.");
    this.canvas = canvas;
    this.gl = gl;
    this.tubes = tubes;
    this.programs = {
      tube: this.program(TUBE_VERTEX, TUBE_FRAGMENT),
      trail: this.program(TUBE_VERTEX, TRAIL_FRAGMENT),
      ball: this.program(BALL_VERTEX, SOLID_FRAGMENT),
      body: this.program(BODY_VERTEX, SOLID_FRAGMENT),
      floor: this.program(FLOOR_VERTEX, FLOOR_FRAGMENT),
    };
    this.tube = this.mesh(...tubeMesh(sharpness.along, sharpness.around), 4);
    this.ball = this.mesh(...ballMesh(24, 36), 3);
    this.floor = this.mesh([-1, -1, 1, -1, -1, 1, 1, 1], [0, 1, 2, 2, 1, 3], 2);
    this.bodies = bodies.map((body) => ({ ...body, array: this.soup(body.vertices) }));
    this.nodes = gl.createBuffer();
    gl.bindVertexArray(this.tube.array);
    for (let k = 1; k <= 6; k++) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribDivisor(k, 1);
    }
    gl.bindVertexArray(null);
  }

  program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw new Error(`The 3-D view could not start: ${gl.getShaderInfoLog(shader)}`);
      }
    }
    gl.linkProgram(program);
    const places = {};
    const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
    for (let k = 0; k < count; k++) {
      const { name } = gl.getActiveUniform(program, k);
      places[name.replace("[0]", "")] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  mesh(vertices, indices, components) {
    const { gl } = this;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, components, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint16Array(indices), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { array, count: indices.length };
  }

  // Triangles that share no corners: place and normal of each corner.
  soup(vertices) {
    const { gl } = this;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW);
    for (const k of [0, 1]) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 24, 12 * k);
    }
    gl.bindVertexArray(null);
    return array;
  }

  use({ program, places }, values) {
    const { gl } = this;
    gl.useProgram(program);
    this.places = places;
    for (const [name, value] of Object.entries(values)) this.set(name, value);
  }

  // Sets a uniform by its name; the number of components follows from the value.
  set(name, value) {
    const { gl } = this;
    const place = this.places[name];
    if (!place) return;
    if (name === "flat_shading") gl.uniform1i(place, value);
    else if (name === "ramp") gl.uniform3fv(place, value);
    else if (typeof value === "number") gl.uniform1f(place, value);
    else if (value.length === 16) gl.uniformMatrix4fv(place, false, value);
    else gl[`uniform${value.length}fv`](place, value);
  }

  resize() {
    const ratio = this.detail * Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    this.gl.viewport(0, 0, width, height);
  }

  draw({ camera, eye, up, lamp, floor, balls, poses, theme, ramp, steepest, measured }) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.nodes);
    gl.bufferData(gl.ARRAY_BUFFER, this.tubes.values, gl.DYNAMIC_DRAW);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.DEPTH_TEST);

    this.use(this.programs.floor, { camera, colour: theme.grid, ...floor });
    gl.bindVertexArray(this.floor.array);
    gl.drawElements(gl.TRIANGLES, this.floor.count, gl.UNSIGNED_SHORT, 0);

    // Shadows: everything pressed onto the floor; the stencil paints each pixel once.
    const scene = { camera, eye, up, lamp };
    const shadow = {
      ...scene, flatten: [1, floor.height], colour: theme.shadow,
      fade: [theme.shadowStrength, 0], flat_shading: 1, steepest: 0, measured: 0, rings: 0,
    };
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    const casting = this.tubes.list.filter((t) => t.shadow && t.visible);
    this.drawTubes(this.programs.tube, shadow, casting, () => {});
    this.drawBalls(shadow, balls, false);
    this.drawBodies(shadow, poses, false);
    gl.disable(gl.STENCIL_TEST);

    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    const solid = { ...scene, flatten: [0, 0], fade: [1, 0], flat_shading: 0 };
    const solids = this.tubes.list.filter((t) => !t.trail && t.visible);
    this.drawTubes(this.programs.tube, { ...solid, ramp }, solids, (tube) => {
      this.set("colour", tube.colour || theme[tube.themeColour]);
      this.set("flat_shading", tube.line ? 1 : 0);
      this.set("fade", [tube.line ? 0.55 : 1, 0]);
      this.set("rings", tube.rings ? theme.rings : 0);
      this.set("steepest", tube.rod ? steepest : 0);
      this.set("measured", tube.rod && measured ? 1 : 0);
    });
    this.drawBalls(solid, balls, true);
    gl.disable(gl.CULL_FACE); // a plane has two sides
    this.drawBodies(solid, poses, true);
    gl.enable(gl.CULL_FACE);

    gl.depthMask(false);
    const trails = this.tubes.list.filter((t) => t.trail && t.visible);
    this.drawTubes(this.programs.trail, { ...scene, flatten: [0, 0] }, trails, (tube) => {
      this.set("colour", tube.colour);
      this.set("strength", theme.trail);
      this.set("thickest", tube.radius);
    });
    gl.depthMask(true);
  }

  drawTubes(program, shared, tubes, prepare) {
    const { gl } = this;
    this.use(program, shared);
    gl.bindVertexArray(this.tube.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.nodes);
    const stride = 4 * NODE_FLOATS;
    for (const tube of tubes) {
      prepare(tube);
      for (let k = 0; k < 4; k++) {
        gl.vertexAttribPointer(1 + k, 4, gl.FLOAT, false, stride, (tube.first + k) * stride);
      }
      for (const k of [1, 2]) {
        const at = (tube.first + k) * stride + 16;
        gl.vertexAttribPointer(4 + k, 1, gl.FLOAT, false, stride, at);
      }
      const segments = tube.count - 1;
      gl.drawElementsInstanced(gl.TRIANGLES, this.tube.count, gl.UNSIGNED_SHORT, 0, segments);
    }
  }

  drawBalls(shared, balls, coloured) {
    const { gl } = this;
    this.use(this.programs.ball, shared);
    gl.bindVertexArray(this.ball.array);
    for (const ball of balls) {
      this.set("ball", [...ball.centre, ball.radius]);
      if (coloured) this.set("colour", ball.colour);
      gl.drawElements(gl.TRIANGLES, this.ball.count, gl.UNSIGNED_SHORT, 0);
    }
  }

  drawBodies(shared, poses, coloured) {
    const { gl } = this;
    this.use(this.programs.body, shared);
    this.bodies.forEach(({ array, corners, colour }, k) => {
      gl.bindVertexArray(array);
      if (coloured) this.set("colour", colour);
      for (const { origin, turn } of poses[k]) {
        this.set("origin", origin);
        this.set("turn", turn);
        gl.drawArrays(gl.TRIANGLES, 0, corners);
      }
    });
  }
}

// All tubes in one array. Each keeps a ghost node before its first and after its last
// node, which carry the tangent and the curvature on at the ends.
class Tubes {
  constructor() {
    this.list = [];
    this.size = 0;
    this.values = new Float32Array(0);
  }

  add(count, look) {
    const tube = { first: this.size, count, visible: true, ...look };
    this.size += count + 2;
    this.list.push(tube);
    return tube;
  }

  allocate() {
    this.values = new Float32Array(this.size * NODE_FLOATS);
  }

  setNode(tube, index, x, y, z, radius, level = -1) {
    const k = (tube.first + 1 + index) * NODE_FLOATS;
    this.values[k] = x;
    this.values[k + 1] = y;
    this.values[k + 2] = z;
    this.values[k + 3] = radius;
    this.values[k + 4] = level;
  }

  close(tube) {
    const { values } = this;
    const ends = [[tube.first, 1], [tube.first + tube.count + 1, -1]];
    for (const [ghost, direction] of ends) {
      const at = (k, axis) => values[(ghost + direction * k) * NODE_FLOATS + axis];
      for (let axis = 0; axis < 3; axis++) {
        values[ghost * NODE_FLOATS + axis] =
          tube.count > 2
            ? 3 * at(1, axis) - 3 * at(2, axis) + at(3, axis)
            : 2 * at(1, axis) - at(2, axis);
      }
    }
  }

  // An arrow of four nodes; hidden where it has no length.
  setArrow(tube, start, way, thickness) {
    const size = length(way);
    tube.visible = size > 0;
    const head = Math.min(5 * thickness, 0.6 * size);
    const neck = 1 - head / (size || 1);
    const nodes = [[0, 1], [neck - 1e-3, 1], [neck, 2.4], [1, 0.02]];
    nodes.forEach(([share, radius], k) => {
      this.setNode(tube, k, ...add(start, scale(way, share)), radius * thickness);
    });
    this.close(tube);
  }

  setLine(tube, start, end, radius) {
    this.setNode(tube, 0, ...start, radius);
    this.setNode(tube, 1, ...end, radius);
    this.close(tube);
  }
}

function tubeMesh(along, around) {
  const vertices = [];
  const indices = [];
  for (let i = 0; i <= along; i++) {
    for (let j = 0; j <= around; j++) vertices.push(i / along, j / around, 1, 0);
  }
  const row = around + 1;
  for (let i = 0; i < along; i++) {
    for (let j = 0; j < around; j++) {
      const k = i * row + j;
      indices.push(k, k + 1, k + row, k + 1, k + row + 1, k + row);
    }
  }
  for (const [u, side] of [[0, -1], [1, 1]]) {
    const middle = vertices.length / 4;
    vertices.push(u, 0, 0, side);
    for (let j = 0; j <= around; j++) vertices.push(u, j / around, 1, side);
    for (let j = 0; j < around; j++) {
      const pair = [middle + 1 + j, middle + 2 + j];
      indices.push(middle, ...(side > 0 ? pair : pair.reverse()));
    }
  }
  return [vertices, indices];
}

function ballMesh(rows, columns) {
  const vertices = [];
  const indices = [];
  for (let i = 0; i <= rows; i++) {
    for (let j = 0; j <= columns; j++) {
      const [polar, around] = [(Math.PI * i) / rows, (2 * Math.PI * j) / columns];
      const across = Math.sin(polar);
      vertices.push(across * Math.cos(around), across * Math.sin(around), Math.cos(polar));
    }
  }
  const row = columns + 1;
  for (let i = 0; i < rows; i++) {
    for (let j = 0; j < columns; j++) {
      const k = i * row + j;
      indices.push(k, k + row, k + 1, k + 1, k + row, k + row + 1);
    }
  }
  return [vertices, indices];
}
