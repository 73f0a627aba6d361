// Orders the splats that may be in the picture back to front, one order per camera; runs as a worker.
function sorterOf({ positions, reaches, areas, owners }) {
  const count = reaches.length, firstGlass = count - owners.length, keys = new Int32Array(count), chosen = new Uint32Array(count);
  const bits = new Int32Array(1), depth = new Float32Array(bits.buffer), counts = new Uint32Array(65537);
  let found = 0, lowest = 0, highest = 0;

  // Every picture widens splats to about a pixel, so that in a smaller one those that are smaller still cover more. Of
  // these only a share is drawn, always the same ones, so that together they cover what they do in the whole picture.
  function isThinnedOut(i, far, { share, pixels }) {
    const area = (areas[i] * pixels) / (far * far);
    return (Math.imul(i, 0x9e3779b1) >>> 0) * 2 ** -32 * (area + 1) > area + share;
  }

  // Chooses of those from first to last which are before some depth; the depth of the farthest.
  // The bits of a positive float grow with it, and their upper ones resolve near depths more finely than far ones.
  function choose({ rows, offset, near, clip, glassOf, thinned, window: [left, top, right, bottom] }, first, last, beyond) {
    const across = Math.hypot(1, Math.max(-left, right)), down = Math.hypot(1, Math.max(-top, bottom));
    let farthest = 0;
    for (let i = first; i < last; i++) {
      const x = positions[3 * i], y = positions[3 * i + 1], z = positions[3 * i + 2];
      const far = rows[6] * x + rows[7] * y + rows[8] * z + offset[2];
      if (!(far > near && far < beyond) || (clip && clip[0] * x + clip[1] * y + clip[2] * z + clip[3] <= 0)) continue;
      if (i >= firstGlass && glassOf !== 'all' && owners[i - firstGlass] !== glassOf) continue;
      const u = rows[0] * x + rows[1] * y + rows[2] * z + offset[0], wide = across * reaches[i];
      if (u < left * far - wide || u > right * far + wide) continue;
      const v = rows[3] * x + rows[4] * y + rows[5] * z + offset[1], high = down * reaches[i];
      if (v < top * far - high || v > bottom * far + high) continue;
      if (thinned && isThinnedOut(i, far, thinned)) continue;
      if (far > farthest) farthest = far;
      depth[0] = far;
      const key = bits[0];
      if (key < lowest) lowest = key;
      if (key > highest) highest = key;
      keys[found] = key;
      chosen[found++] = i;
    }
    return farthest;
  }

  function sorted() {
    let shift = 0;
    while ((highest - lowest) >> shift > 65535) shift++;
    counts.fill(0);
    for (let j = 0; j < found; j++) counts[((highest - keys[j]) >> shift) + 1]++;
    for (let k = 0; k < 65536; k++) counts[k + 1] += counts[k];
    const order = new Uint32Array(found);
    for (let j = 0; j < found; j++) order[counts[(highest - keys[j]) >> shift]++] = chosen[j];
    return order;
  }

  // Of a mask: its glass, and what is before the farthest of it.
  return function order(camera) {
    [found, lowest, highest] = [0, 0x7fffffff, 0];
    if (!camera) return null;
    const farthest = camera.glassOf === null ? Infinity : choose(camera, firstGlass, count, Infinity);
    choose(camera, 0, firstGlass, farthest);
    return sorted();
  };
}

function sortingWorker() {
  let order = null;
  self.onmessage = ({ data }) => {
    if (data.positions) { order = sorterOf(data); return; }
    const orders = data.cameras.map(order);
    self.postMessage({ orders }, orders.filter(Boolean).map((sorted) => sorted.buffer));
  };
}

// Asks the worker, or sorts here where there is none; only the newest request waits.
function makeSorter({ positions, reaches, areas, owners }) {
  const splats = { positions, reaches, areas, owners };
  let worker = null, here = null, asked = null, waiting = null;
  try {
    const source = `${sorterOf}\n(${sortingWorker})()`;
    worker = new Worker(URL.createObjectURL(new Blob([source], { type: 'text/javascript' })));
    worker.onerror = () => {  // What it was asked is sorted here, or what is newer.
      worker = null;
      here = sorterOf(splats);
      if (waiting) asked?.resolve(null);
      waiting ||= asked;
      asked = null;
      pump();
    };
    worker.onmessage = ({ data }) => {
      asked.resolve(data.orders);
      asked = null;
      pump();
    };
    worker.postMessage(splats);
  } catch {
    here = sorterOf(splats);
  }

  function pump() {
    if (!waiting || asked) return;
    const next = waiting;
    waiting = null;
    if (here) { next.resolve(next.cameras.map(here)); return; }
    asked = next;
    worker.postMessage({ cameras: next.cameras });
  }

  return (cameras) => new Promise((resolve) => {
    waiting?.resolve(null);
    waiting = { cameras, resolve };
    pump();
  });
}
