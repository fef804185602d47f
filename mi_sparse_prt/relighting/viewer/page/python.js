// --- what an open page asks of Python: colours of vertices, rows of T, pictures, and images to light with

const PASSES = 64; // of a picture, while nothing moves
const LARGEST_PICTURE = 640 * 480; // pixels that Python renders; the screen may have more

// A header in JSON and bytes to the server that the page came from, and its answer
async function askServer(header, content = new Uint8Array()) {
  const words = new TextEncoder().encode(JSON.stringify(header)), body = new Uint8Array(4 + words.length + content.byteLength);
  new DataView(body.buffer).setUint32(0, words.length, true);
  body.set(words, 4);
  body.set(new Uint8Array(content.buffer, content.byteOffset, content.byteLength), 4 + words.length);
  const response = await fetch("ask", { method: "POST", body });
  if (!response.ok) throw new Error(`the server says: ${response.statusText}`);
  const bytes = await response.arrayBuffer(), length = new DataView(bytes).getUint32(0, true);
  return [JSON.parse(new TextDecoder().decode(bytes.slice(4, 4 + length))), bytes.slice(4 + length)];
}

// One question at a time, and pictures by path beside them: a process of their own makes these.
// What Python or the way to it says is wrong is shown, and is gone with the next answer
class Python {
  constructor(ask) {
    Object.assign(this, { way: ask, last: Promise.resolve(), failed: false, asked: 0 });
  }

  ask(header, content) {
    const apart = header.by === "path", before = apart ? Promise.resolve() : this.last;
    const answer = before.then(async () => {
      this.asked++;
      try {
        const [found, bytes] = await this.way(header, content);
        if (found.error) throw new Error(found.error);
        if (this.failed) say("");
        this.failed = false;
        return [found, bytes];
      } catch (error) {
        this.failed = true;
        say(error instanceof TypeError ? "Python does not answer; is it still running?" : error.message);
        return null;
      }
    });
    if (!apart) this.last = answer;
    return answer;
  }
}

// Colours of vertices by Python, of the newest light alone: another is asked for when one has come
class Streamed {
  constructor(viewer) {
    Object.assign(this, { viewer, busy: false, again: false, light: null, eye: null });
  }

  apply(approximation, light, chosen) {
    const { viewer } = this;
    approximation.apply(light, chosen);
    this.light = new Float32Array(viewer.texels.length);
    viewer.cubemap.inverse(approximation.applied, this.light);
  }

  // Whether glossy surfaces were shown for another view
  get old() {
    return Boolean(this.viewer.scene.glossy && this.light && String(this.eye) !== String(this.viewer.camera.eye));
  }

  async send() {
    const { viewer } = this;
    if (this.busy || !viewer.python) return (this.again = true);
    [this.busy, this.again] = [true, false];
    const eye = viewer.camera.eye, start = performance.now();
    const answer = await viewer.python.ask({ ask: "colours", eye }, this.light);
    this.busy = false;
    if (!answer) return null;
    this.eye = eye;
    viewer.milliseconds.sums = performance.now() - start;
    viewer.received = new Uint16Array(answer[1]);
    viewer.picture.receive(viewer.received);
    viewer.touch();
    return this.again || this.old ? this.send() : null;
  }
}

// A picture by Python over the page's own, right of a line; it gets better as long as nothing moves
class Beside {
  constructor(viewer, canvas) {
    Object.assign(this, { viewer, canvas, key: "", busy: false, passes: 0 });
  }

  get wanted() {
    const { viewer } = this, { state, camera } = viewer, { width, height } = viewer.picture.canvas;
    const scale = Math.min(1, Math.sqrt(LARGEST_PICTURE / (width * height)));
    const [columns, rows] = [width, height].map((pixels) => Math.max(1, Math.round(pixels * scale)));
    return {
      ask: "picture", by: state.beside, environment: viewer.environment.number, degrees: state.degrees, axis: state.axis, tip: state.tip,
      eye: camera.eye, target: camera.target, up: camera.up, height: camera.height, columns, rows, lamps: state.lamps,
    };
  }

