// One tube program draws rods, cylinders, arrows, axes, trails and shadows; one draws
// spheres, one bodies of triangles, one the floor.

// What is lit how: a sky and a floor glow, a lamp over the reader's left shoulder, a
// soft rim. Colours are linear until the last line; alpha is premultiplied.
const LIGHTING = `
uniform vec3 eye, up, lamp;
vec4 lit(vec3 base, vec3 place, vec3 normal, float alpha) {
  vec3 n = normalize(normal), view = normalize(eye - place);
  float sky = 0.5 + 0.5 * dot(n, up);
  float key = max(dot(n, lamp), 0.0);
  float gloss = pow(max(dot(n, normalize(lamp + view)), 0.0), 42.0);
  float rim = pow(1.0 - max(dot(n, view), 0.0), 3.0);
  vec3 light = mix(vec3(0.22, 0.23, 0.27), vec3(0.50, 0.53, 0.58), sky) + 0.72 * key;
  vec3 shade = base * light + 0.26 * gloss + 0.14 * rim * sky;
  return vec4(pow(min(shade, 1.0), vec3(1.0 / 2.2)) * alpha, alpha);
}`;

const TUBE_VERTEX = `#version 300 es
precision highp float;
// Along the segment 0..1, angle 0..1, distance from the centre line in radii, and
// -1 or 1 on the end discs.
layout(location = 0) in vec4 grid;
// The segment runs from p1 to p2; xyz [m] and radius [m].
layout(location = 1) in vec4 p0;
layout(location = 2) in vec4 p1;
layout(location = 3) in vec4 p2;
layout(location = 4) in vec4 p3;
// Level of a field at either end, 0 to 1, below zero where there is none.
layout(location = 5) in float level1;
layout(location = 6) in float level2;
uniform mat4 camera;
uniform vec3 up;
uniform vec2 flatten;        // 1 and the floor's height for shadows, else 0
out vec3 place, normal;
out float along, extent, radius, bend, disc, level;

float curvature(vec3 a, vec3 b, vec3 c) {
  vec3 e = b - a, f = c - b;
  float sides = length(e) * length(f) * length(c - a);
  return sides > 0.0 ? 2.0 * length(cross(e, f)) / sides : 0.0;
}

void main() {
  float u = grid.x;
  // Catmull-Rom: through the nodes, with a continuous tangent.
  vec3 a = p1.xyz, b = 0.5 * (p2.xyz - p0.xyz);
  vec3 c = p0.xyz - 2.5 * p1.xyz + 2.0 * p2.xyz - 0.5 * p3.xyz;
  vec3 d = 1.5 * (p1.xyz - p2.xyz) + 0.5 * (p3.xyz - p0.xyz);
  vec3 centre = a + u * (b + u * (c + u * d));
  vec3 tangent = b + u * (2.0 * c + 3.0 * u * d);
  vec3 chord = p2.xyz - p1.xyz;
  tangent = dot(tangent, tangent) > 1e-20 ? normalize(tangent) : up;
  // A circle looks the same from every angle, so any frame that both ends of the
  // segment share will do.
  vec3 size = abs(chord);
  vec3 aside = size.x <= size.y && size.x <= size.z ? vec3(1, 0, 0)
             : size.y <= size.z ? vec3(0, 1, 0) : vec3(0, 0, 1);
  vec3 first = normalize(cross(tangent, aside)), second = cross(tangent, first);
  float angle = 6.28318530718 * grid.y;
  vec3 outward = cos(angle) * first + sin(angle) * second;
  radius = mix(p1.w, p2.w, u);
  place = centre + radius * grid.z * outward;
  normal = grid.w == 0.0 ? outward : grid.w * tangent;
  along = u;
  level = mix(level1, level2, u);
  disc = abs(grid.w);
  extent = length(chord);
  bend = mix(curvature(p0.xyz, p1.xyz, p2.xyz), curvature(p1.xyz, p2.xyz, p3.xyz), u);
  place -= flatten.x * up * (dot(place, up) - flatten.y);
  gl_Position = camera * vec4(place, 1.0);
}`;

