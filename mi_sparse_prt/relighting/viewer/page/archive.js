// --- the archive that Python wrote: a header in JSON, then arrays; all of it deflated, as base64

const ARRAYS = {
  "|i1": Int8Array, "|u1": Uint8Array, "<u2": Uint16Array, "<i4": Int32Array, "<u4": Uint32Array, "<f4": Float32Array,
};

async function readArchive(text) {
  const packed = await (await fetch("data:application/octet-stream;base64," + text.trim())).arrayBuffer();
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const length = new DataView(bytes.buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
  const arrays = {};
  let at = 4 + length;
  for (const { name, dtype, size, differences } of header.arrays) {
    const kind = ARRAYS[dtype], width = kind.BYTES_PER_ELEMENT;
    const raw = new Uint8Array(size * width);
    for (let plane = 0; plane < width; plane++) // bytes of one kind lie together
      for (let k = 0; k < size; k++) raw[k * width + plane] = bytes[at + plane * size + k];
    at += size * width;
    const values = new kind(raw.buffer);
    if (differences) for (let k = 1; k < size; k++) values[k] += values[k - 1];
    arrays[name] = values;
  }
  return { ...header, arrays };
}
