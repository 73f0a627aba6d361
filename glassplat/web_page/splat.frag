// Blended back to front. Of the masks, each pane's glass takes from its own only, and what is in front from all.
precision highp float;
in vec2 along;
flat in vec4 shade;
flat in float channel;
flat in int owner;
layout(location = 0) out vec4 color;
MASK_OUTPUTS

float alpha;

vec4 maskOf(int pane) {
  return owner == 0 || owner == pane + 1 ? vec4(channel * alpha, 0.0, 0.0, alpha) : vec4(0.0);
}

void main() {
  alpha = min(shade.a * exp(-0.5 * dot(along, along)), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  color = owner == 0 ? vec4(shade.rgb * alpha, alpha) : vec4(0.0);
  WRITE_MASKS
}
