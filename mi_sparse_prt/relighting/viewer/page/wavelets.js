// --- which wavelets a frame applies ([OBRG06]), as relighting/approximations.py, and what they do to the clusters

class Approximation {
  constructor(cubemap, weights) {
    Object.assign(this, { cubemap, weights });
    this.applied = new Float32Array(3 * cubemap.size);
    this.sizes = new Float32Array(cubemap.size);
    this.resets = new Uint8Array(cubemap.bands);
  }

  // Wavelets that change for the light of a new frame; bands that start anew are in resets
  update(light, method, budget) {
    const { applied, cubemap, resets } = this;
    resets.fill(0);
    if (method === "everything") {
      const changed = [];
      for (let j = 0; j < cubemap.size; j++)
        if (light[3 * j] !== applied[3 * j] || light[3 * j + 1] !== applied[3 * j + 1] || light[3 * j + 2] !== applied[3 * j + 2])
          changed.push(j);
      return changed;
    }
    this.measure(light, method);
    const chosen = largest(this.sizes, Math.round(budget));
    for (let j = 0; j < cubemap.size; j++)
      if (resets[cubemap.band[j]]) applied[3 * j] = applied[3 * j + 1] = applied[3 * j + 2] = 0;
    return chosen;
  }

  // Sizes by which wavelets are chosen; a band starts anew where light is nearer to 0 than to what was applied
  measure(light, method) {
    const { applied, cubemap, weights, sizes, resets } = this, { band, size } = cubemap;
    const own = new Float32Array(size), whole = new Float64Array(cubemap.bands), left = new Float64Array(cubemap.bands);
    for (let j = 0, k = 0; j < size; j++, k += 3) {
      const r = light[k], g = light[k + 1], b = light[k + 2];
      own[j] = weights[j] * Math.sqrt(r * r + g * g + b * b);
      const x = r - applied[k], y = g - applied[k + 1], z = b - applied[k + 2];
      sizes[j] = weights[j] * Math.sqrt(x * x + y * y + z * z);
      whole[band[j]] += own[j];
      left[band[j]] += sizes[j];
    }
    if (method === "non_incremental") resets.fill(1);
    if (method === "per_band") for (let b = 0; b < cubemap.bands; b++) resets[b] = left[b] > whole[b] ? 1 : 0;
    for (let j = 0; j < size; j++) if (resets[band[j]]) sizes[j] = own[j];
  }

  // Let chosen wavelets be those of the light
  apply(light, chosen) {
    for (const j of chosen) for (let c = 0; c < 3; c++) this.applied[3 * j + c] = light[3 * j + c];
  }

  // How far what is applied is from the light, relative, by area ([OBRG06] Figure 7)
  error(light) {
    const { applied, cubemap } = this;
    let left = 0, whole = 0;
    for (let j = 0, k = 0; j < cubemap.size; j++, k += 3) {
      left += cubemap.side[j] * Math.hypot(light[k] - applied[k], light[k + 1] - applied[k + 1], light[k + 2] - applied[k + 2]);
      whole += cubemap.side[j] * Math.hypot(light[k], light[k + 1], light[k + 2]);
    }
    return left / Math.max(whole, 1e-30);
  }
}

// Places of so many of the largest sizes that are not 0: the order of floats is that of their bits
function largest(sizes, count) {
  const bits = new Int32Array(sizes.buffer, sizes.byteOffset, sizes.length), bins = new Int32Array(1 << 13);
  for (const word of bits) bins[word >> 18]++;
  let bin = bins.length - 1;
  for (let found = 0; bin > 0 && (found += bins[bin]) < count; bin--);
  const places = [];
  for (let j = 0; j < sizes.length; j++) if (sizes[j] > 0 && bits[j] >> 18 >= bin) places.push(j);
  return places.sort((a, b) => sizes[b] - sizes[a] || a - b).slice(0, count);
}

// Coefficients of clusters (3, columns), from lists of what each wavelet adds to which column
class Clusters {
  constructor(cubemap, { starts, gaps, values, scales, order }) {
    Object.assign(this, { cubemap, columns: scales.length });
    const kept = values.length, wavelets = new Uint16Array(kept), counts = new Uint32Array(cubemap.size + 1);
    for (let column = 0, at = 0, gap = 0; column < this.columns; column++) {
      let place = -1;
      for (const stop = starts[column + 1]; at < stop; at++) {
        while (gaps[gap] === 255) place += gaps[gap++];
        place += gaps[gap++] + 1;
        wavelets[at] = order[place];
        counts[wavelets[at] + 1]++;
      }
    }
    for (let j = 0; j < cubemap.size; j++) counts[j + 1] += counts[j];
    const next = counts.slice();
    this.starts = counts;
    this.places = new Uint16Array(kept);
    this.values = new Float32Array(kept);
    for (let column = 0; column < this.columns; column++)
      for (let at = starts[column]; at < starts[column + 1]; at++) {
        const to = next[wavelets[at]]++, root = values[at] / 127;
        this.places[to] = column;
        this.values[to] = root * Math.abs(root) * scales[column];
      }
    this.sums = Array.from({ length: cubemap.bands }, () => new Float64Array(3 * this.columns));
    this.total = new Float32Array(4 * this.columns); // as texels of a texture
  }

  // Let chosen wavelets of what is applied be those of the light
  apply(approximation, light, chosen) {
    const { cubemap, starts, places, values, sums, total } = this, { applied, resets } = approximation;
    for (let band = 0; band < cubemap.bands; band++) if (resets[band]) sums[band].fill(0);
    for (const j of chosen) {
      const sum = sums[cubemap.band[j]];
      const r = light[3 * j] - applied[3 * j], g = light[3 * j + 1] - applied[3 * j + 1], b = light[3 * j + 2] - applied[3 * j + 2];
      for (let k = starts[j]; k < starts[j + 1]; k++) {
        const place = 3 * places[k], value = values[k];
        sum[place] += r * value;
        sum[place + 1] += g * value;
        sum[place + 2] += b * value;
      }
    }
    approximation.apply(light, chosen);
    for (let k = 0; k < this.columns; k++)
      for (let c = 0; c < 3; c++) {
        let value = 0;
        for (const sum of sums) value += sum[3 * k + c];
        total[4 * k + c] = value;
      }
  }
}
