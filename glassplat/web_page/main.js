// Loads the scene and keeps the picture up to date: coarse while something moves where that is needed, sharp at rest.

const SLOW = 1 / 22, QUICK = 1 / 45, LEAST_SCALE = 0.35, REST = 0.18;

async function start() {
  const scene = await loadedScene(), canvas = element('view');
  const renderer = makeRenderer(canvas, scene), sort = makeSorter(scene);
  let stale = true, last = 0, quiet = 0, drawn = 0, frame = REST, moving = renderer.isSoftware ? 0.6 : 1, sorting = false;
  const changed = () => { stale = true; };
  const navigation = makeNavigation(scene, changed), panel = makePanel(scene, navigation, changed);
  listenToPointers(canvas, navigation, () => document.body.classList.add('touched'));

  // The photograph's field of view fills the shorter side of the window.
  function intrinsics(width, height) {
    const view = scene.views[scene.first];
    const focal = Math.max((view.fy * height) / view.height, (view.fx * width) / view.width);
    return [focal, focal, width / 2, height / 2];
  }

  function viewOf(scale) {
    return { pose: navigation.pose(), intrinsics: intrinsics(canvas.width, canvas.height), scale, ...panel.wanted() };
  }

  const lensOf = (width, height) => ({ intrinsics: intrinsics(width, height), size: [width, height] });

  const ordersOf = (pose, lens) => sort(camerasToSort(pose, lens, scene));

  async function sorted(pose, lens = lensOf(canvas.width, canvas.height)) {
    const orders = await ordersOf(pose, lens);
    orders?.forEach((order, k) => renderer.setOrder(k, order));
  }

  function follow() {
    if (sorting) return;
    sorting = true;
    const pose = navigation.pose();
    sorted(pose).then(() => { sorting = false; stale = true; if (pose !== navigation.pose()) follow(); });
  }

  // How sharp a moving picture may be follows from how long the last ones took.
  function adapt(seconds) {
    if (seconds > 0.5 && quiet > 0) return;
    frame += 0.25 * (Math.min(seconds, 0.5) - frame);
    if (frame > SLOW) moving = Math.max(LEAST_SCALE, 0.9 * moving);
    if (frame < QUICK) moving = Math.min(1, 1.05 * moving);
  }

  let seen = null;
  function tick(time) {
    requestAnimationFrame(tick);
    const seconds = Math.min((time - last) / 1000, 0.25);
    last = time;
    if (document.hidden || renderer.isLost()) return;
    const active = [navigation.advance(seconds), panel.walk(seconds)].some(Boolean);
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    renderer.resize(Math.max(1, Math.round(canvas.clientWidth * ratio)), Math.max(1, Math.round(canvas.clientHeight * ratio)));
    const moved = navigation.pose() !== seen;
    if (moved || canvas.width !== tick.width || canvas.height !== tick.height) { seen = navigation.pose(); follow(); }
    if (moved || active) { adapt(seconds); quiet = 0; } else { quiet += seconds; }
    const scale = quiet < REST ? moving : 1;
    if (!stale && !(scale === 1 && drawn < 1) && canvas.width === tick.width && canvas.height === tick.height) return;
    [tick.width, tick.height] = [canvas.width, canvas.height];
    stale = false;
    drawn = scale;
    renderer.draw(viewOf(scale));
  }

  // For tests and for other scripts: the picture of one camera, as bytes [height][width][rgba] in base64.
  async function picture({ rotation, position, fx, fy, cx, cy, width, height, ...wanted }) {
    const pose = poseAt(rotation, position);
    await settled();
    sorting = true;
    const lens = { intrinsics: [fx, fy, cx, cy], size: [width, height] };
    await sorted(pose, lens);
    renderer.resize(width, height);
    renderer.draw({ ...viewOf(1), pose, intrinsics: lens.intrinsics, divider: 2, ...wanted });
    const rows = renderer.pixels();
    sorting = false;
    tick.width = 0;
    let text = '';
    for (let i = 0; i < rows.length; i += 32768) text += String.fromCharCode(...rows.subarray(i, i + 32768));
    return btoa(text);
  }

  async function settled() { while (sorting) await new Promise((resolve) => setTimeout(resolve, 5)); }

  // Seconds per frame of a turn about the first view, everything drawn and waited for.
  async function measured({ width, height, frames, scale = 1 }) {
    await settled();
    sorting = true;
    renderer.resize(width, height);
    const times = [];
    for (let k = 0; k < frames; k++) {
      navigation.orbit(0.01, 0);
      const begun = performance.now();
      await sorted(navigation.pose());
      renderer.draw(viewOf(scale));
      renderer.pixels();
      times.push((performance.now() - begun) / 1000);
    }
    sorting = false;
    return times;
  }

  await sorted(navigation.pose());
  document.body.classList.toggle('plain', renderer.isSoftware);
  document.body.classList.add('ready');
  if (!matchMedia('(prefers-reduced-motion: reduce)').matches && !location.hash.includes('still')) navigation.sway();
  requestAnimationFrame(tick);
  return { picture, measured, ordersOf, panel, navigation, scene, isSoftware: renderer.isSoftware };
}

window.glassplat = start();
window.glassplat.catch((error) => {
  document.body.classList.add('failed');
  element('message').textContent = `This scene cannot be shown: ${error.message}`;
});
