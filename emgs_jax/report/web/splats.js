// The map in WebGL2: a quad for each Gaussian, sorted far to near on this side, blended by the graphics card.
"use strict";

const CORNERS = new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]);
const TEXTURE_WIDTH = 1024;
const NUM_BUCKETS = 1 << 16;

class SplatRenderer {
  // Throws where there is no WebGL2. `background`: RGB in [0, 1].
  constructor(canvas, set, background) {
    this.canvas = canvas;
    this.background = background;
    this.textures = [];
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL2");
    this.gl = gl;
    this.program = this.link(...["vertex", "fragment"].map((id) => document.getElementById(id).textContent));
    gl.useProgram(this.program);
    ["means", "covs", "colors"].forEach((name, unit) => gl.uniform1i(this.place(name), unit));
    this.attribute("corner", CORNERS, (at) => gl.vertexAttribPointer(at, 2, gl.FLOAT, false, 0, 0));
    this.rows = this.attribute("row", new Uint32Array(1), (at) => {
      gl.vertexAttribIPointer(at, 1, gl.UNSIGNED_INT, 0, 0);
      gl.vertexAttribDivisor(at, 1);
    });
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.load(set);
  }

  // Draw this set, one of `readSets`, from now on, in white until it is recoloured.
  load(set) {
    const gl = this.gl;
    this.textures.forEach(({ texture }) => gl.deleteTexture(texture));
    this.set = set;
    this.means = set.mean;
    this.count = set.mean.length / 3;
    this.colors = new Uint8Array(4 * this.count).fill(255);
    this.textures = [
      this.texture(gl.RGB32F, gl.RGB, gl.FLOAT, set.mean, 3, Float32Array),
      this.texture(gl.RGB32F, gl.RGB, gl.FLOAT, set.cov, 3, Float32Array),
      this.texture(gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, this.colors, 4, Uint8Array),
    ];
    this.order = new Uint32Array(this.count);
    this.depths = new Float32Array(this.count);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.rows);
    gl.bufferData(gl.ARRAY_BUFFER, this.order, gl.DYNAMIC_DRAW);
  }

  link(vertex, fragment) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text.trim());
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  place(name) {
    return this.gl.getUniformLocation(this.program, name);
  }

  attribute(name, values, describe) {
    const gl = this.gl;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    const at = gl.getAttribLocation(this.program, name);
    gl.enableVertexAttribArray(at);
    describe(at);
    return buffer;
  }

  texture(internal, format, type, values, channels, Kind) {
    const gl = this.gl;
    const height = Math.max(1, Math.ceil(values.length / channels / TEXTURE_WIDTH));
    const filled = new Kind(TEXTURE_WIDTH * height * channels);
    filled.set(values);
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, TEXTURE_WIDTH, height, 0, format, type, filled);
    for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl["TEXTURE_" + name], gl.NEAREST);
    return { texture, height, internal, format, type, channels, Kind };
  }

  // RGBA of every Gaussian; alpha 0 hides it.
  recolor(colors) {
    const gl = this.gl, { texture, height } = this.textures[2];
    this.colors = colors;
    const filled = new Uint8Array(4 * TEXTURE_WIDTH * height);
    filled.set(colors);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, height, gl.RGBA, gl.UNSIGNED_BYTE, filled);
  }

  // Rows of what is in front of the camera, farthest first (a counting sort), every `step`-th; returns how many.
  sort(view, isSeen, step) {
    const { means, colors, depths, order, count } = this;
    const [x, y, z] = view.ahead, start = dot(view.ahead, view.position);
    let far = 0;
    for (let row = 0; row < count; row++) {
      let depth = means[3 * row] * x + means[3 * row + 1] * y + means[3 * row + 2] * z - start;
      if (depth <= 1e-3 || row % step || colors[4 * row + 3] === 0 || (isSeen && !isSeen(row))) depth = -1;
      depths[row] = depth;
      if (depth > far) far = depth;
    }
    const starts = new Uint32Array(NUM_BUCKETS + 1), share = (NUM_BUCKETS - 1) / (far || 1);
    for (let row = 0; row < count; row++) if (depths[row] > 0) starts[NUM_BUCKETS - ((depths[row] * share) | 0)]++;
    for (let bucket = 1; bucket <= NUM_BUCKETS; bucket++) starts[bucket] += starts[bucket - 1];
    // Of equally far ones the first in the map is the nearest, as in our own renderer.
    for (let row = 0; row < count; row++)
      if (depths[row] > 0) order[--starts[NUM_BUCKETS - ((depths[row] * share) | 0)]] = row;
    return depths.reduce((number, depth) => number + (depth > 0), 0);
  }

  // lens: focal [fx, fy] and center [cx, cy] in pixels of the canvas. isSeen(row): false leaves a Gaussian out.
  // step: only every step-th is drawn, as much larger.
  draw(view, lens, isSeen, step = 1) {
    const gl = this.gl, { width, height } = this.canvas, { render } = this.set;
    const number = this.sort(view, isSeen, step);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.rows);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, this.order, 0, number);
    this.textures.forEach(({ texture }, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    const { right, down, ahead } = view; // columns of the matrix as WebGL wants it
    const columns = [0, 1, 2].flatMap((k) => [right[k], down[k], ahead[k]]);
    gl.uniformMatrix3fv(this.place("rotation"), false, columns);
    gl.uniform3fv(this.place("position"), view.position);
    gl.uniform2fv(this.place("focal"), lens.focal);
    gl.uniform2fv(this.place("center"), lens.center);
    gl.uniform2f(this.place("size"), width, height);
    gl.uniform1f(this.place("covScale"), ABOUT.covUnit * step);
    for (const name of ["blur", "radius", "opacity"]) gl.uniform1f(this.place(name), render[name]);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, number);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits, so that time can be taken
  }
}
