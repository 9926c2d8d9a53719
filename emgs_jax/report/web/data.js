// What the page was given: settings as JSON, numbers as one block of bytes.
"use strict";

const ABOUT = JSON.parse(document.getElementById("about").textContent);
const KINDS = { float32: Float32Array, float16: Uint16Array, uint8: Uint8Array, int8: Int8Array,
                uint16: Uint16Array, int16: Int16Array, int32: Int32Array }; // float16: its bits

// The arrays of one block, by name.
async function readArrays(id, arrays) {
  const text = document.getElementById(id).textContent;
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = new Uint8Array(await new Response(stream).arrayBuffer());
  return Object.fromEntries(arrays.map((about) => [about.name, unpack(buffer, about)]));
}

// Bytes lie by column, the first bytes of all numbers before their second ones; rows of numbers come back.
function unpack(buffer, { type, rows, columns, offset }) {
  const count = rows * columns;
  const width = KINDS[type].BYTES_PER_ELEMENT;
  const out = new Uint8Array(count * width);
  for (let byte = 0; byte < width; byte++)
    for (let column = 0; column < columns; column++)
      for (let row = 0; row < rows; row++)
        out[(row * columns + column) * width + byte] = buffer[offset + byte * count + column * rows + row];
  const numbers = new KINDS[type](out.buffer);
  return type === "float16" ? Float32Array.from(numbers, half) : numbers;
}

function half(bits) {
  const exponent = (bits >> 10) & 31, share = bits & 1023, sign = bits >> 15 ? -1 : 1;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + share / 1024) : 2 ** -14 * (share / 1024));
}

// What is drawn: the Gaussians of the map, and the splats that were fitted to the images; null where there are none.
// A splat's `owner` is the row of the Gaussian whose class, feature and certainty it has.
async function readSets() {
  const about = ABOUT.splats;
  const gaussians = { ...await readArrays("arrays", ABOUT.arrays), render: ABOUT.render };
  if (!about || !ABOUT.owners.length) return { gaussians, splats: null };
  const splats = { ...await readArrays("splats", about.arrays), render: about.render };
  splats.mean = Float32Array.from(splats.mean, (value, at) => about.low[at % 3] + value * about.step[at % 3]);
  splats.owner = (await readArrays("owners", ABOUT.owners)).owner;
  return { gaussians, splats };
}
