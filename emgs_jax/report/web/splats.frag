#version 300 es
// Opacity falls off as exp(-d²/2); blended over what is farther away.
precision highp float;
uniform float opacity; // at the centre
uniform float radius; // standard deviations
in vec2 offset;
flat in vec4 color;
out vec4 pixel;

void main() {
  float distanceSq = dot(offset, offset);
  if (distanceSq > radius * radius) discard;
  float alpha = min(color.a * opacity * exp(-0.5 * distanceSq), 0.999);
  pixel = vec4(color.rgb * alpha, alpha);
}
