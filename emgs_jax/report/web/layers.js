// What a Gaussian's colour says: its own colour, class, similarity to a class, feature, normal, and how sure it is.
"use strict";

// Turbo (A. Mikhailov, 2019) as polynomials; share in [0, 1] to RGB in [0, 255].
function turbo(share) {
  const x = Math.min(Math.max(share, 0), 1), v = [1, x, x * x, x ** 3, x ** 4, x ** 5];
  const of = (c) => 255 * Math.min(Math.max(c.reduce((sum, k, i) => sum + k * v[i], 0), 0), 1);
  return [of([0.1357, 4.6154, -42.6603, 132.1311, -152.9424, 59.2864]),
          of([0.0914, 2.1942, 4.8430, -14.1850, 4.2773, 2.8296]),
          of([0.1067, 12.6419, -60.5820, 110.3628, -89.9031, 27.3482])];
}

// By the scale of a layer: the number that is shown, and its text in the legend.
const SCALES = {
  share: { of: (value) => value / 255, text: (v) => v.toFixed(2) },
  count: { of: (value) => Math.log10(1 + value), text: (v) => (10 ** v - 1).toFixed(0) },
  number: { of: (value) => value, text: (v) => v.toFixed(0) },
};

class Layers {
  constructor(arrays) {
    this.arrays = arrays;
    this.count = arrays.mean.length / 3;
    this.numClasses = ABOUT.classes.length;
  }

  // [low, high] of what a layer shows, without the outermost hundredths; null where it has no scale.
  range(name, word) {
    const values = this.values(name, word);
    if (!values) return null;
    const sorted = Float32Array.from(values).sort();
    const at = (share) => sorted[Math.round(share * (sorted.length - 1))] || 0;
    const [low, high] = [at(0.01), at(0.99)];
    return high > low ? [low, high] : [low, low + 1];
  }

  values(name, word) {
    const { array, scale } = ABOUT.layers[name], values = this.arrays[array], { count, numClasses } = this;
    if (!scale) return null;
    const at = name === "similarity" ? (row) => values[row * numClasses + word] : (row) => values[row];
    return Float32Array.from({ length: count }, (_, row) => SCALES[scale].of(at(row)));
  }

  // RGBA of a set's rows, Gaussians or splats. word: number of a class, -1 = all. threshold: of a similarity, as a
  // share of its range.
  paint(set, name, word, threshold, minExistence) {
    const { arrays } = this, count = set.mean.length / 3, width = set.color.length / count;
    const out = new Uint8Array(4 * count);
    const range = this.range(name, word), values = this.values(name, word);
    for (let at = 0; at < count; at++) {
      const own = set.color.subarray(width * at, width * at + 3), row = set.owner ? set.owner[at] : at;
      let color = own;
      if (name === "class") {
        const label = arrays.label[row];
        color = label < 0 ? ABOUT.noClass : ABOUT.classColors[label];
        if (word >= 0 && label !== word) color = faded(own);
      } else if (name === "feature") {
        color = arrays.feature.subarray(3 * row, 3 * row + 3);
      } else if (name === "normal") {
        color = [0, 1, 2].map((k) => 127.5 + set.normal[3 * at + k]);
      } else if (values) {
        const share = (values[row] - range[0]) / (range[1] - range[0]);
        color = name === "similarity" && share < threshold ? faded(own) : turbo(share);
      }
      const opacity = width === 4 ? set.color[4 * at + 3] : 255;
      out.set([color[0], color[1], color[2], arrays.existence[row] >= 255 * minExistence ? opacity : 0], 4 * at);
    }
    return out;
  }
}

// Grey and dark, so that what is asked for stands out.
function faded(color) {
  const grey = 0.25 * (0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]) + 22;
  return [grey, grey, grey + 6];
}