  // Ask for passes of what is shown now
  async follow(moving = false) {
    const { viewer, canvas } = this, { state } = viewer, question = this.wanted, key = JSON.stringify(question);
    const shown = Boolean(state.beside && viewer.python && question.environment !== undefined);
    canvas.hidden = !shown || key !== this.key || !this.passes;
    if (canvas.hidden) document.getElementById("passes").textContent = "";
    canvas.style.clipPath = `inset(0 0 0 ${100 * state.line}%)`;
    if (!canvas.hidden && this.exposure !== state.exposure) this.paint();
    if (!shown || this.busy || moving) return;
    if (key !== this.key) Object.assign(this, { key, passes: 0, sums: new Float32Array(3 * question.columns * question.rows) });
    if (this.passes >= PASSES) return;
    this.busy = true;
    const answer = await viewer.python.ask({ ...question, pass: this.passes }, viewer.brightness);
    this.busy = false;
    if (!answer) return;
    if (key === this.key && key === JSON.stringify(this.wanted)) {
      const halves = new Uint16Array(answer[1]);
      for (let k = 0; k < halves.length; k++) this.sums[k] += HALVES[halves[k]];
      this.passes++;
      this.samples = answer[0].spp;
      Object.assign(canvas, { width: question.columns, height: question.rows });
      this.paint();
    }
    this.follow();
  }

  paint() {
    const { canvas, sums, passes, viewer } = this, image = new ImageData(canvas.width, canvas.height);
    const factor = 2 ** viewer.state.exposure / passes;
    for (let k = 0, to = 0; k < sums.length; k += 3, to += 4) {
      for (let c = 0; c < 3; c++) {
        const x = Math.min(Math.max(sums[k + c] * factor, 0), 1);
        image.data[to + c] = 255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055) + 0.5;
      }
      image.data[to + 3] = 255;
    }
    canvas.getContext("2d").putImageData(image, 0, 0);
    this.exposure = viewer.state.exposure;
    document.getElementById("passes").textContent = `${this.samples * passes} samples per pixel`;
  }
}

// Numbers of all half floats
const HALVES = new Float32Array(1 << 16).map((_, word) => {
  const exponent = (word >> 10) & 31, fraction = word & 1023, sign = word >> 15 ? -1 : 1;
  return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : (fraction / 1024) * 2 ** -14);
});

// The row of T of the vertex under a place of the picture, -1 to 1 in both directions
async function askRow(viewer, x, y) {
  const { width, height } = viewer.picture.canvas, { towards, eye } = viewer.camera.matrices(width / height);
  const direction = [0, 1, 2].map((axis) => towards[axis] * x + towards[3 + axis] * y + towards[6 + axis]);
  const answer = await viewer.python.ask({ ask: "row", eye, towards: direction });
  if (!answer) return;
  const [{ vertex, mesh }, bytes] = answer, caption = document.getElementById("vertex");
  viewer.row = vertex === null ? null : new Float32Array(bytes);
  document.getElementById("row").hidden = !viewer.row;
  if (!viewer.row) return (caption.textContent = "nothing is there: click a surface");
  const most = viewer.row.reduce((a, b) => Math.max(a, b), 1e-30);
  unfold(document.getElementById("row"), viewer.row, viewer.cubemap.n, 1 / most);
  caption.textContent = `row of vertex ${vertex} (${mesh}); at most ${most.toPrecision(2)}`;
}

// An image that Python reads and checks, as one more light of the page
async function askLight(viewer, file) {
  const answer = await viewer.python.ask({ ask: "environment", name: file.name }, new Uint8Array(await file.arrayBuffer()));
  if (!answer) return;
  const [{ name, width, height, background, number }, bytes] = answer, words = new Uint32Array(bytes);
  const light = new Environment(name, width, height, decodeShared(words));
  viewer.addLight(Object.assign(light, { words, number, image: await decodedImage(background) }));
}
