#version 300 es
// One Gaussian as a quad that holds its ellipse on the image: emgs_jax/render/project.py in GLSL.
precision highp float;
precision highp int;
uniform sampler2D means; // RGB32F, m
uniform sampler2D covs; // RGB32F, two texels each: xx xy xz, yy yz zz
uniform sampler2D colors; // RGBA8; alpha: a factor on the opacity, 0 is not drawn
uniform mat3 rotation; // world -> camera
uniform vec3 position; // of the camera, m
uniform vec2 focal; // pixels
uniform vec2 center; // pixels, centres of pixels at integers
uniform vec2 size; // of the image, pixels
uniform float covScale; // m² of the unit of `covs`, times the drawing's own factor
uniform float blur; // pixels²
uniform float radius; // standard deviations
in vec2 corner; // -1 or 1
in uint row;
out vec2 offset; // from the centre, in standard deviations
flat out vec4 color;

const float NEAREST = 1e-3; // m
const float NEAREST_STD = 2.0; // what reaches the plane of the camera is not drawn
const float MARGIN = 0.3; // of the size: farther out the Jacobian is that of the margin

vec4 texel(sampler2D image, uint index) {
  uint width = uint(textureSize(image, 0).x);
  return texelFetch(image, ivec2(int(index % width), int(index / width)), 0);
}

void main() {
  color = texel(colors, row);
  vec3 point = rotation * (texel(means, row).xyz - position);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside
  if (point.z <= NEAREST || color.a == 0.0) return;

  vec2 mean = focal * point.xy / point.z + center;
  vec2 tangent = (clamp(mean, -MARGIN * size, (1.0 + MARGIN) * size) - center) / focal;
  vec2 scale = focal / point.z;
  vec3 a = texel(covs, 2u * row).xyz;
  vec3 b = texel(covs, 2u * row + 1u).xyz;
  mat3 cov = covScale * mat3(a.x, a.y, a.z, a.y, b.x, b.y, a.z, b.y, b.z);
  mat3 seen = rotation * cov * transpose(rotation);
  if (point.z <= NEAREST_STD * sqrt(seen[2].z)) return;
  vec3 jx = vec3(scale.x, 0.0, -scale.x * tangent.x);
  vec3 jy = vec3(0.0, scale.y, -scale.y * tangent.y);
  float xx = dot(jx, seen * jx) + blur;
  float xy = dot(jx, seen * jy);
  float yy = dot(jy, seen * jy) + blur;

  // Axes of the ellipse: the quad is no larger than it must be.
  float middle = 0.5 * (xx + yy);
  float spread = length(vec2(0.5 * (xx - yy), xy));
  float large = middle + spread;
  float small = max(middle - spread, 1e-6);
  vec2 axis = abs(xy) > 1e-9 * large ? normalize(vec2(large - yy, xy)) : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  offset = radius * corner;
  vec2 pixel = mean + offset.x * sqrt(large) * axis + offset.y * sqrt(small) * vec2(-axis.y, axis.x);
  gl_Position = vec4(2.0 * (pixel.x + 0.5) / size.x - 1.0, 1.0 - 2.0 * (pixel.y + 0.5) / size.y, 0.0, 1.0);
}
