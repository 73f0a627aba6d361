// Vectors are arrays of three, rotations arrays of nine by rows, quaternions (w, x, y, z).
// A pose is what takes the world into a camera: { rotation, offset }; x to the right, y down, z forward.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const minus = (a, b) => plus(a, b, -1);
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const norm = (a) => Math.sqrt(dot(a, a));
const unit = (a) => scaled(a, 1 / (norm(a) || 1));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const mixed = (a, b, t) => plus(scaled(a, 1 - t), b, t);
const clamped = (x, low, high) => Math.min(Math.max(x, low), high);

const row = (m, k) => [m[3 * k], m[3 * k + 1], m[3 * k + 2]];
const turned = (m, v) => [dot(row(m, 0), v), dot(row(m, 1), v), dot(row(m, 2), v)];
const turnedBack = (m, v) => [0, 1, 2].map((k) => m[k] * v[0] + m[3 + k] * v[1] + m[6 + k] * v[2]);

function product(a, b) {
  const result = [];
  for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) result.push(dot(row(a, i), [b[j], b[3 + j], b[6 + j]]));
  return result;
}

function rotationAbout(axis, angle) {
  const [x, y, z] = unit(axis), c = Math.cos(angle), s = Math.sin(angle), k = 1 - c;
  return [
    c + k * x * x, k * x * y - s * z, k * x * z + s * y,
    k * x * y + s * z, c + k * y * y, k * y * z - s * x,
    k * x * z - s * y, k * y * z + s * x, c + k * z * z,
  ];
}

function quaternionOf(m) {
  const w = Math.sqrt(Math.max(0, 1 + m[0] + m[4] + m[8])) / 2;
  const x = Math.sqrt(Math.max(0, 1 + m[0] - m[4] - m[8])) / 2, y = Math.sqrt(Math.max(0, 1 - m[0] + m[4] - m[8])) / 2;
  const z = Math.sqrt(Math.max(0, 1 - m[0] - m[4] + m[8])) / 2;
  const largest = Math.max(w, x, y, z);
  if (largest === w) return [w, (m[7] - m[5]) / (4 * w), (m[2] - m[6]) / (4 * w), (m[3] - m[1]) / (4 * w)];
  if (largest === x) return [(m[7] - m[5]) / (4 * x), x, (m[1] + m[3]) / (4 * x), (m[2] + m[6]) / (4 * x)];
  if (largest === y) return [(m[2] - m[6]) / (4 * y), (m[1] + m[3]) / (4 * y), y, (m[5] + m[7]) / (4 * y)];
  return [(m[3] - m[1]) / (4 * z), (m[2] + m[6]) / (4 * z), (m[5] + m[7]) / (4 * z), z];
}

function rotationOfQuaternion(q) {
  const length = Math.hypot(...q), [w, x, y, z] = q.map((c) => c / length);
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

function between(a, b, t) {
  const p = quaternionOf(a);
  let q = quaternionOf(b), cosine = p.reduce((sum, c, i) => sum + c * q[i], 0);
  if (cosine < 0) { q = q.map((c) => -c); cosine = -cosine; }
  const angle = Math.acos(Math.min(1, cosine)), sine = Math.sin(angle);
  const [s, u] = sine < 1e-4 ? [1 - t, t] : [Math.sin((1 - t) * angle) / sine, Math.sin(t * angle) / sine];
  return rotationOfQuaternion(p.map((c, i) => s * c + u * q[i]));
}

const poseAt = (rotation, position) => ({ rotation, offset: scaled(turned(rotation, position), -1) });
const centerOf = (pose) => scaled(turnedBack(pose.rotation, pose.offset), -1);
const inCamera = (pose, point) => plus(turned(pose.rotation, point), pose.offset);

// The camera behind the mirror, which is left-handed: Eq. 8 of TR-Gaussians.
function mirroredPose(pose, pane) {
  const n = pane.normal, flip = [];
  for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) flip.push((i === j ? 1 : 0) - 2 * n[i] * n[j]);
  const moved = scaled(n, 2 * dot(pane.center, n));
  return { rotation: product(pose.rotation, flip), offset: plus(turned(pose.rotation, moved), pose.offset) };
}

function lookingAt(position, target, up) {
  const forward = unit(minus(target, position)), right = unit(cross(forward, up)), down = cross(forward, right);
  return [...right, ...down, ...forward];
}
