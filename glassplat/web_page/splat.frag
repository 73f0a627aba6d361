// Blended back to front. The channel is of glass how much it is part of a pane, and mirrored how much of it reflects.
in vec2 along;
flat in vec4 shade;
flat in float channel;
flat in vec3 normal;
#if COLORED
layout(location = 0) out vec4 color;
#endif
#if CHANNELED
layout(location = COLORED) out vec4 sum;
#endif

#ifdef SHINY
layout(location = 2) out vec4 normals;
#endif

void main() {
  float alpha = min(shade.a * exp(-0.5 * dot(along, along)), 0.99);
  if (alpha < 1.0 / 255.0) discard;
#if COLORED
  color = vec4(shade.rgb * alpha, alpha);
#endif
#if CHANNELED
  sum = vec4(channel * alpha, 0.0, 0.0, alpha);
#endif
#ifdef SHINY
  normals = vec4(normal * alpha, alpha);
#endif
}
