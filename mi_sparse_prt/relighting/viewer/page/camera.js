// --- a camera that moves around a point; vectors are arrays of three numbers, world space

const add = (a, b, k = 1) => a.map((x, i) => x + k * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, k) => a.map((x) => x * k);
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));

class Camera {
  // eye, target, up, the height of the picture at distance 1, and the scene's size
  constructor(start, size) {
    this.start = start;
    this.scene = size;
    this.home();
  }

  home() {
    Object.assign(this, { eye: this.start.eye, target: this.start.target, height: this.start.height });
    this.up = unit(this.start.up);
  }

  frame() {
    const back = unit(add(this.eye, this.target, -1)), right = unit(cross(this.up, back));
    return { right, up: cross(back, right), back };
  }

  // Turn around the target, by angles in radians
  orbit(across, down) {
    const away = add(this.eye, this.target, -1), distance = Math.hypot(...away), pole = this.up;
    const height = dot(away, pole) / distance, flat = add(away, scaled(pole, height * distance), -1);
    const polar = Math.min(Math.max(Math.acos(height) - down, 0.02), Math.PI - 0.02);
    const x = unit(flat), z = cross(pole, x), azimuth = -across;
    const around = add(scaled(x, Math.cos(azimuth)), z, -Math.sin(azimuth));
    this.eye = add(this.target, add(scaled(around, Math.sin(polar)), pole, Math.cos(polar)), distance);
  }

  dolly(factor) {
    const away = add(this.eye, this.target, -1), distance = Math.hypot(...away);
    const next = Math.min(Math.max(distance * factor, 0.01 * this.scene), 50 * this.scene);
    this.eye = add(this.target, away, next / distance);
  }

  // Projection of points, directions of places of the picture, and the eye; the picture may be moved, -1 to 1 is all of it
  matrices(aspect, [across, upwards] = [0, 0]) {
    const { right, up, back } = this.frame(), { eye, height } = this, distance = Math.hypot(...add(eye, this.target, -1));
    const near = Math.max(0.002 * distance, 1e-4 * this.scene), far = distance + 20 * this.scene;
    const y = 2 / height, x = y / aspect, z = (near + far) / (near - far), w = (2 * near * far) / (near - far);
    const rows = [
      [...add(scaled(right, x), back, -across), across * dot(back, eye) - x * dot(right, eye)],
      [...add(scaled(up, y), back, -upwards), upwards * dot(back, eye) - y * dot(up, eye)],
      [...scaled(back, z), w - z * dot(back, eye)],
      [...scaled(back, -1), dot(back, eye)],
    ];
    const projected = new Float32Array(16);
    rows.forEach((row, i) => row.forEach((value, j) => (projected[4 * j + i] = value)));
    const a = scaled(right, 1 / x), b = scaled(up, 1 / y);
    const towards = new Float32Array([...a, ...b, ...add(add(scaled(back, -1), a, -across), b, -upwards)]);
    return { projected, towards, eye };
  }

  get state() {
    return [...this.eye, ...this.target].map((value) => +value.toPrecision(5)).join(",");
  }

  set state(text) {
    const values = text.split(",").map(Number);
    if (values.length !== 6 || !values.every(Number.isFinite)) return;
    this.eye = values.slice(0, 3);
    this.target = values.slice(3);
  }
}