const TUBE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 place, normal;
in float along, extent, radius, bend, level;
uniform vec3 colour;
uniform vec2 fade;           // alpha = fade.x + fade.y * (position along the tube)
uniform float rings, steepest, measured;
uniform vec3 ramp[5];
uniform int flat_shading;
${LIGHTING}
out vec4 result;
void main() {
  if (flat_shading == 1) { result = vec4(pow(colour, vec3(1.0 / 2.2)) * fade.x, fade.x); return; }
  vec3 base = colour;
  float share = steepest > 0.0 ? bend / steepest : measured > 0.0 ? level : -1.0;
  if (share >= 0.0) {
    float stop = 4.0 * min(share, 1.0);
    int k = min(int(stop), 3);
    base = mix(ramp[k], ramp[k + 1], stop - float(k));
  }
  // A thin line where two elements meet.
  float edge = min(along, 1.0 - along) * extent;
  float width = 0.035 * radius, soft = max(fwidth(edge), 1e-7);
  float line = 1.0 - smoothstep(width - 0.5 * soft, width + soft, edge);
  base *= 1.0 - rings * line * smoothstep(0.3, 0.8, extent / radius);
  result = lit(base, place, gl_FrontFacing ? normal : -normal, fade.x);
}`;

const TRAIL_FRAGMENT = `#version 300 es
precision highp float;
in float radius, disc;
uniform vec3 colour;
uniform float strength, thickest;
out vec4 result;
void main() {
  if (disc > 0.0) discard;   // the discs between segments would show through
  float alpha = strength * radius / thickest;
  result = vec4(pow(colour, vec3(1.0 / 2.2)) * alpha, alpha);
}`;

const BALL_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 direction;
uniform vec4 ball;
uniform mat4 camera;
uniform vec3 up;
uniform vec2 flatten;
out vec3 place, normal;
void main() {
  normal = direction;
  place = ball.xyz + ball.w * direction;
  place -= flatten.x * up * (dot(place, up) - flatten.y);
  gl_Position = camera * vec4(place, 1.0);
}`;

// A body: its corners turned by a quaternion (w, x, y, z) and moved.
const BODY_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 corner;
layout(location = 1) in vec3 outward;
uniform vec3 origin;
uniform vec4 turn;
uniform mat4 camera;
uniform vec3 up;
uniform vec2 flatten;
out vec3 place, normal;
vec3 turned(vec3 v) {
  vec3 t = 2.0 * cross(turn.yzw, v);
  return v + turn.x * t + cross(turn.yzw, t);
}
void main() {
  normal = turned(outward);
  place = origin + turned(corner);
  place -= flatten.x * up * (dot(place, up) - flatten.y);
  gl_Position = camera * vec4(place, 1.0);
}`;

const SOLID_FRAGMENT = `#version 300 es
precision highp float;
in vec3 place, normal;
uniform vec3 colour;
uniform vec2 fade;
uniform int flat_shading;
${LIGHTING}
out vec4 result;
void main() {
  if (flat_shading == 1) { result = vec4(pow(colour, vec3(1.0 / 2.2)) * fade.x, fade.x); return; }
  result = lit(colour, place, gl_FrontFacing ? normal : -normal, fade.x);
}`;

const FLOOR_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec2 corner;
uniform mat4 camera;
uniform vec3 centre, first, second;
uniform float reach;
out vec2 spot;
out vec2 offset;
void main() {
  offset = corner;
  vec3 place = centre + reach * (corner.x * first + corner.y * second);
  spot = vec2(dot(place, first), dot(place, second));
  gl_Position = camera * vec4(place, 1.0);
}`;

const FLOOR_FRAGMENT = `#version 300 es
precision highp float;
in vec2 spot, offset;
uniform vec3 colour;
uniform vec2 spacing;        // fine and coarse [m]
out vec4 result;
float lines(float step, float thickness) {
  vec2 cell = spot / step, width = fwidth(cell);
  vec2 away = abs(fract(cell - 0.5) - 0.5) / max(width, 1e-6);
  vec2 cover = 1.0 - smoothstep(vec2(thickness - 0.5), vec2(thickness + 0.5), away);
  cover *= 1.0 - smoothstep(vec2(0.2), vec2(0.6), width);
  return max(cover.x, cover.y);
}
void main() {
  float haze = 1.0 - smoothstep(0.35, 1.0, length(offset));
  float alpha = max(0.20 * lines(spacing.x, 0.5), 0.46 * lines(spacing.y, 0.7));
  alpha = max(alpha, 0.03) * haze;
  result = vec4(pow(colour, vec3(1.0 / 2.2)) * alpha, alpha);
}`;
