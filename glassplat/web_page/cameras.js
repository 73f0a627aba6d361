// Which cameras a view needs: its own, and one behind each pane; where panes are in the picture.

// The half space on the camera's side of a pane, as a plane that is positive there.
function sideOf(pane, pose) {
  const facing = Math.sign(dot(minus(centerOf(pose), pane.center), pane.normal)), normal = scaled(pane.normal, facing);
  return [...normal, -dot(normal, pane.center)];
}

// Left, top, right and bottom of a pane in pixels, null where the camera does not see it.
function boundsOf(pane, pose, [fx, fy, cx, cy], [width, height], near) {
  const corners = [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([s, t]) =>
    inCamera(pose, plus(plus(pane.center, pane.tangent, s * pane.half[0]), pane.bitangent, t * pane.half[1])));
  const front = [], least = 0.01 * near;
  corners.forEach((corner, k) => {
    const next = corners[(k + 1) % 4];
    if (corner[2] > least) front.push(corner);
    if (corner[2] > least !== next[2] > least) front.push(mixed(corner, next, (least - corner[2]) / (next[2] - corner[2])));
  });
  if (!front.length) return null;
  const x = front.map((p) => (fx * p[0]) / p[2] + cx), y = front.map((p) => (fy * p[1]) / p[2] + cy);
  const bounds = [
    Math.max(0, Math.floor(Math.min(...x)) - 1), Math.max(0, Math.floor(Math.min(...y)) - 1),
    Math.min(width, Math.ceil(Math.max(...x)) + 1), Math.min(height, Math.ceil(Math.max(...y)) + 1),
  ];
  return bounds[0] < bounds[2] && bounds[1] < bounds[3] ? bounds : null;
}

// The smallest bounds around all.
function around(bounds) {
  const given = bounds.filter(Boolean);
  return [0, 1, 2, 3].map((k) => (k < 2 ? Math.min : Math.max)(...given.map((edges) => edges[k])));
}

// Which panes may share a pixel.
function overlapping(bounds) {
  const meet = (a, b) => a && b && a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
  return bounds.map((one, k) => bounds.some((other, l) => k !== l && meet(one, other)));
}

// The panes that may need a mask besides that of all.
const ownMasks = ({ panes, nearest }) => (panes.length > 1 && !nearest ? panes : []);

// While something moves, what a pane reflects weakly is drawn at half the scale, and with it the pane's mask.
function scaleOfMirrors({ moving, scale, reflectances }) {
  return moving && Math.max(...reflectances, 0) < 0.3 ? Math.min(scale, Math.max(0.5 * scale, 0.15)) : scale;
}

// What the sorter has to know of a view: for the picture the camera itself; the same for the mask of all panes and
// that of each, null where it needs none; and for what each mirrors the one behind it.
// A view moves on before its order is there: windows, in tangents, are wider than the picture.
// scales: of a picture that need not have all splats, and of its mirrors.
const SPARE = 0.3, LOW_PASS = 0.3;

function camerasToSort(pose, { intrinsics, size }, scene, scales = {}) {
  const window = (bounds) => bounds.map((edge, k) => {
    const spare = (k < 2 ? -SPARE : SPARE) * size[k % 2];
    return (edge + spare - intrinsics[2 + (k % 2)]) / intrinsics[k % 2];
  });
  const camera = ({ rotation, offset }, bounds, scale, { clip = null, glassOf = null } = {}) => ({
    rows: rotation, offset, near: scene.near, clip, glassOf, window: window(bounds || [0, 0, ...size]),
    thinned: scale ? { share: scale ** 2, pixels: (scale ** 2 * intrinsics[0] * intrinsics[1]) / LOW_PASS } : null,
  });
  const bounds = scene.panes.map((pane) => boundsOf(pane, pose, intrinsics, size, scene.near)), overlap = overlapping(bounds);
  const mask = (glassOf, window) => camera(pose, window, scales.mirrors, { glassOf });
  return [
    camera(pose, null, scales.direct),
    scene.panes.length ? mask('all', bounds.some(Boolean) ? around(bounds) : null) : null,
    ...ownMasks(scene).map((_, k) => (overlap[k] ? mask(k, bounds[k]) : null)),
    ...scene.panes.map((pane, k) => camera(mirroredPose(pose, pane), bounds[k], scales.mirrors, { clip: sideOf(pane, pose) })),
  ];
}
