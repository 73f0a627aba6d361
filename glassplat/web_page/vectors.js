// Vectors are arrays of three, rotations arrays of nine by rows.
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
const transposed = (m) => [0, 3, 6, 1, 4, 7, 2, 5, 8].map((k) => m[k]);
const turnedBack = (m, v) => turned(transposed(m), v);
const product = (a, b) => [0, 1, 2].flatMap((i) => turnedBack(b, row(a, i)));

function rotationAbout(axis, angle) {
  const [x, y, z] = unit(axis), c = Math.cos(angle), s = Math.sin(angle), k = 1 - c;
  return [
    c + k * x * x, k * x * y - s * z, k * x * z + s * y,
    k * x * y + s * z, c + k * y * y, k * y * z - s * x,
    k * x * z - s * y, k * y * z + s * x, c + k * z * z,
  ];
}

// Turned the short way about one axis, from rotation a at t = 0 to b at t = 1.
function between(a, b, t) {
  const m = product(b, transposed(a));
  const skew = [m[7] - m[5], m[2] - m[6], m[3] - m[1]], cosine = (m[0] + m[4] + m[8] - 1) / 2;
  let axis = skew;
  if (cosine < 0) {
    // At half a turn the skew part vanishes; the symmetric part is c I + (1 - c) n n^T.
    const columns = [0, 1, 2].map((k) => row(m, k).map((x, j) => x + m[3 * j + k] - (j === k ? 2 * cosine : 0)));
    axis = columns.reduce((best, column) => (norm(column) > norm(best) ? column : best));
    if (dot(axis, skew) < 0) axis = scaled(axis, -1);
  }
  return product(rotationAbout(axis, t * Math.atan2(norm(skew) / 2, cosine)), a);
}

const poseAt = (rotation, position) => ({ rotation, offset: scaled(turned(rotation, position), -1) });
const centerOf = (pose) => scaled(turnedBack(pose.rotation, pose.offset), -1);
const inCamera = (pose, point) => plus(turned(pose.rotation, point), pose.offset);

// The camera behind the mirror, which is left-handed: Eq. 8 of TR-Gaussians.
function mirroredPose(pose, pane) {
  const n = pane.normal, seen = turned(pose.rotation, n);
  const rotation = pose.rotation.map((x, k) => x - 2 * seen[Math.floor(k / 3)] * n[k % 3]);
  return { rotation, offset: plus(pose.offset, seen, 2 * dot(pane.center, n)) };
}

function lookingAt(position, target, up) {
  const forward = unit(minus(target, position)), right = unit(cross(forward, up)), down = cross(forward, right);
  return [...right, ...down, ...forward];
}
