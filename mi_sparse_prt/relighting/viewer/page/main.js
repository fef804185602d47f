// --- the page

const STILL = 150; // milliseconds after which nothing moves any more
const PICTURES = 100; // between pictures of the light, while it moves
const HEIGHT = 128; // pixels of an image that is dropped; larger ones become smaller
const CLICK = 3; // pixels that a click may move

class Viewer {
  constructor(scene, picture) {
    Object.assign(this, { scene, picture, camera: new Camera(scene.camera, Math.hypot(...scene.extent)) });
    const { arrays } = scene;
    this.cubemap = new Cubemap(scene.resolution);
    if (scene.streamed) this.streamed = new Streamed(this);
    else
      this.clusters = new Clusters(this.cubemap, {
        starts: arrays.starts, gaps: arrays.gaps, values: arrays.values, scales: arrays.scales, order: arrays.order,
      });
    this.approximation = new Approximation(this.cubemap, arrays.norms || new Float32Array(this.cubemap.size).fill(1));
    this.environments = scene.environments.map(({ name, width, height, image }, k) => {
      const words = arrays[`environment${k}`];
      return Object.assign(new Environment(name, width, height, decodeShared(words)), { words, image, number: k });
    });
    this.texels = new Float32Array(3 * this.cubemap.size);
    this.light = new Float32Array(3 * this.cubemap.size);
    this.state = {
      environment: 0, ...UPRIGHT, axis: scene.axis || "y", exposure: scene.exposure, method: "per_band", budget: 100, colours: "radiance",
      beside: "", line: 0.5, lamps: (scene.lamps || []).map(() => 1),
    };
    this.milliseconds = {};
    this.changed = true;
    this.started = this.exact = this.playing = false;
    this.moved = -1e9;
    this.samples = 0;
  }

  get environment() {
    return this.environments[this.state.environment];
  }

  // How bright lamps are, (lamps, 3)
  get brightness() {
    return Float32Array.from(this.state.lamps.flatMap((value) => [value, value, value]));
  }

  // From now on Python answers
  connect(ask) {
    this.python = new Python(ask);
    this.changed = true;
    this.touch();
  }

  // Change what is seen; names are those of state
  set(changes) {
    const before = { ...this.state };
    Object.assign(this.state, changes);
    this.state.degrees = ((this.state.degrees % 360) + 360) % 360;
    if (["environment", "degrees", "axis", "tip", "lamps"].some((name) => String(before[name]) !== String(this.state[name]))) this.changed = true;
    this.touch();
  }

  // How the light is turned: three rows, world from environment
  get rotation() {
    return matrixOf(turnOf(this.state));
  }

  // From now on about another axis; the light stays as it is
  turnAbout(axis) {
    this.set(splitTurn(turnOf(this.state), axis));
  }

  // Turn the light further: by degrees about up, and tip it about what is horizontal in the picture
  turn(across, down = 0) {
    const how = down ? turnedFurther(this.state, this.camera.frame().right, down) : this.state;
    this.set({ ...how, degrees: how.degrees + across });
  }

  touch() {
    this.moved = performance.now();
    if (this.onchange) this.onchange();
  }

  // L of a frame, what of it is applied, and colours of vertices; the first frame is exact, and so is one that stands still
  relight(method = this.started ? this.state.method : "everything") {
    if (this.state.lamps.length) return this.relightLamps();
    const times = [performance.now()], lap = () => times.push(performance.now());
    this.environment.project(this.cubemap, this.rotation, this.texels);
    this.cubemap.haar(this.texels, this.light);
    lap();
    const chosen = this.approximation.update(this.light, method, this.state.budget);
    lap();
    (this.clusters || this.streamed).apply(this.approximation, this.light, chosen);
    lap();
    if (this.streamed) this.streamed.send();
    else this.picture.relight(this.clusters.total);
    lap();
    ["light", "choice", "sums", "upload"].forEach((name, k) => (this.milliseconds[name] = times[k + 1] - times[k]));
    this.chosen = chosen.length;
    this.started = true;
    this.changed = false;
    this.exact = method === "everything";
  }

