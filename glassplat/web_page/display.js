// Keeps the picture up to date. A graphics card draws each all at once. A processor draws a small one of fewer splats
// while something moves, and at rest refines it by parts.

const REST = 0.18, MIDDLE = 0.5, MOST_WAITING = 2, MOST_NOTED = 500, MOST_BYTES = 6e8, NONE = { pose: null, thinned: false };

function makeDisplay(canvas, scene, renderer, navigation, panel) {
  const { isSoftware } = renderer, sort = makeSorter(scene), pace = makePace(isSoftware), noted = [];
  let stale = true, sorting = false, order = NONE;
  let quiet = REST, drawn = 0, job = null, waiting = [], last = 0;
  const isResting = () => quiet >= REST;

  // The photograph's field of view fills the shorter side of the window.
  function intrinsics(width, height) {
    const view = scene.views[scene.first];
    const focal = Math.max((view.fy * height) / view.height, (view.fx * width) / view.width);
    const shift = (at, side, own) => (at - side / 2) * (focal / own);
    return [focal, focal, width / 2 + shift(view.cx, view.width, view.fx), height / 2 + shift(view.cy, view.height, view.fy)];
  }

  const lensOf = () => ({ intrinsics: intrinsics(canvas.width, canvas.height), size: [canvas.width, canvas.height] });

  // Whether the window has changed its size.
  function fit() {
    const sides = [canvas.clientWidth, canvas.clientHeight];
    const bytes = (isSoftware ? 2 : 1) * (16 + 12 * scene.panes.length) * sides[0] * sides[1];
    const ratio = Math.min(window.devicePixelRatio || 1, 2, renderer.largest / Math.max(...sides), Math.sqrt(MOST_BYTES / bytes));
    return renderer.resize(...sides.map((side) => Math.max(1, Math.round(side * ratio))));
  }

  function viewOf(scale, moving) {
    return { pose: navigation.pose(), intrinsics: lensOf().intrinsics, scale, moving: moving && scale < 1, ...panel.wanted() };
  }

  const ordersOf = (pose, lens, scales) => sort(camerasToSort(pose, lens, scene, scales));

  async function sorted(pose, lens, scales) {
    const orders = await ordersOf(pose, lens, scales);
    orders?.forEach((order, k) => renderer.setOrder(k, order));
    return Boolean(orders);
  }

  function follow() {
    if (sorting) return;
    sorting = true;
    const view = viewOf(pace.scale(), isSoftware && !isResting()), { pose, moving: thinned } = view;
    const scales = thinned ? { direct: view.scale, mirrors: scaleOfMirrors(view) } : {};
    sorted(pose, lensOf(), scales).then((done) => {
      sorting = false;
      if (!done) return;
      if (order.thinned && !thinned) drawn = Math.min(drawn, 0.99);
      if (!isSoftware || !isResting()) stale = true;
      order = { pose, thinned };
    });
  }

  function note(scale, splats) {
    noted.push({ time: performance.now(), scale, splats });
    if (noted.length > MOST_NOTED) noted.shift();
  }

  // Draws all of a picture; how many splats it took.
  function whole(view) {
    let splats = 0;
    for (const step of renderer.drawing(view)) splats += step.splats;
    [stale, drawn, job] = [false, view.scale, null];
    return splats;
  }

  function drawAtOnce(seconds) {
    if (seconds) pace.took(seconds);
    const scale = isResting() ? 1 : pace.scale();
    if (stale || (drawn < 1 && scale === 1)) note(scale, whole(viewOf(scale, true)));
  }

  function whenDone(took) { waiting.push({ isDone: renderer.fence(), since: performance.now(), took }); }

  // How long each of the finished took since it was begun, or since the one before it was done.
  function collect() {
    const now = performance.now();
    while (waiting.length && waiting[0].isDone()) {
      const { since, took } = waiting.shift();
      if (waiting.length) waiting[0].since = now;
      took((now - since) / 1000);
    }
  }

  function drawInParts() {
    collect();
    if (stale) job = null;
    if (stale && !waiting.length) {
      const scale = pace.scale(), splats = whole(viewOf(scale, true));
      whenDone((seconds) => { pace.took(seconds); note(scale, splats); });
    } else if (!stale && isResting() && drawn < 1 && !sorting && order.pose === navigation.pose() && !order.thinned) {
      refine();
    }
  }

  function refine() {
    const scale = drawn < 0.8 * MIDDLE ? MIDDLE : 1;
    job ||= { steps: renderer.drawing(viewOf(scale, false), pace.most), splats: 0 };
    while (job && waiting.length < MOST_WAITING) {
      const { done, value } = job.steps.next(), { splats } = job;
      if (done) {
        [job, drawn] = [null, scale];
        whenDone(() => note(scale, splats));
      } else {
        job.splats += value.splats;
        whenDone((seconds) => pace.drew(value.which, seconds));
      }
    }
  }

  function tick(time) {
    requestAnimationFrame(tick);
    const seconds = Math.min((time - last) / 1000, 0.25), pose = navigation.pose;
    last = time;
    if (document.hidden || renderer.isLost()) return;
    const active = [navigation.advance(seconds), panel.walk(seconds), panel.turn(IS_STILL ? 1 : seconds)].some(Boolean) || pose() !== tick.seen;
    tick.seen = pose();
    quiet = active ? 0 : quiet + seconds;
    if (fit()) [stale, order] = [true, NONE];
    if (order.pose !== pose() || (isResting() && order.thinned)) follow();
    if (isSoftware) drawInParts(); else drawAtOnce(active && seconds);
  }

  // For tests and scripts: the picture of one camera, bytes [height][width][rgba] in base64.
  async function picture({ rotation, position, fx, fy, cx, cy, width, height, ...wanted }) {
    const pose = poseAt(rotation, position), lens = { intrinsics: [fx, fy, cx, cy], size: [width, height] };
    while (sorting) await new Promise((resolve) => setTimeout(resolve, 5));
    sorting = true;
    while (!await sorted(pose, lens));
    renderer.resize(width, height);
    panel.turn(1);
    whole({ ...viewOf(1, false), pose, intrinsics: lens.intrinsics, divider: 2, ...wanted });
    if (renderer.isLost()) throw new Error('the browser has taken the canvas away');
    const rows = renderer.pixels();
    [sorting, stale, order] = [false, true, NONE];
    let text = '';
    for (let i = 0; i < rows.length; i += 32768) text += String.fromCharCode(...rows.subarray(i, i + 32768));
    return btoa(text);
  }

  async function begin() {
    fit();
    while (!await sorted(navigation.pose(), lensOf()));
    order = { pose: navigation.pose(), thinned: false };
    requestAnimationFrame(tick);
  }

  return {
    picture, ordersOf, noted, pace, lensOf,
    isRefining: () => job !== null,
    changed: () => { stale = true; },
    begin,
  };
}
