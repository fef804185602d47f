// --- how the light is turned: it is tipped first, then turned by degrees about an axis, as relighting/viewer/turning.py

const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };
const UPRIGHT = { degrees: 0, axis: "y", tip: [0, 0, 0] }; // tip: an axis, as long as its degrees

// Quaternions [w, x, y, z] of rotations: a turn by degrees about an axis of length 1, one after the other, and their matrix
function quaternion(axis, degrees) {
  const half = (degrees * Math.PI) / 360;
  return [Math.cos(half), ...scaled(axis, Math.sin(half))];
}

function after([a, ...p], [b, ...q]) {
  return [a * b - dot(p, q), ...add(add(scaled(q, a), p, b), cross(p, q))];
}

// World from what is turned, row by row
function matrixOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

function turnOf({ degrees, axis, tip }) {
  return after(quaternion(AXES[axis], degrees), quaternion(unit(tip), Math.hypot(...tip)));
}

// The same rotation as degrees about an axis after a tip, whose own axis is at right angles to it
function splitTurn(turn, axis) {
  const own = AXES[axis], half = Math.atan2(dot(turn.slice(1), own), turn[0]);
  const degrees = (360 * half) / Math.PI, [w, ...rest] = after(quaternion(own, -degrees), turn), sine = Math.hypot(...rest);
  const angle = (360 * Math.atan2(sine, w)) / Math.PI;
  return { degrees: ((degrees % 360) + 360) % 360, axis, tip: sine < 1e-12 ? [0, 0, 0] : scaled(rest, angle / sine) };
}

// Turned further, by degrees about an axis of the world
function turnedFurther(how, about, degrees) {
  return splitTurn(after(quaternion(about, degrees), turnOf(how)), how.axis);
}
