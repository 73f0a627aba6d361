// Projects the splats of an order into one camera: one texel each, read by splat.vert. The formulas are those of kernels/project.
uniform usampler2D places;   // x, y, z as floats; colour and opacity as bytes
uniform usampler2D shapes;   // rotation, scales and the value of a channel
uniform usampler2D harmonics, order;
uniform int count, firstGlass, degree, harmonicTexels;
uniform mat3 camFromWorld;
uniform vec3 offset, eye;
uniform vec4 intrinsics;     // fx, fy, cx, cy
uniform vec2 size;
uniform vec4 bounds;         // left, top, right, bottom of what is wanted, pixels
uniform vec4 clipPlane;      // keeps where clipPlane . (x, 1) > 0
uniform float near;
uniform vec2 channelRange;   // lowest value and step of the primary splats' channel, a logarithm
uniform float faintest;     // coverage below this is left out
uniform bool mirrored, shiny;

layout(location = 0) out uvec4 place;
layout(location = 1) out uvec4 look;

const float LOW_PASS = 0.3, MARGIN = 0.15;

mat3 rotationOf(uint packed) {
  vec4 q = vec4(0.0);
  uint largest = packed >> 30u, rest = packed;
  for (int i = 3; i >= 0; i--) {
    if (uint(i) == largest) continue;
    float magnitude = float(rest & 511u) * (0.70710678 / 511.0);
    q[i] = (rest & 512u) != 0u ? -magnitude : magnitude;
    rest >>= 10u;
  }
  q[largest] = sqrt(max(0.0, 1.0 - dot(q, q)));
  float x = q.x, y = q.y, z = q.z, w = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

int shortest(vec3 s) { return s.x <= s.y && s.x <= s.z ? 0 : s.y <= s.z ? 1 : 2; }

// A unit vector on an octahedron.
uint octahedral(vec3 n) {
  n /= abs(n.x) + abs(n.y) + abs(n.z);
  vec2 signs = vec2(n.x < 0.0 ? -1.0 : 1.0, n.y < 0.0 ? -1.0 : 1.0);
  return packSnorm2x16(n.z < 0.0 ? (1.0 - abs(n.yx)) * signs : n.xy);
}

uvec4 stored[3];

// Byte n of the harmonics of a splat, as a coefficient.
float coefficient(int n) {
  return float((stored[n / 16][(n / 4) & 3] >> uint((n & 3) * 8)) & 255u) / 128.0 - 1.0;
}

vec3 band(int k) { return vec3(coefficient(3 * k), coefficient(3 * k + 1), coefficient(3 * k + 2)); }

vec3 viewDependent(int index, vec3 d) {
  for (int t = 0; t < 3; t++) if (t < harmonicTexels) stored[t] = texelFetch(harmonics, texel(index * harmonicTexels + t), 0);
  float x = d.x, y = d.y, z = d.z;
  vec3 sum = -0.48860251 * y * band(0) + 0.48860251 * z * band(1) - 0.48860251 * x * band(2);
  if (degree < 2) return sum;
  float xx = x * x, yy = y * y, zz = z * z;
  sum += 1.09254843 * x * y * band(3) - 1.09254843 * y * z * band(4)
    + 0.31539157 * (2.0 * zz - xx - yy) * band(5) - 1.09254843 * x * z * band(6)
    + 0.54627422 * (xx - yy) * band(7);
  if (degree < 3) return sum;
  return sum - 0.59004359 * y * (3.0 * xx - yy) * band(8) + 2.89061144 * x * y * z * band(9)
    - 0.45704580 * y * (4.0 * zz - xx - yy) * band(10)
    + 0.37317633 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * band(11)
    - 0.45704580 * x * (4.0 * zz - xx - yy) * band(12) + 1.44530572 * z * (xx - yy) * band(13)
    - 0.59004359 * x * (xx - 3.0 * yy) * band(14);
}

void main() {
  place = uvec4(0u);
  look = uvec4(0u);
  int slot = int(gl_FragCoord.y) * ROW + int(gl_FragCoord.x);
  if (slot >= count) return;
  int index = int(texelFetch(order, texel(slot), 0).x);
  uvec4 described = texelFetch(places, texel(index), 0);
  vec3 mean = uintBitsToFloat(described.xyz);
  vec4 color = bytesOf(described.w) / 255.0;
  vec3 inCamera = camFromWorld * mean + offset;
  bool isGlass = index >= firstGlass;
  if (inCamera.z <= near || color.a <= faintest || (mirrored && isGlass)) return;
  if (dot(clipPlane, vec4(mean, 1.0)) <= 0.0) return;

  uvec2 shape = texelFetch(shapes, texel(index), 0).xy;
  vec4 scaleBytes = bytesOf(shape.y);
  mat3 rotation = rotationOf(shape.x);
  vec3 scales = exp(scaleBytes.xyz / 16.0 - 10.0);
  mat3 axes = transpose(camFromWorld * mat3(rotation[0] * scales.x, rotation[1] * scales.y, rotation[2] * scales.z));
  // The shortest axis of a shiny splat, turned to the camera.
  vec3 normal = rotation[shortest(scaleBytes.xyz)];
  normal *= dot(normal, mean - eye) > 0.0 ? -1.0 : 1.0;
  vec2 tangents = inCamera.xy / inCamera.z;
  vec2 margin = MARGIN * size;
  vec2 held = clamp(tangents, -(intrinsics.zw + margin) / intrinsics.xy, (size - intrinsics.zw + margin) / intrinsics.xy);
  vec3 vx = intrinsics.x / inCamera.z * (axes[0] - held.x * axes[2]);
  vec3 vy = intrinsics.y / inCamera.z * (axes[1] - held.y * axes[2]);
  float xx = dot(vx, vx), xy = dot(vx, vy), yy = dot(vy, vy);
  vec3 spread = cross(vx, vy);
  float determinant = dot(spread, spread) + LOW_PASS * (xx + yy) + LOW_PASS * LOW_PASS;
  xx += LOW_PASS;
  yy += LOW_PASS;

  float reach = sqrt(2.0 * log(color.a / faintest));
  vec2 center = tangents * intrinsics.xy + intrinsics.zw;
  vec2 extent = reach * sqrt(vec2(xx, yy));
  if (any(lessThan(center + extent, bounds.xy)) || any(greaterThan(center - extent, bounds.zw))) return;

  float half_ = 0.5 * (xx - yy), larger = 0.5 * (xx + yy) + sqrt(half_ * half_ + xy * xy);
  vec2 along = abs(xy) < 1e-6 ? (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0)) : normalize(vec2(xy, larger - xx));
  vec2 major = sqrt(larger) * along, minor = sqrt(determinant / larger) * vec2(-along.y, along.x);

  float channel = scaleBytes.w / 255.0;
  vec3 seen = vec3(0.0);
  if (!isGlass) {
    seen = 0.5 + 0.28209479 * (color.rgb - 0.5) / 0.15;
    if (degree > 0) seen += viewDependent(index, normalize(mean - eye));
    if (!shiny) channel = mirrored ? exp(channelRange.x + channelRange.y * scaleBytes.w) : 0.0;
  }
  seen = max(seen, 0.0);
  place = uvec4(floatBitsToUint(center), packHalf2x16(major), packHalf2x16(minor));
  look = uvec4(packHalf2x16(seen.rg), packHalf2x16(vec2(seen.b, color.a)), packHalf2x16(vec2(channel, reach)), shiny ? octahedral(normal) : 0u);
}
