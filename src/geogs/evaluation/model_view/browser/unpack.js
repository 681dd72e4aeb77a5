// Undoes what model_section.py does.

const base64Bytes = (text) => {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const plain = atob(text), bytes = new Uint8Array(plain.length);
  for (let i = 0; i < plain.length; i++) bytes[i] = plain.charCodeAt(i);
  return bytes;
};

const embedded = (id) => base64Bytes(document.getElementById(id).textContent);

async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// An array of numbers from [offset, rows, columns, bytes a number], row by row.
function unpacked(content, [offset, rows, columns, size]) {
  const Kind = { 1: Uint8Array, 2: Uint16Array, 4: Uint32Array }[size];
  const result = new Kind(rows * columns);
  for (let column = 0; column < columns; column++) {
    const start = offset + column * rows * size;
    let value = 0;
    for (let row = 0; row < rows; row++) {
      let zigzag = 0;
      for (let byte = size - 1; byte >= 0; byte--) {
        zigzag = (zigzag << 8) | content[start + byte * rows + row];
      }
      value += (zigzag >>> 1) ^ -(zigzag & 1);
      result[row * columns + column] = value;
      value = result[row * columns + column];
    }
  }
  return result;
}

const floats = (words) => new Float32Array(words.buffer);

// Steps of a box as lengths.
function lengths(steps, [low, step]) {
  const result = new Float32Array(steps.length);
  for (let i = 0; i < steps.length; i++) result[i] = low[i % 3] + steps[i] * step[i % 3];
  return result;
}