  relightLamps() {
    Object.assign(this, { chosen: this.state.lamps.length, started: true, changed: false, exact: true });
    this.streamed.light = this.brightness;
    this.streamed.send();
  }

  draw(smooth = false) {
    const start = performance.now();
    this.picture.draw(this.drawn, smooth);
    this.milliseconds.draw = performance.now() - start;
  }

  // All that a picture is made of
  get drawn() {
    const { state, camera, environment } = this;
    return {
      camera, light: environment, turn: this.rotation, exposure: 2 ** state.exposure, colours: state.colours,
      brightness: state.lamps[this.scene.backgroundLamp] ?? 1,
    };
  }

  resize(width, height) {
    Object.assign(this.picture.canvas, { width, height });
    this.touch();
  }

  // All that a frame is made of; whether another is needed. What stands still becomes smooth, a sample in each frame
  frame(now) {
    const moving = now - this.moved < STILL;
    if (moving) this.samples = 0;
    if (this.changed) this.relight();
    else if (!moving && !this.exact) this.relight("everything");
    else if (this.streamed && this.streamed.old) this.streamed.send();
    if (moving) this.draw();
    else this.picture.addSample(this.drawn, this.samples++);
    return this.samples < SAMPLES.length;
  }

  drop(name, image) {
    const { width, height, values } = shrunk(image, HEIGHT);
    this.addLight(Object.assign(new Environment(name, width, height, values), { words: encodeShared(values) }));
  }

  addLight(environment) {
    this.environments.push(environment);
    this.set({ environment: this.environments.length - 1 });
  }

  // A PNG of what is seen
  screenshot() {
    this.draw(true);
    return new Promise((done) => this.picture.canvas.toBlob(done));
  }

  // What is shown, as others may set it: light by its name, camera as six numbers
  get shown() {
    const { environment, degrees, axis, tip, exposure, lamps } = this.state, { eye, target } = this.camera;
    return { light: this.environments[environment].name, degrees, axis, tip, exposure, camera: [...eye, ...target], lamps };
  }

  apply({ light, degrees, axis, tip, exposure, camera, lamps }) {
    const environment = this.environments.findIndex(({ name }) => name === light);
    const changes = { degrees, axis, tip: [...tip], exposure, ...(environment < 0 ? {} : { environment }) };
    if (String(lamps) !== String(this.state.lamps) && lamps.length === this.state.lamps.length) changes.lamps = [...lamps];
    if (camera.length === 6) [this.camera.eye, this.camera.target] = [camera.slice(0, 3), camera.slice(3)];
    this.set(changes);
  }

  get address() {
    const { environment, degrees, axis, tip, exposure } = this.state;
    return new URLSearchParams({
      light: this.environments[environment].name, degrees: +degrees.toFixed(2), axis, tip: tip.map((value) => +value.toFixed(2)).join(","),
      exposure: +exposure.toFixed(2), camera: this.camera.state,
    }).toString();
  }

  set address(text) {
    const given = new URLSearchParams(text), changes = {};
    const environment = this.environments.findIndex(({ name }) => name === given.get("light"));
    if (environment >= 0) changes.environment = environment;
    for (const name of ["degrees", "exposure"]) {
      const value = parseFloat(given.get(name));
      if (Number.isFinite(value)) changes[name] = value;
    }
    if (Object.hasOwn(AXES, given.get("axis"))) changes.axis = given.get("axis");
    const tip = (given.get("tip") || "").split(",").map(parseFloat);
    if (tip.length === 3 && tip.every(Number.isFinite)) changes.tip = tip;
    if (given.has("camera")) this.camera.state = given.get("camera");
    this.set(changes);
  }
}

