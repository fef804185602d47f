// --- .hdr images (Radiance RGBE) that somebody drops

const MOST_PIXELS = 64e6;

// { width, height, values } of a file's bytes; throws a sentence
function readRadiance(bytes) {
  let at = 0;
  const line = () => {
    const start = at;
    while (at < bytes.length && bytes[at] !== 10) at++;
    return new TextDecoder().decode(bytes.subarray(start, at++)).trim();
  };
  if (!line().startsWith("#?")) throw new Error("not a Radiance image: its first line is not #?RADIANCE");
  for (let text = line(); text; text = line())
    if (text.startsWith("FORMAT=") && text !== "FORMAT=32-bit_rle_rgbe") throw new Error(`${text} is not read, only 32-bit_rle_rgbe`);
  const size = /^-Y (\d+) \+X (\d+)$/.exec(line());
  if (!size) throw new Error("its rows do not go from the top down and from left to right");
  const height = +size[1], width = +size[2];
  if (!(Math.abs(width - 2 * height) <= 0.1 * width)) throw new Error(`${width} x ${height} is not twice as wide as high`);
  if (width * height > MOST_PIXELS) throw new Error(`${width} x ${height} pixels are too many for this page`);
  const values = new Float32Array(3 * width * height), row = new Uint8Array(4 * width);
  for (let y = 0; y < height; y++) {
    at = readRow(bytes, at, row, width);
    for (let x = 0; x < width; x++) {
      const [e, step] = row.planes ? [row[3 * width + x], width] : [row[4 * x + 3], 1];
      const scale = e ? 2 ** (e - 136) : 0;
      for (let c = 0; c < 3; c++) values[3 * (y * width + x) + c] = scale * row[row.planes ? c * step + x : 4 * x + c];
    }
  }
  return { width, height, values };
}

// One row of pixels; rows of runs have a plane for each channel
function readRow(bytes, at, row, width) {
  row.planes = width > 7 && width < 32768 && bytes[at] === 2 && bytes[at + 1] === 2 && !(bytes[at + 2] & 128);
  const ended = () => new Error("it ends too early");
  if (!row.planes) {
    if (at + row.length > bytes.length) throw ended();
    row.set(bytes.subarray(at, at + row.length));
    return at + row.length;
  }
  at += 4;
  for (let channel = 0; channel < 4; channel++)
    for (let x = 0; x < width; ) {
      const count = bytes[at++], run = count > 128 ? count - 128 : count, start = channel * width + x;
      if (at >= bytes.length || !run || x + run > width) throw ended();
      if (count > 128) row.fill(bytes[at++], start, start + run);
      else {
        row.set(bytes.subarray(at, at + run), start);
        at += run;
      }
      x += run;
    }
  return at;
}
