// What the page was given: settings as JSON, numbers as one block of bytes.
"use strict";

const ABOUT = JSON.parse(document.getElementById("about").textContent);
const KINDS = { float32: Float32Array, float16: Uint16Array, uint8: Uint8Array, int8: Int8Array,
                uint16: Uint16Array, int16: Int16Array, int32: Int32Array }; // float16: its bits

async function readArrays() {
  const text = document.getElementById("arrays").textContent;
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = new Uint8Array(await new Response(stream).arrayBuffer());
  return Object.fromEntries(ABOUT.arrays.map((about) => [about.name, unpack(buffer, about)]));
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
  return new KINDS[type](out.buffer);
}
