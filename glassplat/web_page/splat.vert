// One rectangle per splat, four vertices each, as project.frag has put them in order.
uniform usampler2D projected, looks;
uniform vec2 size;
out vec2 along;
flat out vec4 shade;    // colour and opacity
flat out float channel;
flat out vec3 normal;   // of shiny splats

vec3 unpacked(uint n) {
  vec2 at = unpackSnorm2x16(n);
  vec3 found = vec3(at, 1.0 - abs(at.x) - abs(at.y));
  float beyond = max(-found.z, 0.0);
  found.xy += vec2(found.x < 0.0 ? beyond : -beyond, found.y < 0.0 ? beyond : -beyond);
  return normalize(found);
}

void main() {
  ivec2 slot = texel(gl_VertexID >> 2);
  uvec4 place = texelFetch(projected, slot, 0);
  uvec4 look = texelFetch(looks, slot, 0);
  vec2 more = unpackHalf2x16(look.z);
  along = (vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0) * more.y;
  shade = vec4(unpackHalf2x16(look.x), unpackHalf2x16(look.y));
  channel = more.x;
  normal = unpacked(look.w);
  vec2 pixel = uintBitsToFloat(place.xy) + along.x * unpackHalf2x16(place.z) + along.y * unpackHalf2x16(place.w);
  vec2 onScreen = 2.0 * pixel / size - 1.0;
  gl_Position = more.y > 0.0 ? vec4(onScreen.x, -onScreen.y, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}
