// --- E: an environment that turns, as texels of a cubemap and as Haar wavelets

// [face][s axis, t axis, centre], as emission/cube_faces.py
const FACES = [
  [[0, 0, -1], [0, -1, 0], [1, 0, 0]],
  [[0, 0, 1], [0, -1, 0], [-1, 0, 0]],
  [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
  [[1, 0, 0], [0, 0, -1], [0, -1, 0]],
  [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
  [[-1, 0, 0], [0, -1, 0], [0, 0, -1]],
];
const LEAST_LOOKUPS = 2; // along the edge of a texel; more where pixels are finer

// RGB of WebGL's RGB9_E5
function decodeShared(words) {
  const values = new Float32Array(3 * words.length);
  for (let k = 0; k < words.length; k++) {
    const word = words[k], scale = 2 ** ((word >>> 27) - 24);
    values[3 * k] = (word & 511) * scale;
    values[3 * k + 1] = ((word >>> 9) & 511) * scale;
    values[3 * k + 2] = ((word >>> 18) & 511) * scale;
  }
  return values;
}

function encodeShared(values) {
  const words = new Uint32Array(values.length / 3);
  for (let k = 0; k < words.length; k++) {
    const rgb = [0, 1, 2].map((c) => Math.min(Math.max(values[3 * k + c], 0), 65408));
    const most = Math.max(...rgb);
    let exponent = Math.max(-16, Math.floor(Math.log2(Math.max(most, 1e-30)))) + 16;
    if (Math.round(most * 2 ** (24 - exponent)) > 511) exponent++;
    const parts = rgb.map((value) => Math.round(value * 2 ** (24 - exponent)));
    words[k] = parts[0] | (parts[1] << 9) | (parts[2] << 18) | (exponent << 27);
  }
  return words;
}

class Cubemap {
  constructor(n) {
    this.n = n;
    this.size = 6 * n * n;
    const corner = (x, y) => Math.atan2(x * y, Math.sqrt(x * x + y * y + 1));
    this.roots = new Float32Array(this.size); // of solid angles
    for (let row = 0; row < n; row++)
      for (let col = 0; col < n; col++) {
        const [x0, x1, y0, y1] = [col, col + 1, row, row + 1].map((k) => (2 * k) / n - 1);
        const angle = corner(x1, y1) - corner(x0, y1) - corner(x1, y0) + corner(x0, y0);
        for (let face = 0; face < 6; face++) this.roots[(face * n + row) * n + col] = Math.sqrt(angle);
      }
    this.band = new Uint8Array(this.size); // of wavelets, and the sides of their squares
    this.side = new Float32Array(this.size);
    for (let j = 0; j < this.size; j++) {
      const most = Math.max(j % n, Math.floor(j / n) % n, 1);
      this.band[j] = 31 - Math.clz32(most);
      this.side[j] = n / 2 ** this.band[j];
    }
    this.bands = this.band[this.size - 1] + 1;
    this.scratch = new Float32Array(3 * n * n);
  }

  // Wavelets of texels (size, 3) times the roots of solid angles, as emission/haar.py
  haar(texels, result) {
    const { n, scratch, roots } = this;
    for (let face = 0; face < 6; face++) {
      const base = face * n * n;
      for (let k = 0; k < n * n; k++)
        for (let c = 0; c < 3; c++) scratch[3 * k + c] = texels[3 * (base + k) + c] * roots[base + k];
      for (let size = n; size > 1; size >>= 1) {
        const half = size >> 1;
        for (let i = 0; i < half; i++)
          for (let j = 0; j < half; j++) {
            const upper = 3 * (2 * i * n + 2 * j), lower = upper + 3 * n, mean = 3 * (i * n + j);
            const across = 3 * (base + i * n + half + j), down = 3 * (base + (half + i) * n + j), both = down + 3 * half;
            for (let c = 0; c < 3; c++) {
              const p = scratch[upper + c], q = scratch[upper + 3 + c], r = scratch[lower + c], s = scratch[lower + 3 + c];
              result[across + c] = 0.5 * (p - q + r - s);
              result[down + c] = 0.5 * (p + q - r - s);
              result[both + c] = 0.5 * (p - q - r + s);
              scratch[mean + c] = 0.5 * (p + q + r + s); // what it replaces is not needed any more
            }
          }
      }
      for (let c = 0; c < 3; c++) result[3 * base + c] = scratch[c];
    }
  }

  // Texels of wavelets
  inverse(wavelets, result) {
    const { n, scratch, roots } = this;
    for (let face = 0; face < 6; face++) {
      const base = face * n * n;
      for (let c = 0; c < 3; c++) scratch[c] = wavelets[3 * base + c];
      for (let half = 1; half < n; half *= 2)
        for (let i = half - 1; i >= 0; i--)
          for (let j = half - 1; j >= 0; j--) {
            const upper = 3 * (2 * i * n + 2 * j), lower = upper + 3 * n, mean = 3 * (i * n + j);
            const across = 3 * (base + i * n + half + j), down = 3 * (base + (half + i) * n + j), both = down + 3 * half;
            for (let c = 0; c < 3; c++) {
              const m = scratch[mean + c], x = wavelets[across + c], y = wavelets[down + c], z = wavelets[both + c];
              scratch[upper + c] = 0.5 * (m + x + y + z);
              scratch[upper + 3 + c] = 0.5 * (m - x + y - z);
              scratch[lower + c] = 0.5 * (m + x - y - z);
              scratch[lower + 3 + c] = 0.5 * (m - x - y + z);
            }
          }
      for (let k = 0; k < n * n; k++)
        for (let c = 0; c < 3; c++) result[3 * (base + k) + c] = scratch[3 * k + c] / roots[base + k];
    }
  }
}

// Means over the pixels of a smaller image of the same kind, by solid angle
function shrunk({ width, height, values }, rows) {
  if (height <= rows) return { width, height, values };
  const columns = 2 * rows, sums = new Float64Array(3 * columns * rows), areas = new Float64Array(columns * rows);
  for (let row = 0; row < height; row++) {
    const area = Math.cos((Math.PI * row) / height) - Math.cos((Math.PI * (row + 1)) / height);
    for (let col = 0; col < width; col++) {
      const to = Math.floor(((row + 0.5) * rows) / height) * columns + Math.floor(((col + 0.5) * columns) / width);
      areas[to] += area;
      for (let c = 0; c < 3; c++) sums[3 * to + c] += area * values[3 * (row * width + col) + c];
    }
  }
  return { width: columns, height: rows, values: Float32Array.from(sums, (sum, k) => sum / areas[Math.floor(k / 3)]) };
}

// Equirectangular radiance (height, width, 3)
class Environment {
  constructor(name, width, height, values) {
    Object.assign(this, { name, width, height, values });
    this.power = [0, 0, 0];
    for (let row = 0; row < height; row++) {
      const area = ((2 * Math.PI) / width) * (Math.cos((Math.PI * row) / height) - Math.cos((Math.PI * (row + 1)) / height));
      for (let k = 3 * row * width; k < 3 * (row + 1) * width; k++) this.power[k % 3] += area * values[k];
    }
  }

  // Mean radiance of texels (size, 3) of the environment, turned by a matrix (three rows, world from environment)
  project(cubemap, matrix, result) {
    const { width, height, values } = this, known = lookups(cubemap, width), { weights, count } = known;
    const upright = matrix[1][1] > 1 - 1e-9; // about +y: lookups keep their rows, and move along these
    const { azimuths, rows } = upright ? known : turnedLookups(known, matrix);
    const shift = upright ? (Math.atan2(matrix[0][2], matrix[0][0]) / (2 * Math.PI) + 1) * width : 0, total = [0, 0, 0];
    for (let j = 0; j < cubemap.size; j++) {
      let red = 0, green = 0, blue = 0;
      for (let k = j * count; k < (j + 1) * count; k++) {
        const u = azimuths[k] * width + shift - 0.5, v = Math.min(Math.max(rows[k] * height - 0.5, 0), height - 1.001);
        const col = Math.floor(u), row = Math.floor(v), x = u - col, y = v - row;
        const left = col % width, right = (left + 1) % width, weight = weights[k];
        const a = 3 * (row * width + left), b = 3 * (row * width + right), down = 3 * width;
        const wa = weight * (1 - x) * (1 - y), wb = weight * x * (1 - y), wc = weight * (1 - x) * y, wd = weight * x * y;
        red += wa * values[a] + wb * values[b] + wc * values[a + down] + wd * values[b + down];
        green += wa * values[a + 1] + wb * values[b + 1] + wc * values[a + down + 1] + wd * values[b + down + 1];
        blue += wa * values[a + 2] + wb * values[b + 2] + wc * values[a + down + 2] + wd * values[b + down + 2];
      }
      result[3 * j] = red;
      result[3 * j + 1] = green;
      result[3 * j + 2] = blue;
      const area = cubemap.roots[j] ** 2;
      total[0] += area * red;
      total[1] += area * green;
      total[2] += area * blue;
    }
    const factors = total.map((found, c) => (found > 0 ? this.power[c] / found : 1)); // no turn changes the power
    for (let k = 0; k < result.length; k++) result[k] *= factors[k % 3];
  }
}

// Azimuth, height (both 0 to 1) and share of the places within texels at which an environment of some width is looked up
function lookups(cubemap, width) {
  const { n, size } = cubemap, across = Math.max(LEAST_LOOKUPS, Math.round(width / (4 * n))), count = across * across;
  if (cubemap.lookups && cubemap.lookups.count === count) return cubemap.lookups;
  const [azimuths, rows, weights] = [0, 1, 2].map(() => new Float32Array(size * count)), directions = new Float32Array(3 * size * count);
  for (let j = 0; j < size; j++) {
    const [sAxis, tAxis, centre] = FACES[Math.floor(j / (n * n))];
    let whole = 0;
    for (let k = 0; k < count; k++) {
      const s = (2 * ((j % n) + ((k % across) + 0.5) / across)) / n - 1;
      const t = (2 * ((Math.floor(j / n) % n) + (Math.floor(k / across) + 0.5) / across)) / n - 1;
      const [x, y, z] = centre.map((c, axis) => c + s * sAxis[axis] + t * tAxis[axis]);
      directions.set([x, y, z], 3 * (j * count + k));
      azimuths[j * count + k] = (Math.atan2(x, -z) / (2 * Math.PI) + 1) % 1;
      rows[j * count + k] = Math.acos(y / Math.hypot(x, y, z)) / Math.PI;
      whole += weights[j * count + k] = (1 + s * s + t * t) ** -1.5;
    }
    for (let k = 0; k < count; k++) weights[j * count + k] /= whole;
  }
  return (cubemap.lookups = { azimuths, rows, weights, count, directions, turned: [azimuths.slice(), rows.slice()] });
}

// Azimuth (from 0.5 on) and height of these places in an environment that is turned by a matrix, world from environment
function turnedLookups({ directions, turned }, [[a, b, c], [d, e, f], [g, h, i]]) {
  const [azimuths, rows] = turned;
  for (let k = 0; k < rows.length; k++) {
    const x = directions[3 * k], y = directions[3 * k + 1], z = directions[3 * k + 2];
    const right = a * x + d * y + g * z, up = b * x + e * y + h * z, behind = c * x + f * y + i * z;
    azimuths[k] = angle(right, -behind) / (2 * Math.PI) + 1;
    rows[k] = angle(Math.sqrt(right * right + behind * behind), up) / Math.PI;
  }
  return { azimuths, rows };
}

// Math.atan2 to within 1e-5, a thousandth of a pixel (Abramowitz and Stegun 4.4.49), in a part of its time
function angle(y, x) {
  const p = Math.abs(x), q = Math.abs(y), r = Math.min(p, q) / Math.max(p, q, 1e-30), s = r * r;
  let found = r * (0.999866 + s * (-0.3302995 + s * (0.180141 + s * (-0.085133 + s * 0.0208351))));
  if (q > p) found = Math.PI / 2 - found;
  if (x < 0) found = Math.PI - found;
  return y < 0 ? -found : found;
}