// A cubemap of radiance, unfolded: +Y above +Z, -Y below it, -X, +Z, +X, -Z side by side
function unfold(canvas, texels, n, exposure) {
  const places = [[2, 1], [0, 1], [1, 0], [1, 2], [1, 1], [3, 1]];
  Object.assign(canvas, { width: 4 * n, height: 3 * n });
  const context = canvas.getContext("2d"), image = context.createImageData(4 * n, 3 * n);
  for (let j = 0; j < 6 * n * n; j++) {
    const [column, line] = places[Math.floor(j / (n * n))];
    const to = 4 * ((line * n + (Math.floor(j / n) % n)) * 4 * n + column * n + (j % n));
    for (let c = 0; c < 3; c++) image.data[to + c] = 255 * Math.min(Math.max(texels[3 * j + c] * exposure, 0), 1) ** (1 / 2.2);
    image.data[to + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

function panel(viewer) {
  const form = document.getElementById("panel"), { elements } = form;
  const applied = new Float32Array(viewer.texels.length);
  const list = () =>
    elements.environment.replaceChildren(...viewer.environments.map(({ name }, k) => new Option(name, k)));
  list();
  const show = () => {
    const { state } = viewer;
    if (elements.environment.length !== viewer.environments.length) list();
    for (const name of ["environment", "degrees", "axis", "exposure", "method", "colours", "beside", "line"]) elements[name].value = state[name];
    document.getElementById("legend").textContent = (viewer.scene.legends || {})[state.colours] || "";
    state.lamps.forEach((value, k) => (elements[`lamp${k}`].value = value));
    elements.budget.value = Math.log2(state.budget);
    elements.record.textContent = viewer.recorder.recording ? "stop film" : "film";
    elements.play.textContent = viewer.playing ? "stop" : "turn";
  };
  form.addEventListener("input", ({ target }) => {
    if (target.name.startsWith("lamp")) {
      const lamps = viewer.state.lamps.map((_, k) => +elements[`lamp${k}`].value);
      return viewer.set({ lamps });
    }
    if (target.name === "axis") return viewer.turnAbout(target.value);
    const value = target.name === "budget" ? Math.round(2 ** target.value) : target.value;
    viewer.set({ [target.name]: ["method", "colours", "beside"].includes(target.name) ? value : +value });
  });
  forThisMatrix(viewer, form);
  const numbers = document.getElementById("numbers");
  const pictures = () => {
    if (form.hidden) return;
    const { milliseconds, approximation, cubemap, state } = viewer, exposure = 2 ** state.exposure;
    if (state.lamps.length) return (numbers.textContent = `${(milliseconds.sums || 0).toFixed(0)} ms for colours`);
    cubemap.inverse(approximation.applied, applied);
    unfold(document.getElementById("light"), viewer.texels, cubemap.n, exposure);
    unfold(document.getElementById("applied"), applied, cubemap.n, exposure);
    const of = (name) => (milliseconds[name] || 0).toFixed(1);
    numbers.textContent =
      `${viewer.chosen} wavelets, ${(100 * approximation.error(viewer.light)).toFixed(2)}% left out\n` +
      `bands that began anew: ${[...approximation.resets].map((on) => (on ? "●" : "○")).join("")}\n` +
      `ms: light ${of("light")}, choice ${of("choice")}, sums ${of("sums")}\n` +
      `upload ${of("upload")}, draw ${of("draw")}; ${viewer.rate ? viewer.rate.toFixed(0) : "–"} frames/s`;
  };
  return { form, show, pictures };
}

// What the panel leaves out, and a slider for each lamp
function forThisMatrix(viewer, form) {
  const { scene } = viewer, { elements } = form, hide = (element) => (element.hidden = true);
  document.getElementById("asked").hidden = !scene.live;
  for (const name of OF_VERTICES) {
    if (scene.arrays[name + "Colours"]) continue;
    const option = elements.colours.querySelector(`[value="${name}"]`);
    Object.assign(option, { disabled: true, textContent: `${option.textContent}: not known`, title: (scene.unknown || {})[name] || "" });
  }
  const errors = Object.entries(scene.errors || {});
  if (!errors.length) hide(elements.colours.querySelector('[value="error"]'));
  elements.colours.title = errors.map(([name, { error }]) => `${name}: ${(100 * error).toFixed(1)}%`).join("\n");
  if (!scene.lamps || !scene.lamps.length) return;
  for (const name of ["environment", "degrees", "axis", "method", "budget"]) hide(elements[name].parentElement);
  form.querySelectorAll(".pictures").forEach(hide);
  hide(elements.play);
  hide(document.getElementById("vertex"));
  const slider = (name, k) => {
    const input = Object.assign(document.createElement("input"), { type: "range", name: `lamp${k}`, min: 0, max: 2, step: 0.01, value: 1 });
    const label = Object.assign(document.createElement("label"), { title: name });
    label.append(Object.assign(document.createElement("span"), { textContent: name }), input);
    return label;
  };
  document.getElementById("lamps").replaceChildren(...scene.lamps.map(slider));
}

function pointers(viewer, canvas) {
  const held = new Map();
  let spread = 0, pressed = [0, 0];
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, event);
    spread = 0;
    pressed = [event.clientX, event.clientY];
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => held.delete(event.pointerId));
  canvas.addEventListener("click", ({ clientX, clientY }) => {
    if (!viewer.python || viewer.state.lamps.length || Math.hypot(clientX - pressed[0], clientY - pressed[1]) > CLICK) return;
    askRow(viewer, (2 * clientX) / canvas.clientWidth - 1, 1 - (2 * clientY) / canvas.clientHeight);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    held.set(event.pointerId, event);
    const across = (event.clientX - before.clientX) / canvas.clientHeight, down = (event.clientY - before.clientY) / canvas.clientHeight;
    if (held.size === 2) {
      const [a, b] = [...held.values()], next = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (spread) viewer.camera.dolly(spread / next);
      spread = next;
      viewer.touch();
    } else if (event.ctrlKey || event.metaKey) viewer.turn(180 * across, 180 * down);
    else if (event.shiftKey || before.buttons & 2) viewer.turn(180 * across);
    else {
      viewer.camera.orbit(Math.PI * across, Math.PI * down);
      viewer.touch();
    }
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    viewer.camera.dolly(1.001 ** event.deltaY);
    viewer.touch();
  }, { passive: false });
}

function dropped(viewer) {
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", async (event) => {
    event.preventDefault();
    const [file] = event.dataTransfer.files;
    if (file) await openLight(viewer, file);
  });
}

