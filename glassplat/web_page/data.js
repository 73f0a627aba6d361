// The scene as it lies in the page: two SPZ files (the scene, the glass), a byte per splat
// (and for glass one that says which pane it is part of), and a description.

const CURRENT = 'try a current Firefox, Chrome, Edge or Safari';
const ROW = 1024;  // texels of a data texture's row
const HARMONIC_BYTES = [0, 9, 24, 45];
const REACH = 4;   // standard deviations that may show: to 1/255 of full opacity, and more where they are seen aslant

function packedBytes(id) {
  const text = atob(document.getElementById(id).textContent.trim());
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

async function inflated(bytes) {
  if (!window.DecompressionStream) throw new Error(`this browser is too old; ${CURRENT}`);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Sections of an SPZ file of version 3.
function sectionsOf(bytes) {
  const view = new DataView(bytes.buffer);
  if (view.getUint32(0, true) !== 0x5053474e || view.getUint32(4, true) !== 3) throw new Error('the scene is damaged');
  const count = view.getUint32(8, true), degree = bytes[12], fraction = bytes[13];
  const widths = { positions: 9, opacities: 1, colors: 3, scales: 3, rotations: 4, harmonics: HARMONIC_BYTES[degree] };
  const found = { count, degree, step: 2 ** -fraction };
  let at = 16;
  for (const [name, width] of Object.entries(widths)) {
    found[name] = bytes.subarray(at, at + width * count);
    at += width * count;
  }
  if (at > bytes.length) throw new Error('the scene is cut off');
  return found;
}

const texelRows = (count, perSplat = 1) => Math.max(1, Math.ceil((count * perSplat) / ROW));

function positionsOf(parts, total) {
  const positions = new Float32Array(3 * total);
  let at = 0;
  for (const { positions: bytes, step } of parts) {
    for (let i = 0; i < bytes.length; i += 3) {
      positions[at++] = (((bytes[i] | (bytes[i + 1] << 8) | (bytes[i + 2] << 16)) << 8) >> 8) * step;
    }
  }
  return positions;
}

// What project.frag reads: places [x, y, z, colour and opacity], shapes [rotation, scales and channel], harmonics.
function texturesOf(primary, glass, channel) {
  const total = primary.count + glass.count, positions = positionsOf([primary, glass], total);
  const places = new Uint32Array(4 * ROW * texelRows(total)), shapes = new Uint32Array(2 * ROW * texelRows(total));
  const floats = new Float32Array(places.buffer), placeBytes = new Uint8Array(places.buffer);
  const shapeBytes = new Uint8Array(shapes.buffer), reaches = new Float32Array(total), areas = new Float32Array(total);
  for (let i = 0; i < total; i++) {
    const [part, j] = i < primary.count ? [primary, i] : [glass, i - primary.count];
    for (let c = 0; c < 3; c++) {
      floats[4 * i + c] = positions[3 * i + c];
      placeBytes[16 * i + 12 + c] = part.colors[3 * j + c];
      shapeBytes[8 * i + 4 + c] = part.scales[3 * j + c];
    }
    placeBytes[16 * i + 15] = part.opacities[j];
    for (let c = 0; c < 4; c++) shapeBytes[8 * i + c] = part.rotations[4 * j + c];
    shapeBytes[8 * i + 7] = channel[i];
    const [, middle, largest] = part.scales.slice(3 * j, 3 * j + 3).sort();
    reaches[i] = REACH * Math.exp(largest / 16 - 10);
    areas[i] = Math.exp((middle + largest) / 16 - 20);
  }
  const perSplat = Math.ceil(HARMONIC_BYTES[primary.degree] / 16), width = HARMONIC_BYTES[primary.degree];
  const harmonics = new Uint8Array(16 * ROW * texelRows(primary.count, Math.max(perSplat, 1)));
  for (let i = 0; i < primary.count && width; i++) {
    harmonics.set(primary.harmonics.subarray(i * width, (i + 1) * width), 16 * perSplat * i);
  }
  const owners = channel.subarray(total, total + glass.count);
  return { total, positions, reaches, areas, owners, places, shapes, harmonics: new Uint32Array(harmonics.buffer), perSplat };
}

async function loadedScene() {
  const scene = JSON.parse(document.getElementById('scene').textContent);
  const [primary, glass, channel, cube] = await Promise.all(['primary', 'glass', 'channel', 'cube'].map(async (id) => inflated(packedBytes(id))));
  const parts = [sectionsOf(primary), sectionsOf(glass)];
  return { ...scene, cube, firstGlass: parts[0].count, degree: parts[0].degree, ...texturesOf(...parts, channel) };
}
