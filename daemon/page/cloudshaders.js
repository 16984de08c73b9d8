/** The shaders of the 3-D view, GLSL ES 3.00. */

/** A vertex is a pixel of a depth image: its ray, scaled by its depth, in the frame of the mount. */
export const POINTS_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D depth_image;
uniform sampler2D rays;
uniform sampler2D color_image;
uniform sampler2D turbo;
uniform ivec2 grid;            // pixels that are drawn, in each direction
uniform float unit_m;
uniform mat4 pose;             // of the depth camera on the mount
uniform mat4 view_projection;
uniform float pixel_size;      // what a point at 1 m covers at 1 m, pixels of the screen
uniform float behind;          // what brings a point a little behind others at its distance
uniform vec2 range;            // near and far, metres
uniform bool is_clipped;
uniform int paint;             // 0 colour, 1 distance, 2 camera
uniform vec3 tint;
uniform bool is_stale;

uniform bool has_color;
uniform mat4 to_color;         // from the depth camera to the colour camera
uniform vec4 pinhole;          // fx fy cx cy of the full colour image
uniform vec2 color_size;       // pixels of the full colour image
uniform int model;
uniform float k[8];
uniform float max_radius;

out vec3 color;

vec2 distort(vec2 p) {
  if (model == 0) return p;
  float r2 = dot(p, p);
  if (model == 3) {
    float r = sqrt(r2);
    float theta = atan(r);
    float t2 = theta * theta;
    return r > 1e-6 ? p * (theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r) : p;
  }
  float s = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])));
  vec2 t = model == 2 ? p * s : p;
  return p * s + vec2(2.0 * k[2] * t.x * t.y + k[3] * (r2 + 2.0 * t.x * t.x),
                      k[2] * (r2 + 2.0 * t.y * t.y) + 2.0 * k[3] * t.x * t.y);
}

vec3 by_distance(float z) {
  float x = (1.0 / z - 1.0 / range.y) / (1.0 / range.x - 1.0 / range.y);
  return textureLod(turbo, vec2(clamp(x, 0.0, 1.0) * 255.0 / 256.0 + 0.5 / 256.0, 0.5), 0.0).rgb;
}

// Grey where the colour camera does not look.
const vec3 UNSEEN = vec3(0.5);

vec3 by_camera(vec3 point, float z) {
  vec3 seen = (to_color * vec4(point, 1.0)).xyz;
  vec2 p = seen.xy / seen.z;
  if (has_color && seen.z > 0.0 && length(p) <= max_radius) {
    // Pixel centres are at whole numbers, those of textures between them.
    vec2 at = (pinhole.xy * distort(p) + pinhole.zw + 0.5) / color_size;
    if (all(greaterThanEqual(at, vec2(0.0))) && all(lessThanEqual(at, vec2(1.0)))) {
      return textureLod(color_image, at, 0.0).rgb;
    }
    return UNSEEN;
  }
  return has_color ? UNSEEN : by_distance(z);
}

void main() {
  ivec2 size = textureSize(depth_image, 0);
  ivec2 cell = ivec2(gl_VertexID % grid.x, gl_VertexID / grid.x);
  ivec2 texel = ivec2((vec2(cell) + 0.5) * vec2(size) / vec2(grid));
  float z = float(texelFetch(depth_image, texel, 0).r) * unit_m;
  vec2 ray = texelFetch(rays, texel, 0).rg;
  bool is_hole = z == 0.0 || abs(ray.x) > 1e8 || (is_clipped && (z < range.x || z > range.y));
  if (is_hole) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = 1.0;
    color = vec3(0.0);
    return;
  }
  vec3 point = vec3(ray, 1.0) * z;
  gl_Position = view_projection * (pose * vec4(point, 1.0));
  gl_PointSize = clamp(1.4 * pixel_size * z / gl_Position.w, 1.0, 9.0);
  if (paint == 1) {
    color = by_distance(z);
  } else {
    color = by_camera(point, z);
    // Another camera may show the same surface in its colour.
    gl_Position.z += color == UNSEEN ? behind : 0.0;
    if (paint == 2) {
      color = tint * (0.45 + 0.55 * dot(color, vec3(0.299, 0.587, 0.114)));
    }
  }
  if (is_stale) {
    color = vec3(0.1 + 0.25 * dot(color, vec3(0.299, 0.587, 0.114)));
  }
}
`;

export const LINES_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 position;
uniform mat4 view_projection;
uniform vec3 line_color;
out vec3 color;

void main() {
  gl_Position = view_projection * vec4(position, 1.0);
  color = line_color;
}
`;

export const FRAGMENT = `#version 300 es
precision mediump float;
in vec3 color;
out vec4 shown;

void main() {
  shown = vec4(color, 1.0);
}
`;