async function openLight(viewer, file) {
  if (viewer.python) return askLight(viewer, file);
  try {
    if (!/\.hdr$/i.test(file.name)) throw new Error("only .hdr images are read here");
    viewer.drop(file.name, readRadiance(new Uint8Array(await file.arrayBuffer())));
    say("");
  } catch (error) {
    say(`${file.name}: ${error.message}`);
  }
}

// A film of what is seen, from one call to the next
class Recorder {
  constructor(viewer, ended = (film) => save(film, "film.webm")) {
    Object.assign(this, { viewer, ended, recording: null });
  }

  toggle() {
    if (this.recording) {
      this.recording.stop();
      this.recording = null;
      return;
    }
    const parts = [], recording = new MediaRecorder(this.viewer.picture.canvas.captureStream(), { videoBitsPerSecond: 8e6 });
    recording.addEventListener("dataavailable", ({ data }) => parts.push(data));
    recording.addEventListener("stop", () => this.ended(new Blob(parts, { type: recording.mimeType })));
    recording.start();
    this.recording = recording;
  }
}

function actions(viewer, form) {
  const keys = document.getElementById("keys");
  const all = {
    play: () => (viewer.playing = !viewer.playing),
    screenshot: async () => save(await viewer.screenshot(), "picture.png"),
    record: () => viewer.recorder.toggle(),
    home: () => viewer.camera.home(),
    help: () => (keys.open ? keys.close() : keys.showModal()),
    panel: () => (form.hidden = !form.hidden),
    next: () => viewer.set({ environment: (viewer.state.environment + 1) % viewer.environments.length }),
    left: () => viewer.turn(-1),
    right: () => viewer.turn(1),
    up: () => viewer.turn(0, -1),
    down: () => viewer.turn(0, 1),
    upright: () => viewer.set({ tip: UPRIGHT.tip }),
    brighter: () => viewer.set({ exposure: viewer.state.exposure + 0.25 }),
    darker: () => viewer.set({ exposure: viewer.state.exposure - 0.25 }),
  };
  const byKey = {
    " ": "play", s: "screenshot", r: "record", h: "home", "?": "help", p: "panel", n: "next", ArrowLeft: "left", ArrowRight: "right",
    ArrowUp: "up", ArrowDown: "down", u: "upright",
    "+": "brighter", "=": "brighter", "-": "darker",
  };
  const act = (name) => {
    all[name]();
    viewer.touch();
  };
  form.addEventListener("click", ({ target }) => target.type === "button" && act(target.name));
  document.addEventListener("keydown", (event) => {
    const name = byKey[event.key];
    if (!name || event.ctrlKey || event.metaKey || event.target.matches("input, select")) return;
    event.preventDefault();
    act(name);
  });
}

