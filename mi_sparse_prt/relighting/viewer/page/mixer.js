// --- the mixer: a picture as the weighted sum of layers, one for each lamp

const STILL = 300; // milliseconds after which the address is written
const AS_RENDERED = { stops: 0, colour: "#ffffff", on: true, solo: false };

const MIX = HEAD + "precision highp sampler2DArray;" + TONE + `
uniform sampler2DArray layers;
uniform sampler2D weights;
uniform int lamps;
out vec4 colour;
void main() {
  ivec2 place = ivec2(gl_FragCoord.xy);
  place.y = textureSize(layers, 0).y - 1 - place.y;
  vec3 total = vec3(0.0);
  for (int k = 0; k < lamps; k++) total += texelFetch(weights, ivec2(k, 0), 0).rgb * texelFetch(layers, ivec3(place, k), 0).rgb;
  colour = shown(total);
}`;

class Layers extends Drawing {
  constructor(canvas, { width, height, lamps, arrays }) {
    super(canvas);
    const { gl } = this, most = gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS), widest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (lamps.length > most) throw new Error(`${lamps.length} lamps are more than the ${most} that this graphics card can mix.`);
    if (Math.max(width, height) > widest) throw new Error(`${width} x ${height} pixels are more than this graphics card can show.`);
    Object.assign(canvas, { width, height });
    Object.assign(this, { width, height, lamps, halves: arrays.layers });
    this.prepare();
  }

  // All that lives on the graphics card; again after it was lost
  prepare() {
    const { gl, width, height, lamps, halves } = this, size = 3 * width * height;
    this.mix = this.program(FILL, MIX);
    this.layers = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.layers);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGB16F, width, height, lamps.length);
    lamps.forEach((_, k) => {
      const own = halves.subarray(k * size, (k + 1) * size);
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, k, width, height, 1, gl.RGB, gl.HALF_FLOAT, own);
    });
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, filter, gl.NEAREST);
    this.weights = this.texture(gl.RGBA32F, lamps.length, 1, gl.RGBA, gl.FLOAT, null);
  }

  // weights (lamps, 4) of numbers in the layers
  draw(weights, exposure) {
    const { gl, lamps } = this, { program, uniforms } = this.mix;
    gl.useProgram(program);
    gl.bindTexture(gl.TEXTURE_2D, this.weights);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, lamps.length, 1, gl.RGBA, gl.FLOAT, weights);
    this.bind(0, gl.TEXTURE_2D_ARRAY, this.layers, uniforms.layers);
    this.bind(1, gl.TEXTURE_2D, this.weights, uniforms.weights);
    gl.uniform1i(uniforms.lamps, lamps.length);
    gl.uniform1f(uniforms.exposure, exposure);
    gl.viewport(0, 0, this.width, this.height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

// Linear RGB of "#rrggbb"
function linearColour(text) {
  return [1, 3, 5].map((at) => {
    const x = parseInt(text.slice(at, at + 2), 16) / 255;
    return x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
  });
}

class Mixer {
  constructor(scene, picture) {
    Object.assign(this, { scene, picture, onchange: () => {} });
    this.reset();
  }

  reset() {
    this.exposure = 0;
    this.lamps = this.scene.lamps.map(() => ({ ...AS_RENDERED }));
    this.onchange();
  }

  // Change one lamp; names are those of AS_RENDERED
  set(lamp, changes) {
    Object.assign(this.lamps[lamp], changes);
    this.onchange();
  }

  expose(stops) {
    this.exposure = stops;
    this.onchange();
  }

  // RGB that the radiance of each lamp is multiplied by
  get weights() {
    const alone = this.lamps.some(({ solo }) => solo);
    return this.lamps.map(({ stops, colour, on, solo }) => {
      const shines = on && (solo || !alone);
      return linearColour(colour).map((x) => (shines ? x * 2 ** stops : 0));
    });
  }

  draw() {
    const scaled = this.weights.flatMap((rgb, k) => [...rgb.map((x) => x * this.scene.scales[k]), 1]);
    this.picture.draw(new Float32Array(scaled), 2 ** this.exposure);
  }

  // A PNG of what is seen
  screenshot() {
    this.draw();
    return new Promise((done) => this.picture.canvas.toBlob(done));
  }

  // What is otherwise than rendered
  get address() {
    const given = new URLSearchParams();
    if (this.exposure) given.set("exposure", this.exposure);
    this.lamps.forEach(({ stops, colour, on, solo }, k) => {
      const words = [stops, colour.slice(1), on ? "on" : "off", solo ? "solo" : "mixed"].join("_");
      if (words !== "0_ffffff_on_mixed") given.set(`lamp.${this.scene.lamps[k]}`, words);
    });
    return given.toString();
  }

  set address(text) {
    const given = new URLSearchParams(text), exposure = parseFloat(given.get("exposure"));
    if (Number.isFinite(exposure)) this.exposure = exposure;
    this.scene.lamps.forEach((name, k) => {
      const found = /^(-?[\d.]+)_([\da-f]{6})_(on|off)_(solo|mixed)$/.exec(given.get(`lamp.${name}`) || "");
      const stops = found ? parseFloat(found[1]) : NaN;
      if (Number.isFinite(stops)) this.lamps[k] = { stops, colour: "#" + found[2], on: found[3] === "on", solo: found[4] === "solo" };
    });
    this.onchange();
  }
}

const signed = (stops) => (stops > 0 ? "+" : "") + stops.toFixed(1);

// Controls of all lamps; returns what makes them show the mixer's state
function lampControls(mixer) {
  const template = document.getElementById("lamp");
  const rows = mixer.scene.lamps.map((name, k) => {
    const row = template.content.firstElementChild.cloneNode(true);
    const part = (field) => row.querySelector(`[name="${field}"]`);
    row.querySelector("span").textContent = row.querySelector("span").title = name;
    row.addEventListener("input", ({ target }) => {
      const value = target.type === "checkbox" ? target.checked : target.type === "range" ? +target.value : target.value;
      mixer.set(k, { [target.name]: value });
    });
    part("stops").addEventListener("dblclick", () => mixer.set(k, { stops: 0 }));
    for (const field of Object.keys(AS_RENDERED)) part(field).setAttribute("aria-label", `${name}: ${field}`);
    return { row, part };
  });
  document.getElementById("lamps").replaceChildren(...rows.map(({ row }) => row));
  return () =>
    mixer.weights.forEach((rgb, k) => {
      const { row, part } = rows[k], { stops, colour, on, solo } = mixer.lamps[k];
      Object.assign(part("on"), { checked: on });
      Object.assign(part("solo"), { checked: solo });
      [part("stops").value, part("colour").value] = [stops, colour];
      row.querySelector("output").textContent = signed(stops);
      row.classList.toggle("dark", !rgb.some((x) => x));
    });
}

function controls(mixer) {
  const form = document.getElementById("panel"), { exposure } = form.elements, showLamps = lampControls(mixer);
  const weights = () => JSON.stringify(Object.fromEntries(mixer.weights.map((rgb, k) => [mixer.scene.lamps[k], rgb])), null, 1);
  const actions = {
    reset: () => mixer.reset(),
    weights: () => save(new Blob([weights()], { type: "application/json" }), "weights.json"),
    picture: async () => save(await mixer.screenshot(), "picture.png"),
    panel: () => document.body.classList.toggle("bare", (form.hidden = !form.hidden)),
    brighter: () => mixer.expose(mixer.exposure + 0.25),
    darker: () => mixer.expose(mixer.exposure - 0.25),
  };
  const byKey = { s: "picture", p: "panel", "+": "brighter", "=": "brighter", "-": "darker" };
  exposure.addEventListener("input", () => mixer.expose(+exposure.value));
  form.addEventListener("click", ({ target }) => target.type === "button" && actions[target.name]());
  document.addEventListener("keydown", (event) => {
    const name = byKey[event.key];
    if (name && !event.ctrlKey && !event.metaKey) actions[name]();
  });
  form.hidden = false;
  return () => {
    exposure.value = mixer.exposure;
    exposure.nextElementSibling.textContent = signed(mixer.exposure);
    showLamps();
  };
}

async function openPage() {
  const canvas = document.getElementById("view"), scene = await readArchive(document.getElementById("data").textContent);
  const mixer = new Mixer(scene, new Layers(canvas, scene)), show = controls(mixer);
  let asked = 0, still = 0;
  const remember = () => location.protocol !== "about:" && history.replaceState(null, "", "#" + mixer.address);
  const frame = () => {
    asked = 0;
    if (!mixer.picture.gl.isContextLost()) mixer.draw();
    show();
    clearTimeout(still);
    still = setTimeout(remember, STILL);
  };
  mixer.onchange = () => (asked = asked || requestAnimationFrame(frame));
  mixer.address = location.hash.slice(1);
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    mixer.picture.prepare();
    mixer.onchange();
  });
  return mixer;
}

window.viewer = openPage().catch((error) => {
  say(error.message);
  return null;
});
