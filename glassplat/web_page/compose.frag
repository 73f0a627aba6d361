// Lays the panes before the image, from the farthest on each ray to the nearest: Eq. 1 of TR-Gaussians for each, or for
// the nearest alone.
precision highp sampler2DArray;

uniform sampler2D image;
#if PANES > 0
uniform sampler2DArray masks, reflections, gains;  // masks: of all, then of each
uniform vec3 centers[PANES], normals[PANES], tangents[PANES], bitangents[PANES];  // in the camera
uniform vec2 halfSizes[PANES];
uniform float reflectances[PANES];
uniform vec3 transmittances[PANES];
uniform int present[PANES];  // 0: not; 1: in the mask of all; 2: and in its own
#endif
#ifdef SHINY
uniform sampler2D strengths, normals;
uniform samplerCube surroundings;
uniform mat3 camFromWorld;
#endif
uniform vec4 intrinsics;
uniform vec2 size, used, usedByMirrors;  // of the canvas; what part of the textures is drawn
uniform vec3 background;
uniform ivec2 layers;        // left and right of the divider
uniform float divider;
uniform int law;
uniform bool linearLight, gained, nearestOnly;
out vec4 shown;

const float FAR = 1e30, BEHIND = 1.00001, FAINT = 0.5;

vec2 within(vec2 part) { return min(gl_FragCoord.xy / size * part, part - 0.5 / vec2(textureSize(image, 0))); }

vec3 decoded(vec3 c) {
  if (!linearLight) return c;
  return mix(c / 12.92, pow((max(c, 0.04045) + 0.055) / 1.055, vec3(2.4)), vec3(greaterThan(c, vec3(0.04045))));
}

vec3 encoded(vec3 c) {
  if (!linearLight) return c;
  return mix(c * 12.92, 1.055 * pow(max(c, 0.0031308), vec3(1.0 / 2.4)) - 0.055, vec3(greaterThan(c, vec3(0.0031308))));
}

float strengthOf(float base, float cosine) {
  cosine = clamp(cosine, 1e-6, 1.0);
  if (law == 2) return base;
  if (law == 1) return base + (1.0 - base) * pow(1.0 - cosine, 5.0);
  float one = sqrt(base / (2.0 - base)), q = (1.0 - one) / (1.0 + one);
  float inside = sqrt(1.0 - q * q * (1.0 - cosine * cosine));
  float across = (q * cosine - inside) / (q * cosine + inside), along = (cosine - q * inside) / (cosine + q * inside);
  across *= across;
  along *= along;
  return across / (1.0 + across) + along / (1.0 + along);
}

#if PANES > 0
float depthOf(int k, vec3 ray) {
  float depth = dot(centers[k], normals[k]) / dot(ray, normals[k]);
  vec3 offset = depth * ray - centers[k];
  bool inside = depth > 0.0 && abs(dot(offset, tangents[k])) <= halfSizes[k].x && abs(dot(offset, bitangents[k])) <= halfSizes[k].y;
  return inside && present[k] > 0 ? depth : FAR;
}

float maskOf(int layer) { return texture(masks, vec3(within(usedByMirrors), float(layer))).r; }

// A faint pane adds to what those behind it mirror, as in kernels/panes; another one takes their place.
void layPane(int k, float mask, vec3 ray, inout vec3 seen, inout vec4 mirror) {
  if (mask <= 0.0) return;
  vec2 there = within(usedByMirrors);
  vec4 reflected = texture(reflections, vec3(there, float(k)));
  vec3 color = reflected.rgb + (1.0 - reflected.a) * background;
  float gain = gained ? texture(gains, vec3(there, float(k))).r + 1.0 - reflected.a : 1.0;
  vec3 light = decoded(color) * gain;
  float strength = strengthOf(reflectances[k], abs(dot(normalize(ray), normals[k]))) * mask;
  vec3 through = decoded(seen) * (1.0 - mask * (1.0 - transmittances[k]));
  seen = encoded(mix(through, light, strength));
  mirror = vec4(light, 1.0) * strength + (mask < FAINT ? 1.0 - strength : 0.0) * mirror;
}
#endif

// mirror: light that is added, and the share of light that it replaces.
vec3 layerOf(int layer, vec3 seen, vec3 behind, vec4 mirror, float mask) {
  if (layer == 1) return behind;
  if (layer == 2) return encoded(mirror.rgb / max(mirror.a, 1e-9)) * mask;
  if (layer == 3) return vec3(mirror.a);
  return seen;
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  vec2 at = within(used);
  vec4 base = texture(image, at);
  vec3 behind = base.rgb + (1.0 - base.a) * background, seen = behind;
  vec4 mirror = vec4(0.0);
  float mask = 1.0;
#if PANES > 0
  vec3 ray = vec3((pixel - intrinsics.zw) / intrinsics.xy, 1.0);
  mask = maskOf(0);
  float depths[PANES];
  int met = 0;
  for (int k = 0; k < PANES; k++) {
    depths[k] = depthOf(k, ray);
    if (depths[k] < FAR) met++;
  }
  for (int n = 0; n < PANES; n++) {
    int farthest = -1;
    float depth = 0.0;
    for (int k = 0; k < PANES; k++) {
      if (depths[k] < FAR && depths[k] > depth) { farthest = k; depth = depths[k]; }
    }
    if (farthest < 0) break;
    for (int k = 0; k < PANES; k++) if (k == farthest) depths[k] = FAR;
    // Panes in one plane are one surface, as in kernels/panes.
    bool same = false;
    for (int k = 0; k < PANES; k++) same = same || (depths[k] < FAR && depths[k] * BEHIND >= depth);
    if (same) { met--; continue; }
    if (nearestOnly) { seen = behind; mirror = vec4(0.0); }
    // The mask of all panes does not fade where two adjoin.
    bool isAlone = nearestOnly || met == 1 || present[farthest] < 2;
    layPane(farthest, isAlone ? mask : maskOf(farthest + 1), ray, seen, mirror);
  }
#endif
#ifdef SHINY
  // 3DGS-DR, Eq. 3.
  vec3 ray = normalize(vec3((pixel - intrinsics.zw) / intrinsics.xy, 1.0)) * camFromWorld, normal = texture(normals, at).xyz;
  vec3 light = texture(surroundings, reflect(ray, normal / max(length(normal), 1e-6))).rgb;
  float strength = texture(strengths, at).r;
  if (strength >= 1.0 / 512.0) mirror = vec4(light, 1.0) * strength;
  seen = mix(behind, light, mirror.a);
#endif
  int layer = pixel.x < divider ? layers.x : layers.y;
  shown = vec4(clamp(layerOf(layer, seen, behind, mirror, mask), 0.0, 1.0), 1.0);
}