async function openPage() {
  const canvas = document.getElementById("view");
  const scene = await readArchive(document.getElementById("data").textContent);
  scene.images = await Promise.all(scene.textures.map(decodedImage));
  await Promise.all(scene.environments.map(async (light) => (light.image = await decodedImage(light.background))));
  const viewer = new Viewer(scene, new Picture(canvas, scene));
  document.getElementById("notes").textContent = [...scene.notes, ...Object.values(scene.unknown || {})].join(" ");
  viewer.address = location.hash.slice(1);
  viewer.recorder = new Recorder(viewer);
  const { form, show, pictures } = panel(viewer);
  form.hidden = false;
  pointers(viewer, canvas);
  dropped(viewer);
  actions(viewer, form);
  viewer.beside = new Beside(viewer, document.getElementById("beside"));
  run(viewer, canvas, show, pictures);
  if (scene.live && location.protocol.startsWith("http")) viewer.connect(askServer);
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    viewer.picture.prepare();
    if (viewer.clusters) viewer.picture.relight(viewer.clusters.total);
    else if (viewer.received) viewer.picture.receive(viewer.received);
    viewer.touch();
  });
  return viewer;
}

async function decodedImage(text) {
  const image = new Image();
  image.src = text;
  await image.decode();
  return image;
}

// Frames as long as something moves
function run(viewer, canvas, show, pictures) {
  let asked = false, last = 0, drawn = 0;
  const step = (now) => {
    asked = false;
    if (viewer.held) return; // frames are made by whoever holds it
    if (viewer.playing) viewer.turn(Math.min(now - last, 100) * 0.03);
    const scale = window.devicePixelRatio || 1, width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale);
    if (!viewer.pinned && (canvas.width !== width || canvas.height !== height)) viewer.resize(width, height);
    const more = viewer.picture.gl.isContextLost() ? false : viewer.frame(performance.now());
    if (more && now > last) viewer.rate = 0.9 * (viewer.rate || 0) + (0.1 * 1000) / (now - last);
    last = now;
    if (!more || now - drawn > PICTURES) {
      drawn = now;
      show();
      pictures();
      viewer.beside.follow(more);
      if (!more && viewer.onstill) viewer.onstill();
      const hasAddress = location.protocol !== "about:"; // a frame of a notebook has none
      if (!more && hasAddress) history.replaceState(null, "", "#" + viewer.address);
    }
    if (more) ask();
  };
  const ask = () => {
    if (!asked) requestAnimationFrame(step);
    asked = true;
  };
  viewer.onchange = ask;
  window.addEventListener("resize", () => viewer.touch());
  viewer.touch();
}

window.viewer = openPage().catch((error) => {
  say(error.message);
  return null;
});
